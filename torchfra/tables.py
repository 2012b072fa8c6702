"""Names and tables as text, for terminals."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

LONGEST = 200
"""Characters of a name that are shown."""


def printable(name: str, longest: int = LONGEST) -> str:
    """A name from outside, a file's or a target's, such that it does nothing but be read.

    What cannot be printed, such as the sequences that command a terminal, is written as in a Python string, and of a
    longer name the middle is left out.
    """
    if len(name) > longest:
        half = (longest - 3) // 2
        name = f"{name[:half]}...{name[-half:]}"
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in name)


def text_table(header: Sequence[str], rows: Iterable[Sequence[str]], *, align: str = "<>", gap: int = 2) -> str:
    """A table as text: a line for the header and one for each row, each column as wide as its widest cell.

    Args:
        header: a title for each column.
        rows: a cell for each column, already formatted; see ``printable`` for what is left of names.
        align: ``"<"`` (left) or ``">"`` (right) for each column; the last one holds for all columns that follow, so
            that the default is names on the left and numbers on the right.
        gap: spaces between columns.

    Returns:
        Lines without spaces at their ends, and without a newline after the last.

    Raises:
        ValueError: a row of another length than the header.

    Example::

        >>> print(text_table(["filter", "RMSE m"], [["srckf", "131.2"], ["fra", "98.7"]]))
        filter  RMSE m
        srckf    131.2
        fra       98.7
    """
    lines = [[printable(cell) for cell in line] for line in (header, *rows)]
    for number, line in enumerate(lines[1:], 1):
        if len(line) != len(header):
            raise ValueError(f"rows: expected {len(header)} cells in each, row {number} has {len(line)}")
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    sides = align + align[-1] * (len(widths) - len(align))
    cells = [
        [f"{cell:{side}{width}}" for cell, side, width in zip(line, sides, widths, strict=False)] for line in lines
    ]
    return "\n".join((" " * gap).join(line).rstrip() for line in cells)
