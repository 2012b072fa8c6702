"""Figures of many tracks, added up as they come: memory does not grow with their steps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torchfra import metrics
from torchfra.types import Estimate

_DROPPED = 42
"""Bits of a double's mantissa that the bins of a median do not tell apart: ten remain, 0.1 % from edge to edge."""


class Median:
    """Running median of numbers that are 0 or more, to 0.05 %; what is no number does not count.

    Doubles that are not negative are in the order of their bits, so that the leading bits are a bin.
    """

    def __init__(self) -> None:
        self.counts = torch.zeros(1 << (63 - _DROPPED), dtype=torch.int64)

    def add(self, values: Tensor) -> None:
        """More of them, of any shape."""
        known = values[~values.isnan()].double().contiguous()
        bins = known.view(torch.int64) >> _DROPPED
        self.counts.index_add_(0, bins, torch.ones_like(bins))

    def merge(self, other: Median) -> None:
        """Those that another has seen."""
        self.counts += other.counts

    def __call__(self) -> float:
        """The median so far; NaN of nothing."""
        below = self.counts.cumsum(0)
        total = int(below[-1])
        if total == 0:
            return torch.nan
        rank = (total + 1) // 2
        found = int(torch.searchsorted(below, rank))
        low, high = (torch.tensor((found + k) << _DROPPED).view(torch.float64).item() for k in (0, 1))
        if high == torch.inf or low == torch.inf:
            return low
        inside = (rank - 0.5 - int(below[found]) + int(self.counts[found])) / int(self.counts[found])
        return low + inside * (high - low)


class Tally:
    """Errors of one filter.

    Args:
        states: components of the state by name, ``"position"`` among them.
        floor: coordinates below count as this in relative errors, m.
    """

    def __init__(self, states: Mapping[str, slice], floor: float = 100.0) -> None:
        self.states, self.floor = states, floor
        self.squares: dict[str, Tensor] = {}
        self.counts: dict[str, Tensor] = {}
        self.sums: dict[str, Tensor] = {}
        self.tracks: list[Tensor] = []
        self.error, self.nees = Median(), Median()
        self.seconds = 0.0

    def add(self, estimate: Estimate, truth: Tensor, seconds: float) -> None:
        """More tracks: estimates and truth ``(B, T, n)`` or ``(B, N, T, n)``, and the time it took."""
        if truth.dim() > 3:
            mean, root = estimate.mean.flatten(0, -3), estimate.scale_tril.flatten(0, -4)
            estimate, truth = estimate._replace(mean=mean, scale_tril=root), truth.flatten(0, -3)
        for name, states in self.states.items():
            error = metrics.error(estimate.mean, truth, states)
            square, known = error.square(), ~error.isnan()
            self.squares[name] = self.squares.get(name, 0.0) + square.nansum(0)
            self.counts[name] = self.counts.get(name, 0) + known.sum(0)
            if name == "position":
                self.error.add(error)
                self.tracks.append(square.nanmean(-1).sqrt())
        self.nees.add(metrics.nees(estimate, truth, self.states["position"]))
        self._by_axis(estimate, truth[..., self.states["position"]])
        self.seconds += seconds

    def _by_axis(self, estimate: Estimate, truth: Tensor) -> None:
        """Sums over the tracks, for each coordinate of the position; and of the models' probabilities, ``(T, K)``."""
        gap = estimate.mean[..., self.states["position"]] - truth
        gap = torch.where(gap.isnan() & ~truth.isnan(), torch.inf, gap)
        more = {"error": gap, "square": gap.square(), "share": gap.abs() / truth.abs().clamp_min(self.floor)}
        if hasattr(estimate.info, "probabilities"):
            more["probabilities"] = estimate.info.probabilities
        for name, values in more.items():
            self.sums[name] = self.sums.get(name, 0.0) + values.nansum(0)

    def merge(self, other: Tally) -> None:
        """The tracks that another has seen."""
        for name in self.states:
            self.squares[name] = self.squares[name] + other.squares[name]
            self.counts[name] = self.counts[name] + other.counts[name]
        self.sums = {name: values + other.sums[name] for name, values in self.sums.items()}
        self.tracks += other.tracks
        self.error.merge(other.error)
        self.nees.merge(other.nees)
        self.seconds += other.seconds

    def summary(self, limit: float) -> dict[str, Any]:
        """Figures over all tracks; one is lost when its own root mean square error is above ``limit``, m."""
        own = torch.cat(self.tracks)
        over_time = {name: (self.squares[name] / self.counts[name]).sqrt() for name in self.states}
        return {
            **{f"rmse_{name}": values.tolist() for name, values in over_time.items()},
            **{f"mean_rmse_{name}": values.nanmean().item() for name, values in over_time.items()},
            **self._axes(),
            "median_error_position": self.error(),
            "median_track_rmse": own.nanmedian().item(),
            "worst_track": own.max().item(),
            "divergence_rate": (own > limit).double().mean().item(),
            "nees_position": self.nees(),
        }

    def _axes(self) -> dict[str, Any]:
        """Over time, for each coordinate: mean error with its sign, root mean square error, mean relative error (%)."""
        counts, over_time = self.counts["position"].unsqueeze(-1), {}
        means = {name: values / counts for name, values in self.sums.items()}
        for i, axis in enumerate("xyz"[: means["error"].shape[-1]]):
            over_time[f"mean_error_{axis}"] = means["error"][:, i].tolist()
            over_time[f"rmse_{axis}"] = means["square"][:, i].sqrt().tolist()
            over_time[f"mape_{axis}"] = (100 * means["share"][:, i]).tolist()
        if "probabilities" in self.sums:
            over_time["probabilities"] = (self.sums["probabilities"] / len(torch.cat(self.tracks))).tolist()
        return over_time
