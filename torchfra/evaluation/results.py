"""Results of an evaluation: what a file holds, and a table as text."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from torchfra.catalogue import FILTERS
from torchfra.running.versions import versions
from torchfra.scenarios import Scenario
from torchfra.tables import text_table

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
scans) on the same runs; what ``sureness`` adds; and the ``limit`` above which a run has diverged, m.
"""

BASELINE = "srckf"
"""The plain filter that others are compared with."""

_COLUMNS = (
    ("RMSE m", "mean_rmse_position", 1),
    ("RMSE m/s", "mean_rmse_velocity", 2),
    ("median m", "median_error_position", 1),
    ("worst run m", "worst_track", 0),
    ("diverged %", "divergence_rate", 2),
    ("NEES", "nees_position", 2),
    ("time / UKF", "relative_time", 2),
)
"""Title, key and least decimals of each column."""
_POSITION = ("mean_rmse_position", "median_error_position", "worst_track")
"""Columns in metres."""


def report(scenario: Scenario, results: dict[str, Result], *, runs: int, seed: int) -> dict[str, Any]:
    """What a results file holds: what was evaluated, with which settings and versions, and the results.

    Args:
        scenario: what was tracked.
        results: from ``evaluate``.
        runs: how many there were.
        seed: of the random numbers.
    """
    settings = {"dt": scenario.dt, "steps": scenario.steps, "threads": torch.get_num_threads(), **scenario.settings}
    return {
        "experiment": scenario.name,
        "runs": runs,
        "seed": seed,
        "settings": settings,
        "versions": versions(),
        "filters": results,
    }


def table(results: dict[str, Result]) -> str:
    """The results as text, one line per filter."""
    forms = [f".{_decimals(results, key, decimals)}f" for _, key, decimals in _COLUMNS]
    rows = [
        [name, *(_cell(result[key], key, form) for (_, key, _), form in zip(_COLUMNS, forms, strict=True))]
        for name, result in results.items()
    ]
    return text_table(["filter", *(title for title, _, _ in _COLUMNS)], rows)


def not_finite(results: dict[str, Result]) -> list[str]:
    """A message for each filter that has infinite errors, or NaN estimates, in some runs."""
    return [
        f"{name}: not finite in {count} {'run' if count == 1 else 'runs'}"
        for name, result in results.items()
        if (count := result["failed"])
    ]


def _decimals(results: dict[str, Result], key: str, least: int) -> int:
    """How many decimals a column gets: more than ``least`` where errors of positions are below 10 m."""
    smallest = min(result[key] for result in results.values())
    return max(least, 2 if smallest >= 1 else 3) if key in _POSITION and smallest < 10 else least


def _cell(value: float, key: str, form: str) -> str:
    value *= 100 if key == "divergence_rate" else 1
    return f"{value:{form}}" if value < 1e6 else f"{value:.0e}"


def leaders(results: dict[str, Result], most: int = 5) -> list[str]:
    """The filters to look at first, at most ``most``.

    They are the first one, the plain baseline, those that are none of the catalogue's (learned values, say), and the
    best of the others by ``mean_rmse_position``, but none whose errors over time are those of one before it.
    """
    own = [name for name in results if name not in FILTERS]
    chosen = list(dict.fromkeys([next(iter(results)), *([BASELINE] if BASELINE in results else []), *own]))
    for name in sorted(results, key=lambda name: _rank(results[name]["mean_rmse_position"])):
        if name not in chosen and not any(_alike(results[name], results[other]) for other in chosen):
            chosen.append(name)
    return chosen[:most]


def _rank(error: float) -> float:
    return math.inf if math.isnan(error) else error


def _alike(one: Result, other: Result) -> bool:
    """Whether two filters have the same errors over time, to a hundredth."""
    return np.allclose(one["rmse_position"], other["rmse_position"], rtol=1e-2, atol=0.0, equal_nan=True)
