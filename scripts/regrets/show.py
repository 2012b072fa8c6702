"""The regret table as text, its summary, and what its picture shows."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from regrets.ratios import KINDS
from torchfra.tables import printable, text_table

Cells = Mapping[str, dict[str, Any]]


def label(name: str) -> str:
    """What a filter is called in tables: learned values by their folder."""
    return Path(name).parent.name or name


def table(cells: Cells, compared: Sequence[str], kind: str) -> str:
    """A line for each compared filter in each cell."""
    rows = []
    for cell, result in cells.items():
        of = result[kind]
        best = of["filters"][of["best"]]
        for name in (name for name in compared if name in of["filters"]):
            one = of["filters"][name]
            rows.append([cell, of["best"], metres(best["rmse"]), label(name), metres(one["rmse"]),
                         regret(one["ratio"]), interval(one["interval"]), f"{one['lost']:.2%}"])  # fmt: skip
    header = [f"{kind}: cell", "best other", "RMSE m", "compared", "RMSE m", "regret", "95 %", "lost"]
    return text_table(header, rows, align="<<><>")


def summary(cells: Cells, compared: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Median and largest regret of each compared filter, the cell of the latter, and its largest share of lost runs."""
    found: dict[str, dict[str, Any]] = {}
    for kind in KINDS:
        found[kind] = {}
        for name in compared:
            of = {cell: result[kind]["filters"].get(name) for cell, result in cells.items()}
            ratio = {cell: one["ratio"] for cell, one in of.items() if one is not None}
            worst = max(ratio, key=ratio.__getitem__)
            found[kind][name] = {"median": median(ratio.values()) - 1, "worst": ratio[worst] - 1, "worst_cell": worst,
                                 "most_lost": max(one["lost"] for one in of.values() if one is not None)}  # fmt: skip
    return found


def summary_lines(of: Mapping[str, dict[str, Any]], kind: str) -> str:
    """The summary as text."""
    return "\n".join(
        f"{printable(label(name))}, {kind}: median regret {one['median']:+.1%}, worst {regret(1 + one['worst'])} "
        f"({printable(one['worst_cell'])}), lost at most {one['most_lost']:.2%}"
        for name, one in of[kind].items()
    )


def not_finite(cells: Cells) -> list[str]:
    """A message for each filter with an error in a cell that is not finite."""
    return [
        f"{cell}, {label(name)}, {kind}: an error that is not finite"
        for cell, result in cells.items()
        for kind in KINDS
        for name, of in result[kind]["filters"].items()
        if not math.isfinite(of["rmse"])
    ]


def panels(cells: Cells, compared: Sequence[str]) -> dict[str, tuple[list[str], list[list[float]]]]:
    """Columns and ratios of the picture: all filters filtered, and those that have a lagged estimate, lagged."""
    found = {}
    for kind in KINDS:
        names = dict.fromkeys([*compared, *(name for result in cells.values() for name in result[kind]["filters"])])
        if kind == "lagged":
            with_lag = {name for result in cells.values() for name in result["with_lag"]}
            names = dict.fromkeys(name for name in names if name in with_lag)
        nothing = {"ratio": float("nan")}
        values = [[r[kind]["filters"].get(name, nothing)["ratio"] for name in names] for r in cells.values()]
        if names:
            found[kind] = ([label(name) for name in names], values)
    return found


def metres(value: float) -> str:
    """To a millimetre up to 10 m, and to 0.1 m above."""
    return f"{value:.3f}" if value < 10 else f"{value:.1f}" if value < 1e6 else f"{value:.0e}"


def regret(ratio: float) -> str:
    """What a ratio to the best is above 1."""
    return f"{ratio - 1:+.1%}" if ratio < 100 else f"{100 * ratio:+.0e}%"


def interval(bounds: Sequence[float] | None) -> str:
    """Both bounds as regrets; nothing of a single run."""
    return "" if bounds is None else " to ".join(map(regret, bounds))
