"""A run for a map: its choice, the part that is shown, and the points and lines."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchfra.angles import wrap
from torchfra.evaluation.fixes import deviations, fixes
from torchfra.evaluation.runs import run
from torchfra.filters.base import Filter
from torchfra.pictures import MappedRun
from torchfra.scenarios import Scenario

OUTLYING = 4.0
"""Standard deviations, as the sensor states them, beyond which a measurement is an outlier: 1 in 16,000 inliers."""
_CANDIDATES = 25
"""Number of runs around the median among which one with a turn is chosen."""
_SHORTEST = 20
"""Steps of the shortest part that is shown."""
_VISIBLE = 1 / 30
"""Least visible size of an error, as a share of the map."""


def mapped_run(
    scenario: Scenario, filters: Mapping[str, Filter], rmse: Sequence[Tensor], seed: int, number: int | None = None
) -> MappedRun | None:
    """A run of a scenario through filters, as a map shows it.

    Where errors would be too small to be seen on the whole run, it is the part around the largest error of a
    measurement, or of an estimate if errors of measurements are unknown.

    Args:
        scenario: what is tracked.
        filters: whose estimates are shown.
        rmse: of one or two filters, the position error of each run (``RunningMetrics.errors``), by which the run is
            chosen: see ``typical_run``.
        seed: of the random numbers.
        number: of the run; None for the typical one.

    Returns:
        None if there is no map: the position has one dimension, or the true one is unknown.
    """
    if scenario.motion.dims < 2:
        return None
    number = typical_run(scenario, rmse, seed) if number is None else number
    tracks = scenario.simulate(1, seed, first=number)
    truth, off = _plane(scenario, tracks.truth), deviations(scenario, tracks)[0]
    if not truth.isfinite().any():
        return None
    with torch.no_grad():
        paths = {name: _plane(scenario, run(f, scenario, tracks).mean) for name, f in filters.items()}
    part = _part(truth, torch.stack(list(paths.values())), off)
    paths = {name: path[:, part] for name, path in paths.items()}
    name = scenario.recordings[number] if scenario.recordings else f"run {number}"
    places, outlying = fixes(scenario, tracks)[0, part, :, :2], off[part] > OUTLYING
    return MappedRun(number, name, scenario.time[part], truth[:, part], places, outlying, paths)


def typical_run(scenario: Scenario, rmse: Sequence[Tensor], seed: int) -> int:
    """The number of a run that is typical and has an outlier and a turn, if there is one.

    Candidates are the runs in which the ratio of the second filter's error to the first's is about its median (or the
    error of a single filter).  Among those with an outlier, or among all if none has one, it is the run whose target
    comes closest to a turn by 180 degrees around it.

    Args:
        scenario: what is tracked.
        rmse: of one or two filters, ``(runs,)`` or of ``N`` targets ``(runs N,)``.
        seed: of the random numbers.
    """
    ratio = rmse[-1] / rmse[0] if len(rmse) > 1 else rmse[0]
    middle, half = len(ratio) // 2, _CANDIDATES // 2
    targets = len(_plane(scenario, scenario.simulate(1, seed).truth))
    runs = sorted({int(i) // targets for i in ratio.argsort(stable=True)[max(0, middle - half) : middle + half + 1]})

    def uninteresting(number: int) -> tuple[bool, float]:
        tracks = scenario.simulate(1, seed, first=number)
        off, worst = deviations(scenario, tracks)[0].amax(-1).max(0)
        near = _around(int(worst), _SHORTEST, scenario.steps)
        return bool(off <= OUTLYING), abs(math.pi - _turn(_plane(scenario, tracks.truth)[:, near]))

    return min(runs, key=uninteresting)


def _plane(scenario: Scenario, states: Tensor) -> Tensor:
    """Horizontal positions ``(N, T, 2)`` of one run ``(1, T, n)`` or ``(1, N, T, n)``."""
    return states[..., scenario.truth_position][..., :2].flatten(0, -3)


def _part(truth: Tensor, paths: Tensor, off: Tensor) -> slice:
    """The steps to show of paths ``(F, N, T, 2)``: halved until errors are visible."""
    known = int(truth.isfinite().all(-1).any(0).nonzero().amax()) + 1
    error = (paths - truth).norm(dim=-1)
    most = off.amax(-1) if off.any() else error.nan_to_num().amax((0, 1))
    worst, length = int(most.argmax()), known
    while length // 2 >= _SHORTEST and error.nanmedian() < _VISIBLE * _extent(truth[:, _around(worst, length, known)]):
        length //= 2
    return _around(worst, length, known)


def _around(step: int, length: int, steps: int) -> slice:
    """``length`` steps, a third of which is before ``step``, within all steps."""
    first = max(0, min(step - length // 3, steps - length))
    return slice(first, min(first + length, steps))


def _extent(path: Tensor) -> Tensor:
    """The larger side of the box around paths ``(N, T, 2)``."""
    path = path.flatten(0, 1)
    return (path.nan_to_num(nan=-torch.inf).amax(0) - path.nan_to_num(nan=torch.inf).amin(0)).amax()


def _turn(path: Tensor) -> float:
    """The angle by which paths ``(N, T, 2)`` turn to one side, rad; the largest over the targets."""
    east, north = path.diff(dim=1).unbind(-1)
    return float(wrap(torch.atan2(east, north).diff(dim=1)).nansum(-1).abs().amax())
