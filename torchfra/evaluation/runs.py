"""Monte-Carlo runs of a scenario through filters: a dictionary of figures for each filter."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence

import torch
from torch import Tensor

from torchfra.catalogue import reference_filter, scenario_filters
from torchfra.evaluation.compiling import compiled
from torchfra.evaluation.fixes import fixes
from torchfra.evaluation.results import Result
from torchfra.evaluation.running_metrics import RunningMetrics
from torchfra.filters.base import Filter
from torchfra.numbers import as_number
from torchfra.running import distributed
from torchfra.running.progress import progress_bar
from torchfra.scenarios import Scenario, Tracks
from torchfra.steps.engine import INTERPRETED
from torchfra.types import Estimate, Fallback

MOST_RUNS = 10**9
"""Largest number of runs: more would take years, and more memory than there is."""
_FIRST = 5
"""Steps of a first call that is not timed."""
_DIVERGED = 10.0
"""A run has diverged if its error exceeds this multiple of the error of positions from single measurements."""
_SAMPLED_RUNS = 32
"""Largest number of runs that determine this error."""


def evaluate(
    scenario: Scenario,
    filters: Sequence[str] | Mapping[str, Filter],
    *,
    runs: int,
    seed: int = 0,
    limit: float | None = None,
    chunk: int = 1000,
    compile: bool = False,
    progress: bool = False,
) -> dict[str, Result]:
    """Runs of a scenario through filters; under ``torchrun`` the processes share the runs.

    Args:
        scenario: what is tracked.
        filters: names of ``catalogue.FILTERS``, or filters by any names.
        runs: number of runs.
        seed: of the random numbers; every filter has the same runs.
        limit: a run diverges when its position error, root mean square over time, is above this, m; None for
            ``scenario.limit``, and where that is None for ``divergence_limit``.
        chunk: runs that are filtered at once; bounds the memory, which does not grow with ``runs`` except one number
            per run, filter and metric.
        compile: whether to run compiled (``Filter.compile``); needs the extra ``compiler``.
        progress: whether to show a bar.

    Returns:
        For each filter its ``Result``; in every process that of all runs.

    Raises:
        ValueError: an unknown filter, fewer runs than processes, or a limit that is not above 0.
        CompileError: with ``compile``, if llvmlite is not installed or a filter has no kernel.
    """
    check_limit(limit)
    metrics = measure(scenario, filters, runs=runs, seed=seed, chunk=chunk, compile=compile, progress=progress)
    return results_of(metrics, filters, scenario, runs, limit)


def measure(
    scenario: Scenario,
    filters: Sequence[str] | Mapping[str, Filter],
    *,
    runs: int,
    seed: int = 0,
    chunk: int = 1000,
    compile: bool = False,
    fallback: Fallback | None = None,
    progress: bool = False,
    reference: bool = True,
) -> dict[str, RunningMetrics]:
    """Metrics of the filters, and of the reference for run times, with an error per run, which ``evaluate`` summarises.

    Arguments and errors are those of ``evaluate``, and two more.  With a ``fallback`` a filter that cannot be compiled
    runs interpreted, after a call with its name and the reason; ``reference`` is whether the reference runs too.
    """
    if not isinstance(filters, Mapping):
        filters = scenario_filters(filters, scenario)
    timed = (scenario_filters([reference_filter(scenario)], scenario) if reference else {}) | dict(filters)
    _check(runs, chunk)
    if compile:
        one = scenario.simulate(1, seed)
        timed = compiled(timed, lambda f: run(f, scenario, one), fallback=fallback, progress=progress)
    return _merged(_accumulate(scenario, timed, distributed.share(runs), seed, chunk, progress))


def results_of(
    metrics: Mapping[str, RunningMetrics],
    names: Iterable[str],
    scenario: Scenario,
    runs: int,
    limit: float | None = None,
) -> dict[str, Result]:
    """The ``Result`` of each named filter, from the metrics of ``measure`` for ``runs`` runs.

    Other arguments are those of ``evaluate``.
    """
    reference = metrics.get(reference_filter(scenario), next(iter(metrics.values()))).seconds
    limit = divergence_limit(scenario) if limit is None else limit

    def result(of: RunningMetrics) -> Result:
        times = {"microseconds": of.seconds / (runs * scenario.steps) * 1e6, "relative_time": of.seconds / reference}
        each = {"rmse_of_runs": of.errors().tolist()} if scenario.recordings else {}
        return of.summary(limit) | times | each | of.intervals() | {"limit": limit}

    return {name: result(metrics[name]) for name in names}


def _check(runs: int, chunk: int) -> None:
    if runs < (processes := distributed.size()):
        each = f", one for each of {processes} processes" if processes > 1 else ""
        raise ValueError(f"runs: expected {processes} or more{each}, received {runs}")
    if runs > MOST_RUNS:
        raise ValueError(f"runs: expected at most {MOST_RUNS:,}, of each of which there is an error, received {runs:,}")
    if chunk < 1:
        raise ValueError(f"chunk: expected 1 or more, received {chunk}")


def run(f: Filter, scenario: Scenario, tracks: Tracks) -> Estimate:
    """The tracks of a scenario through one filter, in the coordinates of the truth."""
    estimate: Estimate = f(tracks.z, tracks.prior, u=tracks.u, dt=scenario.dt)
    return scenario.cartesian(estimate)


def _accumulate(
    scenario: Scenario, filters: Mapping[str, Filter], share: range, seed: int, chunk: int, progress: bool
) -> dict[str, RunningMetrics]:
    """Metrics of the runs of this process."""
    metrics = {name: RunningMetrics(scenario.quantities) for name in filters}
    with torch.no_grad():
        first_call = scenario.simulate(min(len(share), chunk), seed)
        for f in filters.values():  # not timed: it allocates memory, and compiles filters for tracks of this length
            run(f, scenario, _beginning(first_call) if f.engine is INTERPRETED else first_call)
        for first in progress_bar(share[::chunk], f"{chunk} runs", progress):
            tracks = scenario.simulate(min(chunk, share.stop - first), seed, first=first)
            z = tracks.z if tracks.z.dim() == 3 else None  # an innovation of a scan belongs to several measurements
            for name, f in filters.items():
                start = time.perf_counter()
                estimate, seconds = run(f, scenario, tracks), time.perf_counter() - start
                metrics[name].add(estimate, tracks.truth, seconds, z)
                del estimate  # before the next one is made
    return metrics


def _beginning(tracks: Tracks) -> Tracks:
    """The first steps: enough for an interpreted filter."""
    u = tracks.u if tracks.u is None else tracks.u[..., :_FIRST, :]
    return tracks._replace(truth=tracks.truth[..., :_FIRST, :], z=tracks.z[:, :_FIRST], u=u)


def _merged(metrics: dict[str, RunningMetrics]) -> dict[str, RunningMetrics]:
    """Metrics of the runs of all processes."""
    first, *others = distributed.gathered(metrics)
    for other in others:
        for name, of in other.items():
            first[name].merge(of)
    return first


# ---------------------------------------------------------------- divergence


def check_limit(limit: float | None) -> None:
    """Checks the limit of a user; None for none.

    Raises:
        ValueError: no number above 0.
    """
    if limit is not None and not as_number(limit) > 0:
        raise ValueError(f"limit: expected metres above 0, received {limit!r}")


def divergence_limit(scenario: Scenario) -> float:
    """The position error, root mean square over time, above which a run of a scenario has diverged, m.

    It is that of the scenario, ``Scenario.limit``; where it has none, ten times the median distance from the truth of
    the positions that single measurements imply, or where they imply none the standard deviation of the prior.  The
    median does not depend on outliers.
    """
    if scenario.limit is not None:
        return scenario.limit
    tracks = scenario.simulate(min(_SAMPLED_RUNS, len(scenario.recordings) or _SAMPLED_RUNS))
    off = _off(scenario, tracks)
    known = off[off.isfinite()]
    if len(known):
        return _DIVERGED * float(known.median())
    root = tracks.prior.scale_tril[..., scenario.motion.position, :]
    return _DIVERGED * float(root.square().sum((-1, -2)).sqrt().median())


def _off(scenario: Scenario, tracks: Tracks) -> Tensor:
    """Distance of the position that a measurement implies from the truth; in scans, the nearest one to each target."""
    truth = tracks.truth[..., scenario.truth_position]
    targets = truth.unsqueeze(1) if truth.dim() == 3 else truth  # (B, N, T, d)
    off = (fixes(scenario, tracks).unsqueeze(1) - targets.unsqueeze(3)).norm(dim=-1)
    return torch.where(off.isnan(), torch.inf, off).amin(-1)
