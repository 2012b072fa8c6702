"""Results of an evaluation: the contents of a file, and tables as text."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from torchfra.catalogue import FILTERS
from torchfra.running.versions import versions
from torchfra.scenarios import Scenario
from torchfra.tables import in_words, printable, text_table

Result = dict[str, Any]
"""The figures of one filter; each target of a run of several counts as a track.

``rmse_position`` and so on for all ``Scenario.quantities`` over time ``[T]``, their means ``mean_rmse_*``,
``median_error_position`` over all steps and runs (to 0.05 %), of the root mean square errors of single runs the 5th
percentile ``p05_track_rmse``, ``median_track_rmse``, ``p95_track_rmse`` and ``worst_track`` (each that of a run), all
of them in ``rmse_of_runs`` if the runs are recordings, ``diverged`` and ``divergence_rate``, how many and which share
of the runs, ``failed``, how many of them have an estimate or an error that is not finite, ``nees_position`` (median, to
0.05 %; 1.39 of a consistent filter, in the plane), by coordinate and over time the signed ``mean_error_x``, ``rmse_x``
and ``mape_x`` (mean relative error, %, of coordinates of 100 m or more), the models' mean ``probabilities``
``[T][K]`` if there are some, ``microseconds`` per run and step, and ``relative_time`` to the UKF (``ukf_jpda`` on
scans) on the same runs; those of ``RunningMetrics.intervals``; and the ``limit`` above which a run has diverged, m.
"""

BASELINE = "srckf"
"""The plain filter that others are compared with."""

_COLUMNS = (
    ("RMSE m", "mean_rmse_position", 1),
    ("RMSE m/s", "mean_rmse_velocity", 2),
    ("median m", "median_error_position", 1),
    ("worst run m", "worst_track", 0),
    ("diverged", "diverged", 0),
    ("NEES", "nees_position", 2),
    ("us/step", "microseconds", 2),
)
"""Title, key and least decimals of each column."""
_POSITION = ("mean_rmse_position", "median_error_position", "worst_track")
"""Columns in metres."""
_MEANS = ("mean_rmse_position", "mean_rmse_velocity", "worst_track")
"""Columns that are left out where the errors of diverged runs outweigh all others."""


def report(scenario: Scenario, results: dict[str, Result], *, runs: int, seed: int) -> dict[str, Any]:
    """Contents of a results file: scenario, settings, versions, and the results.

    Args:
        scenario: what was tracked.
        results: from ``evaluate``.
        runs: how many there were.
        seed: of the random numbers.
    """
    settings = {"dt": scenario.mean_dt, "steps": scenario.steps, "threads": torch.get_num_threads()}
    return {
        "experiment": scenario.name,
        "runs": runs,
        "seed": seed,
        "settings": {**settings, **scenario.settings},
        "versions": versions(),
        "filters": results,
    }


def table(results: dict[str, Result], *, every: bool = True) -> str:
    """The results as text, one line per filter, with a description of it.

    Where runs diverged so far that the mean error is above the limit, the means are left out.

    Args:
        results: by the names of filters.
        every: a line for each of them; if not, filters whose errors over time are the same, to a hundredth, share one.
    """
    forms = [f".{_decimals(results, key, decimals)}f" for _, key, decimals in _COLUMNS]
    rows = []
    for name, alike in (dict.fromkeys(results, ()) if every else families(results)).items():
        result = results[name]
        far = result["diverged"] and not result["mean_rmse_position"] <= result["limit"]
        pairs = zip(_COLUMNS, forms, strict=True)
        cells = [
            "-" if far and key in _MEANS and math.isfinite(result[key]) else f"{result[key]:{form}}"
            for (_, key, _), form in pairs
        ]
        words = (FILTERS[name].words if name in FILTERS else "") + (f"; the same: {', '.join(alike)}" if alike else "")
        rows.append([name, *cells, words])
    align = f"<{'>' * len(_COLUMNS)}<"
    return text_table(["filter", *(title for title, _, _ in _COLUMNS), "which is"], rows, align=align)


def recordings_table(results: dict[str, Result], scenario: Scenario) -> str:
    """The root mean square position error of each filter on each recording, m, as text.

    Args:
        results: from ``evaluate``, with ``rmse_of_runs``.
        scenario: with ``recordings``.
    """
    runs = len(next(iter(results.values()))["rmse_of_runs"])
    repairs = scenario.settings.get("repairs")  # tracks of the caller have none
    named = zip(scenario.recordings[:runs], repairs if isinstance(repairs, Sequence) else [{}] * runs, strict=False)
    lines = [
        f"{number}: {printable(name)}" + (f"; repairs: {in_words(of)}" if of else "")
        for number, (name, of) in enumerate(named, 1)
    ]
    rows = [
        [name, *(_two_digits(error) for error in of["rmse_of_runs"]),
         _two_digits(sum(of["rmse_of_runs"]) / runs), _two_digits(of["median_error_position"]),
         f"{of['diverged']}", f"{of['nees_position']:.2f}", f"{of['microseconds']:.2f}"]
        for name, of in results.items()
    ]  # fmt: skip
    header = ["RMSE m", *map(str, range(1, runs + 1)), "mean", "median m", "diverged", "NEES", "us/step"]
    return "\n".join([*lines, text_table(header, rows)])


def _two_digits(error: float) -> str:
    return f"{error:.2f}" if error < 1e6 else f"{error:.0e}"


def families(results: dict[str, Result]) -> dict[str, tuple[str, ...]]:
    """Filters by the first of those with the same errors over time, to a hundredth."""
    found: dict[str, tuple[str, ...]] = {}
    for name, result in results.items():
        first = next((other for other in found if _alike(result, results[other])), None)
        if first is None:
            found[name] = ()
        else:
            found[first] = (*found[first], name)
    return found


def headline(results: dict[str, Result], runs: int) -> str:
    """A sentence with the error of the first filter, of the best of the others and of the plain one."""
    first, *others = results
    diverged = results[first]["diverged"]
    count = f"{diverged} of {runs} runs" if diverged else "no run"
    words = f"{first}: {_metres(results[first])}, {count} diverged"
    best = min(others, key=lambda name: infinite(results[name]["mean_rmse_position"]), default=None)
    if best is not None:
        words += f"; best of the others: {best}, {_metres(results[best])}"
    if BASELINE in results and BASELINE not in (first, best):
        words += f"; plain {BASELINE}: {_metres(results[BASELINE])}"
    return words


def _metres(result: Result) -> str:
    error = result["mean_rmse_position"]
    return f"{error:.{0 if error >= 10 else 2}f} m" if error < 1e6 else "more than 1000 km"


def not_finite(results: dict[str, Result]) -> list[str]:
    """A message for each filter that has infinite errors, or NaN estimates, in some runs."""
    return [
        f"{name}: not finite in {count} {'run' if count == 1 else 'runs'}"
        for name, result in results.items()
        if (count := result["failed"])
    ]


def _decimals(results: dict[str, Result], key: str, least: int) -> int:
    """Decimals of a column: more than ``least`` where errors of positions are below 10 m."""
    smallest = min(result[key] for result in results.values())
    return max(least, 2 if smallest >= 1 else 3) if key in _POSITION and smallest < 10 else least


def leaders(results: dict[str, Result], most: int = 5) -> list[str]:
    """The most informative filters, at most ``most``.

    They are the first one, the plain baseline, those that are not in the catalogue (learned values, say), and the
    best of the others by ``mean_rmse_position``, but none whose errors over time are those of one before it.
    """
    own = [name for name in results if name not in FILTERS]
    chosen = list(dict.fromkeys([next(iter(results)), *([BASELINE] if BASELINE in results else []), *own]))
    for name in sorted(results, key=lambda name: infinite(results[name]["mean_rmse_position"])):
        if name not in chosen and not any(_alike(results[name], results[other]) for other in chosen):
            chosen.append(name)
    return chosen[:most]


def infinite(error: float) -> float:
    """The error, with infinity for NaN, so that a filter without an error comes last."""
    return math.inf if math.isnan(error) else error


def _alike(one: Result, other: Result) -> bool:
    """Whether two filters have the same errors over time, to a hundredth."""
    return np.allclose(one["rmse_position"], other["rmse_position"], rtol=1e-2, atol=0.0, equal_nan=True)
