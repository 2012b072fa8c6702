"""Tables as text, for terminals."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def text_table(header: Sequence[str], rows: Iterable[Sequence[str]], *, align: str = "<>", gap: int = 2) -> str:
    """A table as text: a line for the header and one for each row, each column as wide as its widest cell.

    Args:
        header: a title for each column.
        rows: a cell for each column, already formatted.
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
    lines = [list(header), *map(list, rows)]
    for number, line in enumerate(lines[1:], 1):
        if len(line) != len(header):
            raise ValueError(f"rows: expected {len(header)} cells in each, row {number} has {len(line)}")
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    sides = align + align[-1] * (len(widths) - len(align))
    cells = [
        [f"{cell:{side}{width}}" for cell, side, width in zip(line, sides, widths, strict=False)] for line in lines
    ]
    return "\n".join((" " * gap).join(line).rstrip() for line in cells)
