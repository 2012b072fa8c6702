"""Errors of all filters of a cell on the same runs, and their ratios to the best with intervals."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchfra import metrics
from torchfra.evaluation import run
from torchfra.filters import Filter
from torchfra.running.progress import progress_bar
from torchfra.scenarios import Scenario
from torchfra.types import Estimate

RESAMPLES = 1000
"""Bootstrap resamples of the runs, for an interval."""
KINDS = ("filtered", "lagged")
"""Estimates of a step from the measurements up to it, and with the next one where a filter decides late."""
_STEPS = 100_000
"""Steps of all runs that are filtered at once; bounds the memory."""
_LOST = 1e200
"""Squared error that stands for an infinite one, so that 0 times it is 0."""


def estimates_of(estimate: Estimate) -> dict[str, Tensor]:
    """Means ``(..., T, n)`` by kind; ``"lagged"`` only of a filter that has both.

    What ``info`` does not hold of ``filtered`` (or ``provisional``) and ``lagged`` is the estimate itself.
    """
    held = {name: getattr(estimate.info, name, None) for name in ("provisional", "filtered", "lagged")}
    filtered = held["filtered"] if held["provisional"] is None else held["provisional"]
    means = {"filtered": estimate.mean if filtered is None else filtered.mean}
    if filtered is not None or held["lagged"] is not None:
        means["lagged"] = estimate.mean if held["lagged"] is None else held["lagged"].mean
    return means


def draws(runs: int, seed: int, resamples: int = RESAMPLES) -> Tensor:
    """How often each run counts ``(1 + resamples, runs)``: once, and in each resample as often as it is drawn.

    Raises:
        ValueError: no run, or a seed below 0.
    """
    if runs < 1 or seed < 0:
        raise ValueError(f"runs, seed: expected at least 1 and 0, received {runs}, {seed}")
    rng = np.random.default_rng(seed)
    drawn = [np.bincount(rng.integers(runs, size=runs), minlength=runs) for _ in range(resamples)]
    return torch.from_numpy(np.stack([np.ones(runs, dtype=np.int64), *drawn]).astype(np.int32))


class Errors:
    """Position errors of one estimate, from blocks of runs: memory does not grow with their number.

    ``rmse`` is the mean over time of the root mean square error over the runs, as in ``torchfra compare``; of a single
    run the root mean square error over time.
    """

    def __init__(self, runs: int) -> None:
        self.runs = runs
        self.squares: Tensor | float = 0.0
        """Sums over the runs, ``(1 + resamples, T)``."""
        self.counts: Tensor | float = 0.0
        self.tracks: list[Tensor] = []
        """Root mean square error over time of each run."""

    def add(self, error: Tensor, counts: Tensor) -> None:
        """Adds runs.

        Args:
            error: ``(B, T)`` m; NaN where the truth is unknown, infinite where there is no estimate.
            counts: ``(1 + resamples, B)`` how often each of them counts.
        """
        square, weights = error.square().clamp(max=_LOST), counts.to(error)
        known = ~square.isnan()
        squares = weights @ square.nan_to_num()
        every = weights.sum(-1, keepdim=True).expand_as(squares)
        self.squares = self.squares + squares
        self.counts = self.counts + (every if known.all() else weights @ known.to(error))
        self.tracks.append(square.nanmean(-1).sqrt())

    def rmse(self) -> NDArray[np.float64]:
        """``(1 + resamples,)`` m: of all runs, and of each resample."""
        assert isinstance(self.squares, Tensor)
        assert isinstance(self.counts, Tensor)
        if self.runs == 1:
            values = (self.squares.sum(-1) / self.counts.sum(-1)).sqrt()
        else:
            values = (self.squares / self.counts).sqrt().nanmean(-1)
        return torch.where(values > _LOST**0.25, torch.inf, values).numpy()

    def lost(self, limit: float) -> float:
        """The share of runs whose root mean square error over time is above this, m."""
        return (torch.cat(self.tracks) > limit).double().mean().item()


def errors(
    scenario: Scenario, filters: Mapping[str, Filter], *, runs: int, seed: int, progress: bool = False
) -> dict[str, dict[str, Errors]]:
    """Errors by kind and filter; every filter sees the same runs."""
    counts = draws(runs, seed, RESAMPLES if runs > 1 else 0)
    found: dict[str, dict[str, Errors]] = {kind: {} for kind in KINDS}
    chunk = max(1, _STEPS // scenario.steps)
    with torch.no_grad():
        for first in progress_bar(range(0, runs, chunk), f"{chunk} runs", progress):
            tracks = scenario.simulate(min(chunk, runs - first), seed, first=first)
            for name, f in filters.items():
                for kind, mean in estimates_of(run(f, scenario, tracks)).items():
                    error = metrics.error(mean, tracks.truth, scenario.truth_position)
                    of = found[kind].setdefault(name, Errors(runs))
                    of.add(error, counts[:, first : first + chunk])
    return found


def ratio(rmse: NDArray[np.float64], other: NDArray[np.float64]) -> dict[str, Any]:
    """``ratio`` of one error to another, with its 95 % ``interval``, None of a single run."""
    with np.errstate(invalid="ignore"):
        of = rmse / other
    interval = np.quantile(of[1:], [0.025, 0.975], method="inverted_cdf").tolist() if len(of) > 1 else None
    return {"ratio": of[0].item(), "interval": interval}


def ratios(found: Mapping[str, Errors], compared: Collection[str], limit: float) -> dict[str, Any]:
    """The best filter that is not compared, and of every filter the ratio of its error to that one's.

    Args:
        found: of all filters, by name.
        compared: names of those that are no candidates for the best.
        limit: position error above which a run is lost, m.

    Returns:
        ``best``, and by filter ``rmse``, ``lost``, ``ratio`` and its 95 % ``interval`` (None of a single run), in which
        both filters have the same runs and the best stays the best.
    """
    rmse = {name: of.rmse() for name, of in found.items()}
    best = min((name for name in rmse if name not in compared), key=lambda name: rmse[name][0])
    filters = {}
    for name, values in rmse.items():
        filters[name] = {"rmse": values[0].item(), "lost": found[name].lost(limit), **ratio(values, rmse[best])}
    return {"best": best, "filters": filters}


def both_kinds(found: Mapping[str, Mapping[str, Errors]], compared: Collection[str], limit: float) -> dict[str, Any]:
    """``ratios`` by kind; among the lagged estimates are the filtered ones of filters that have no other."""
    filtered, lagged = found["filtered"], found["lagged"]
    of = {"filtered": filtered, "lagged": {**filtered, **lagged}}
    return {kind: ratios(of[kind], compared, limit) for kind in KINDS} | {"with_lag": list(lagged)}
