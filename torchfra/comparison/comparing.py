"""``torchfra.compare``: filters on the same runs, in a line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from torchfra.catalogue import scenario_filters
from torchfra.comparison.comparison import Comparison
from torchfra.evaluation.runs import check_limit, measure, results_of
from torchfra.filters.base import Filter
from torchfra.numbers import is_integer
from torchfra.scenarios import Bound, Scenario, Tracks, given
from torchfra.scenarios import bound as bound_on

MOST_FOR_BOUND = 500
"""Runs that expectations of a bound are over at most."""


def compare(
    filters: Mapping[str, Filter] | Sequence[str],
    data: Scenario | Tracks,
    *,
    runs: int | None = None,
    seed: int = 0,
    dt: float = 1.0,
    limit: float | None = None,
    compile: bool = False,
    bound: bool = True,
    chunk: int = 1000,
    progress: bool = False,
) -> Comparison:
    """Filters on the same runs: errors with intervals, paired tests, consistency, the bound, a table and a figure.

    Args:
        filters: by any names, or names of the catalogue.
        data: a scenario, or tracks of one's own; where no truth is known, measurements are compared by how likely each
            filter held them to be.
        runs: how many; None for 100 of a scenario, and each track once.
        seed: of the random numbers; every filter sees the same runs.
        dt: seconds per step of ``Tracks``; a scenario has its own.
        limit: a run diverges when its position error, root mean square over time, is above this, m; None for that of
            the scenario, or one that follows its scale (``torchfra.evaluation.divergence_limit``).
        compile: whether to run compiled; a filter that cannot be runs interpreted.
        bound: whether to compute the Cramer-Rao bound, where it is known.
        chunk: runs that are filtered at once; bounds the memory.
        progress: whether to show a bar.

    Raises:
        ValueError: no filter, an unknown name, data that is neither a scenario nor tracks, tracks that do not fit, or a
            number out of its range.

    Example::

        comparison = torchfra.compare(["gpb", "srckf"], torchfra.scenarios.bearings_outliers(), runs=200)
        print(comparison)
        comparison.plot("errors.pdf")
    """
    filters = [filters] if isinstance(filters, str) else filters
    _check(filters, runs, seed, limit, chunk)
    scenario = _scenario(filters, data, dt)
    chosen = dict(filters) if isinstance(filters, Mapping) else scenario_filters(filters, scenario)
    if runs is None:
        runs = len(scenario.recordings) or 100
    metrics = measure(
        scenario, chosen, runs=runs, seed=seed, chunk=chunk, compile=compile, progress=progress, reference=False,
        fallback=lambda name, reason: None,
    )  # fmt: skip
    results = results_of(metrics, chosen, scenario, runs, limit)
    return Comparison(scenario, runs, seed, results, metrics, bound_of(scenario, runs, seed) if bound else None)


def _check(
    filters: Mapping[str, Filter] | Sequence[str], runs: int | None, seed: int, limit: float | None, chunk: int
) -> None:
    if not isinstance(filters, Mapping | list | tuple) or not all(isinstance(name, str) for name in filters):
        raise ValueError(f"filters: expected names, or filters by name, received {filters!r:.80}")
    if isinstance(filters, Mapping):
        if not filters:
            raise ValueError("filters: expected one or more, received none")
        for name, f in filters.items():
            if not isinstance(f, Filter):
                raise ValueError(f"filters: expected a Filter as {name}, received {type(f).__name__}")
    for name, value, least in (("runs", 1 if runs is None else runs, 1), ("seed", seed, 0), ("chunk", chunk, 1)):
        if not is_integer(value, least):
            raise ValueError(f"{name}: expected a whole number of {least} or more, received {value!r}")
    check_limit(limit)


def bound_of(scenario: Scenario, runs: int, seed: int) -> Bound | None:
    """The bound of a scenario of so many runs; None where it is not known."""
    with torch.no_grad():
        return None if scenario.law is None else bound_on(scenario, runs=min(runs, MOST_FOR_BOUND), seed=seed)


def _scenario(filters: Mapping[str, Filter] | Sequence[str], data: Scenario | Tracks, dt: float) -> Scenario:
    """The data as a scenario; tracks get the models of the first filter."""
    if isinstance(data, Scenario):
        return data
    if not isinstance(data, Tracks):
        raise ValueError(f"data: expected a Scenario or Tracks (truth, z, u, prior), received {type(data).__name__}")
    if not isinstance(filters, Mapping):
        raise ValueError("filters: expected filters by name with Tracks, which have no models for the catalogue's")
    first = next(iter(filters.values()))
    return given(data, first.motion, first.sensor, dt=dt)
