"""Filters whose process noise and threshold are searched for a cell: how well a specialist does there."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchfra import metrics
from torchfra.evaluation import run
from torchfra.filters import Filter
from torchfra.hyper import Hyper, hypers
from torchfra.scenarios import Scenario, Tracks

RUNS = 64
"""Number of runs for the search."""
STEPS = (4.0, 2.0, 1.3)
"""Factors by which a value is changed, one after the other, as long as the error falls."""
PAYS = 0.999
"""Largest ratio of a new error to the old one that counts as a gain."""


def tune(f: Filter, scenario: Scenario, runs: int, seed: int) -> dict[str, float]:
    """Searches the variance of the process noise (of all motions together) and a robust threshold, if there is one.

    Each in turn goes up or down by a factor as long as the mean position RMSE of the runs falls; twice with each.

    Args:
        f: changed in place.
        scenario: the cell.
        runs: to search on.
        seed: of their random numbers.

    Returns:
        By which factors its values have changed.
    """
    tracks = scenario.simulate(runs, seed)
    groups = groups_of(f)
    factors = dict.fromkeys(groups, 1.0)
    best = error_of(f, scenario, tracks)
    for step in STEPS:
        for name in [*groups, *groups]:
            for factor in (step, 1 / step):
                before = best
                while (error := error_after(f, groups[name], factor, scenario, tracks)) < PAYS * best:
                    best, factors[name] = error, factors[name] * factor
                scale(groups[name], 1 / factor)  # the last one did not pay
                if best < before:
                    break
    return factors


def groups_of(f: Filter) -> dict[str, list[Hyper]]:
    """The values that are searched, those that go together in one list."""
    found: dict[str, list[Hyper]] = {}
    for path, value in hypers(f).items():
        name = path.rpartition(".")[2]
        if name in ("q", "threshold"):
            found.setdefault(name, []).append(value)
    return found


def scale(values: Sequence[Hyper], factor: float) -> None:
    """Multiplies the values."""
    for value in values:
        value.set(factor * value())


def error_after(f: Filter, values: Sequence[Hyper], factor: float, scenario: Scenario, tracks: Tracks) -> float:
    """The error with the values multiplied."""
    scale(values, factor)
    return error_of(f, scenario, tracks)


def error_of(f: Filter, scenario: Scenario, tracks: Tracks) -> float:
    """The mean position RMSE over time, as the table has it; infinite if it is no number."""
    with torch.no_grad():
        error = metrics.error(run(f, scenario, tracks).mean, tracks.truth, scenario.truth_position)
    mean: Tensor = error.square().nanmean(0).sqrt().nanmean()
    return mean.item() if mean.isfinite() else math.inf


def specialists(
    filters: Mapping[str, Filter], scenario: Scenario, seed: int
) -> tuple[dict[str, Filter], dict[str, dict[str, float]]]:
    """Copies of filters by what they are called in tables, tuned, and by which factors their values have changed.

    Args:
        filters: by name.
        scenario: the cell.
        seed: of the runs that are not to be searched on.
    """
    found = {f"{name} tuned": copy.deepcopy(f) for name, f in filters.items()}
    return found, {name: tune(f, scenario, RUNS, seed + 1) for name, f in found.items()}
