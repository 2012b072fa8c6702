"""Names, numbers and tables as text: for terminals, and for papers as CSV, LaTeX and Markdown."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable, Mapping, Sequence


def plural(word: str) -> str:
    """Several of ``Source.word``."""
    return word if word == "aircraft" else f"{word}s"


def in_words(repairs: Mapping[str, int]) -> str:
    """Repairs with their counts as a list, in the singular where the count is 1."""
    singular = re.compile(r"s(?= |$)")  # the end of the first word that has an s there
    return ", ".join(f"{n:,} {singular.sub('', what, count=1) if n == 1 else what}" for what, n in repairs.items())


def printable(name: str, longest: int = 200) -> str:
    """A name from outside, a file's or a target's, such that it does nothing but be read.

    What cannot be printed, such as the sequences that command a terminal, is written as in a Python string, and of a
    longer name the middle is left out.
    """
    if len(name) > longest:
        half = (longest - 3) // 2
        name = f"{name[:half]}...{name[-half:]}"
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in name)


def text_table(header: Sequence[str], rows: Iterable[Sequence[str]], *, align: str = "<>") -> str:
    """A table as text: a line for the header and one for each row, each column as wide as its widest cell.

    Args:
        header: a title for each column.
        rows: a cell for each column, already formatted; see ``printable`` for what is left of names.
        align: ``"<"`` (left) or ``">"`` (right) for each column; the last one holds for all columns that follow, so
            that the default is names on the left and numbers on the right.

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
    return "\n".join("  ".join(line).rstrip() for line in cells)


# ---------------------------------------------------------------- quantities


def metres(value: float) -> str:
    """A length in the unit that fits, with two or three digits."""
    if not math.isfinite(value):
        return "an unknown length"
    if abs(value) < 1e-5:
        return "below 0.01 mm"
    if abs(value) < 0.1:
        return f"{1000 * value:.2g} mm"
    if abs(value) < 19.95:
        return f"{value:.2g} m" if abs(value) < 1 else _short(value, "m")
    return f"{value:,.0f} m" if abs(value) < 2000 else _short(value / 1000, "km")


def duration(seconds: float) -> str:
    """A time in the unit that fits, with two or three digits."""
    for size, unit in ((86_400, "days"), (3600, "h"), (60, "min")):
        if seconds >= 2 * size:
            return _short(seconds / size, unit).replace(".0 ", " ")
    return f"{seconds:.3g} s"


def _short(value: float, unit: str) -> str:
    """A number with its unit, with one decimal if it is below 20."""
    return f"{value:,.{int(abs(value) < 19.95)}f} {unit}"


# ---------------------------------------------------------------- for papers

FORMS = ("text", "csv", "latex", "markdown")
"""Formats of ``formed_table``."""
_LATEX = {"\\": r"\textbackslash{}", "^": r"\^{}", "~": r"\~{}"} | {c: f"\\{c}" for c in "_%&#${}"}


def decimals_of(error: float, digits: int = 2) -> int:
    """Decimals that show an error with this number of significant digits."""
    if not (math.isfinite(error) and error > 0):
        return 0
    exponent = math.floor(math.log10(float(f"{error:.{digits - 1}e}")))
    return max(digits - 1 - exponent, 0)


def significant(value: float, digits: int = 3) -> str:
    """A number with this number of significant digits, without an exponent up to a million."""
    if not math.isfinite(value):
        return "-" if math.isnan(value) else "inf"
    return f"{value:.{decimals_of(abs(value), digits)}f}" if abs(value) < 1e6 else f"{value:.0e}"


def with_error(value: float, half: float) -> tuple[str, str]:
    """A value and half the width of its interval, both with the decimals at which the latter has two digits.

    Where there is no interval, the value has three digits and the second text is empty.
    """
    if not (math.isfinite(value) and math.isfinite(half)) or half == 0 or abs(value) >= 1e6:
        return significant(value), ""
    decimals = decimals_of(half)
    return f"{value:.{decimals}f}", f"{half:.{decimals}f}"


def formed_table(form: str, header: Sequence[str], rows: Sequence[Sequence[str]], caption: str = "") -> str:
    """A table for a terminal, a spreadsheet or a paper, names on the left and numbers on the right.

    Args:
        form: ``"text"``, ``"csv"``, ``"latex"`` (for the package ``booktabs``) or ``"markdown"``.
        header: a title for each column.
        rows: a cell for each column; ``**bold**`` is bold where the form knows that, and ``+-`` a plus-minus sign.
        caption: what the table is of; LaTeX and Markdown have it.

    Raises:
        ValueError: another form, or a row of another length than the header.
    """
    if form not in FORMS:
        raise ValueError(f"form: expected one of {', '.join(FORMS)}, received {form!r}")
    if bad := [row for row in rows if len(row) != len(header)]:
        raise ValueError(f"rows: expected {len(header)} cells in each, received {len(bad[0])}")
    if form == "text":
        return text_table(header, [[cell.replace("**", "") for cell in row] for row in rows])
    if form == "csv":
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([header, *([c.replace("**", "") for c in row] for row in rows)])
        return text.getvalue()
    return _latex(header, rows, caption) if form == "latex" else _markdown(header, rows, caption)


def _markdown(header: Sequence[str], rows: Sequence[Sequence[str]], caption: str) -> str:
    lines = [[printable(cell).replace("|", r"\|").replace("+-", "\u00b1") for cell in line] for line in (header, *rows)]
    lines.insert(1, ["---", *["---:"] * (len(header) - 1)])
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return f"{table}\n\n{caption}\n" if caption else f"{table}\n"


def _latex(header: Sequence[str], rows: Sequence[Sequence[str]], caption: str) -> str:
    title, *body = (" & ".join(map(_latex_cell, line)) + r" \\" for line in (header, *rows))
    begin = r"\begin{tabular}{l" + "r" * (len(header) - 1) + "}"
    table = [begin, r"\toprule", title, r"\midrule", *body, r"\bottomrule", r"\end{tabular}"]
    if caption:
        table = [r"\begin{table}", r"\centering", rf"\caption{{{_latex_cell(caption)}}}", *table, r"\end{table}"]
    return "\n".join(table) + "\n"


def _latex_cell(cell: str) -> str:
    """A cell with what LaTeX would take for its own escaped."""
    bold = cell.startswith("**") and cell.endswith("**") and len(cell) > 4
    text = "".join(_LATEX.get(c, c) for c in printable(cell.replace("**", ""), 10_000)).replace("+-", r"$\pm$")
    return rf"\textbf{{{text}}}" if bold else text
