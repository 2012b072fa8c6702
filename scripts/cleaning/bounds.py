"""Bounds on the figures, the cases within them, and the figures of all cases as text."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import fmean, median
from typing import Any, NamedTuple

from cleaning.figures import SHARES
from torchfra.tables import text_table

Figures = dict[str, Any]
RATIO = {1.0: 0.6, 5.0: 0.8, 10.0: 1.0}
"""Largest ratio of the error to that of the raw fixes, by period."""
OUTLIERS = {1.0: 0.99, 10.0: 0.95}
"""Least precision and recall of outliers beyond 6 sigma."""
TURNS, TURNS_UP_TO = 0.9, 5.0
"""Least precision and recall of the time of turns, up to this period, s."""


class Bound(NamedTuple):
    """A bound on a figure."""

    name: str
    figure: str
    low: float
    high: float
    of: str = "each"
    """Cases of the bound: ``"each"``, the ``"median"``, or ``"all"`` as one."""

    def holds(self, value: float) -> bool:
        """Whether this value is within."""
        return self.low <= value <= self.high


def bounds(period: float) -> list[Bound]:
    """The bounds at a period; between the stated periods, those of the next shorter one."""
    outliers = _at(OUTLIERS, period)
    turns = [Bound(f"{what} of turns", f"turn_{what}", TURNS, 1.0, "all") for what in ("precision", "recall")]
    return [
        Bound("error over that of the raw fixes", "of_raw", 0.0, _at(RATIO, period)),
        Bound("error over the best constant velocity's", "of_best", 0.0, 1.1),
        Bound("the same, median", "of_best", 0.0, 1.0, "median"),
        Bound("precision of outliers", "outlier_precision", outliers, 1.0, "all"),
        Bound("recall of outliers", "outlier_recall", outliers, 1.0, "all"),
        Bound("sigma found over true", "sigma_found", 0.9, 1.1),
        *(turns if period <= TURNS_UP_TO else []),
        *[Bound(f"{band} % band", f"band_{band}", band / 100 - 0.03, band / 100 + 0.03, "all") for band in (68, 95)],
        Bound("runs that fail", "failed", 0.0, 0.0),
    ]


def _at(values: dict[float, float], period: float) -> float:
    return values[max((known for known in values if known <= period), default=min(values))]


def verdicts(cases: Sequence[Figures]) -> list[dict[str, Any]]:
    """For each period and bound: whether it is met, in how many cases it holds, and the worst case."""
    found = []
    for period in sorted({case["period"] for case in cases}):
        here = [case for case in cases if case["period"] == period]
        for bound in bounds(period):
            values = {case["case"]: case[bound.figure] for case in here if case[bound.figure] is not None}
            if not values:
                continue
            middle, together = median(values.values()), _together(here, bound.figure)
            worst = max(values, key=lambda name: _off(values[name], bound))
            held = sum(bound.holds(value) for value in values.values())
            passed = {"each": held == len(values), "median": bound.holds(middle), "all": bound.holds(together)}
            found.append({
                "period": period, "bound": bound.name, "of": bound.of, "low": bound.low, "high": bound.high,
                "cases": len(values), "held": held, "all": together, "median": middle, "worst": values[worst],
                "worst_case": worst, "passed": passed[bound.of],
            })  # fmt: skip
    return found


def _together(cases: Sequence[Figures], figure: str) -> float:
    """Shares of all cases as one; of other figures the mean."""
    if figure in SHARES:
        part, whole = _sums(cases, figure)
        return float(part / whole)
    return fmean(case[figure] for case in cases if case[figure] is not None)


def _sums(cases: Sequence[Figures], figure: str) -> tuple[float, float]:
    """Numerator and denominator of a share, over all cases."""
    part, whole = (sum(case["counts"][name] for case in cases) for name in SHARES[figure])
    return part, whole


def _off(value: float, bound: Bound) -> float:
    """Distance of a value beyond its bound; negative within it."""
    return math.inf if math.isnan(value) else max(bound.low - value, value - bound.high)


# ---------------------------------------------------------------- as text


def cells(cases: Sequence[Figures]) -> dict[tuple[str, float, float], list[Figures]]:
    """The cases of each kind, period and noise."""
    found: dict[tuple[str, float, float], list[Figures]] = {}
    for case in cases:
        found.setdefault((case["kind"], case["period"], case["noise"]), []).append(case)
    return found


def table(cases: Sequence[Figures]) -> str:
    """A line for each kind, period and noise: medians with the worst of them, and shares of all."""
    rows = []
    for (kind, period, noise), here in cells(cases).items():
        rows.append([
            kind, f"{period:g}", f"{noise:g}", str(len(here)),
            *(text for figure in ("of_raw", "best_of_raw", "of_best") for text in _middle_and_worst(here, figure)),
            _middle_and_worst(here, "of_raw_up")[0] if here[0]["of_raw_up"] else "",
            *(_share(here, f"outlier_{what}") for what in ("precision", "recall")),
            "{:.2f} to {:.2f}".format(min(c["sigma_found"] for c in here), max(c["sigma_found"] for c in here)),
            *(_share(here, f"turn_{what}") for what in ("precision", "recall")),
            *(_share(here, f"band_{band}") for band in (68, 95)),
            str(sum(c["failed"] for c in here)),
        ])  # fmt: skip
    header = ["kind", "s", "m", "cases", "of raw", "worst", "best CV", "worst", "of best CV", "worst", "height",
              "outliers P",
              "R", "sigma", "turns P", "R", "68 %", "95 %", "failed"]  # fmt: skip
    return text_table(header, rows)


def cases_table(cases: Sequence[Figures]) -> str:
    """A line for each case."""
    columns = {"of raw": "of_raw", "best CV": "best_of_raw", "of best CV": "of_best",
               "outliers P": "outlier_precision", "R": "outlier_recall",
               "sigma": "sigma_found", "turns P": "turn_precision", "R ": "turn_recall", "68 %": "band_68",
               "95 %": "band_95"}  # fmt: skip
    rows = [
        [case["case"], *("" if case[name] is None else f"{case[name]:.3f}" for name in columns.values())]
        for case in cases
    ]
    return text_table(["case", *columns], rows)


def bounds_table(cases: Sequence[Figures]) -> str:
    """A line for each period and bound."""
    rows = [
        [f"{of['period']:g} s", of["bound"], of["of"], f"{of['low']:.3g} to {of['high']:.3g}",
         *(f"{of[name]:.3f}" for name in ("all", "median", "worst")), f"{of['held']} of {of['cases']}",
         "met" if of["passed"] else "MISSED", of["worst_case"]]
        for of in verdicts(cases)
    ]  # fmt: skip
    header = ["period", "asked", "of", "bounds", "all", "median", "worst", "held in", "", "worst case"]
    return text_table(header, rows, align="<<<<>>>><<")


def _middle_and_worst(here: Sequence[Figures], figure: str) -> tuple[str, str]:
    values = [case[figure] for case in here]
    return f"{median(values):.2f}", f"{max(values):.2f}"


def _share(here: Sequence[Figures], figure: str) -> str:
    """Percentage over all cases as one; empty without cases."""
    part, whole = _sums(here, figure)
    return f"{100 * part / whole:.1f}" if whole else ""
