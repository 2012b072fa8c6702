"""The table of a comparison: for each filter values, and half the widths of their intervals, by titles of columns."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

from torchfra.evaluation.results import Result
from torchfra.tables import formed_table, significant, with_error

FORMS = {".txt": "text", ".csv": "csv", ".tex": "latex", ".md": "markdown"}
"""Forms of tables by the endings of files."""
Row = dict[str, tuple[str, str]]


def errors_row(of: Result, quantities: Iterable[str]) -> Row:
    """Cells with the errors of a filter."""
    row: Row = {}
    for quantity in quantities:
        row[_title(quantity)] = _cell(of[f"mean_track_rmse_{quantity}"])
        if quantity == "position":
            row["median run m"] = (significant(of["median_track_rmse_position"][0]), "")
    lost = 100 * of["divergence_rate"]
    row["diverged %"] = (significant(lost, 2) if lost else "0", "")
    return row | {"ANEES": _cell(of["anees"])}


def likelihood_row(of: Result) -> Row:
    """Cells with the log likelihood of the measurements under a filter."""
    return {"log likelihood": _cell(of["mean_log_likelihood"])}


def last_row(of: Result, efficiency: float, p: str) -> Row:
    """Cells at the end of either row; ``efficiency`` is the bound as a share of the error."""
    innovations = {"ANIS": _cell(of["anis"])} if "anis" in of else {}
    share = significant(100 * efficiency, 3 if efficiency >= 0.1 else 2)
    return innovations | {"bound %": (share, ""), "p": (p, ""), "us/step": (significant(of["microseconds"], 2), "")}


def formed(form: str, rows: Mapping[str, Row], good: Collection[str], caption: str) -> str:
    """The table of all rows, without columns that are empty; the first number of ``good`` filters is bold.

    Raises:
        ValueError: an unknown form.
    """
    titles = [title for title in next(iter(rows.values())) if any(row[title] != ("-", "") for row in rows.values())]
    if form == "csv":
        halved = [title for title in titles if any(row[title][1] for row in rows.values())]
        columns = [c for title in titles for c in ([title, f"{title} +-"] if title in halved else [title])]
        table = [
            [name, *(cell for title in titles for cell in row[title][: 1 + (title in halved)])]
            for name, row in rows.items()
        ]
        return formed_table(form, ["filter", *columns], table)
    table = []
    for name, row in rows.items():
        first, *others = (" +- ".join(filter(None, row[title])) for title in titles)
        table.append([name, f"**{first}**" if name in good else first, *others])
    return formed_table(form, ["filter", *titles], table, caption)


def table_form(path: Path) -> str:
    """The form of a table by the ending of its file.

    Raises:
        ValueError: a name that ends in none of ``FORMS``.
    """
    if path.suffix not in FORMS:
        raise ValueError(f"table: expected a file that ends in {', '.join(FORMS)}, received {path}")
    return FORMS[path.suffix]


def told_p(value: float) -> str:
    """The p of a test in few characters."""
    return f"{value:.3f}" if value >= 0.001 else f"{value:.0e}" if value >= 1e-99 else "0"


def _title(quantity: str) -> str:
    return f"run RMSE {({'position': 'm', 'velocity': 'm/s'}).get(quantity, quantity)}"


def _cell(interval: list[float]) -> tuple[str, str]:
    value, low, high = interval
    return with_error(value, (high - low) / 2)
