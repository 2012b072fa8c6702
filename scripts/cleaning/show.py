"""The figures of all cases as text."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

from cleaning.bounds import Figures, verdicts
from cleaning.figures import SHARES
from torchfra.tables import text_table


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
    """Percent of all cases as one; nothing where there is nothing."""
    part, whole = (sum(case["counts"][name] for case in here) for name in SHARES[figure])
    return f"{100 * part / whole:.1f}" if whole else ""
