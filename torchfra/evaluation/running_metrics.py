"""Metrics of many tracks, accumulated batch by batch: memory does not grow with their steps."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torchfra import metrics
from torchfra.linalg.triangular import marginal_root
from torchfra.metrics.statistics import chi_square_bounds, mean_interval, median_interval
from torchfra.types import Estimate

_DROPPED = 42
"""Lowest bits of a double's mantissa that the bins of a median ignore: ten remain, 0.1 % from edge to edge."""


class RunningMedian:
    """Median of nonnegative values in batches, to 0.05 %; NaN does not count.

    It is that of a histogram: nonnegative doubles are ordered like their bits, of which the leading ones are the bin.
    """

    def __init__(self) -> None:
        self.counts = torch.zeros(1 << (63 - _DROPPED), dtype=torch.int64)

    def add(self, values: Tensor) -> None:
        """Adds values, of any shape."""
        known = values[~values.isnan()].double().contiguous()
        bins = known.view(torch.int64) >> _DROPPED
        self.counts.index_add_(0, bins, torch.ones_like(bins))

    def merge(self, other: RunningMedian) -> None:
        """Adds the values of another median."""
        self.counts += other.counts

    def __call__(self) -> float:
        """The median so far; NaN before the first value."""
        below = self.counts.cumsum(0)
        total = int(below[-1])
        if total == 0:
            return torch.nan
        rank = (total + 1) // 2
        middle = int(torch.searchsorted(below, rank))
        low, high = (torch.tensor((middle + k) << _DROPPED).view(torch.float64).item() for k in (0, 1))
        if high == torch.inf or low == torch.inf:
            return low
        inside = int(self.counts[middle])
        return low + (rank - 0.5 - int(below[middle]) + inside) / inside * (high - low)


def _quantiles(track_rmse: Tensor) -> dict[str, float]:
    """Quantiles of the errors of single tracks, without interpolation; tracks without truth do not count."""
    ordered = track_rmse[~track_rmse.isnan()].sort().values
    ranks = {"p05_track_rmse": 0.05, "median_track_rmse": 0.5, "p95_track_rmse": 0.95, "worst_track": 1.0}
    if not len(ordered):
        return dict.fromkeys(ranks, torch.nan)
    return {name: ordered[max(math.ceil(share * len(ordered)), 1) - 1].item() for name, share in ranks.items()}


FLOOR = 100.0
"""Least denominator of a relative error of a coordinate, m."""


class RunningMetrics:
    """Errors and run time of one filter.

    Args:
        states: components of the state by name, ``"position"`` among them.
    """

    def __init__(self, states: Mapping[str, slice]) -> None:
        self.states = states
        self.sums: dict[str, Tensor] = {}
        """Sums over the tracks ``(T,)``: ``square_position`` and so on, of squared errors, with their number
        ``count_position``; ``nees`` and ``nis``, with their numbers of components ``nees_components`` and so on.  By
        coordinate ``(T, d)``: ``error``, ``square`` and ``share``; by model ``(T, K)``: ``probabilities``."""
        self.of_runs: dict[str, list[Tensor]] = {}
        """A number for each track: ``rmse_position`` and so on (over time), ``nees`` per component, ``nis`` per element
        and ``log_likelihood`` per measurement."""
        self.error, self.nees = RunningMedian(), RunningMedian()
        self.seconds = 0.0

    def add(self, estimate: Estimate, truth: Tensor, seconds: float, z: Tensor | None = None) -> None:
        """Adds tracks.

        Args:
            estimate: ``(B, T, n)``, or of several targets ``(B, N, T, n)``.
            truth: as the estimate, ``(B, T, n)`` or ``(B, N, T, n)``.
            seconds: run time.
            z: the measurements ``(B, T, m)``; None for scans, without figures of innovations.
        """
        if truth.dim() > 3:
            mean, root = estimate.mean.flatten(0, -3), estimate.scale_tril.flatten(0, -4)
            estimate, truth = estimate._replace(mean=mean, scale_tril=root), truth.flatten(0, -3)
        for name, states in self.states.items():
            error = metrics.error(estimate.mean, truth, states)
            square, known = error.square(), ~error.isnan()
            self._sum(f"square_{name}", square.nansum(0))
            self._sum(f"count_{name}", known.sum(0))
            self._keep(f"rmse_{name}", square.nanmean(-1).sqrt())
            if name == "position":
                self.error.add(error)
        self._add_consistency(estimate, truth, z)
        self._add_coordinates(estimate, truth[..., self.states["position"]])
        self.seconds += seconds

    def _add_consistency(self, estimate: Estimate, truth: Tensor, z: Tensor | None) -> None:
        """Adds errors and innovations squared, normalised by the covariances of the filter."""
        states = self.states["position"]
        nees = metrics.nees(estimate, truth, states)
        self.nees.add(nees)
        rank = (marginal_root(estimate.scale_tril, states).diagonal(dim1=-2, dim2=-1) != 0).sum(-1)
        self._add_squares("nees", nees, (~nees.isnan()) * rank)
        if z is not None:
            measured = (~z.isnan()).sum(-1) * ~estimate.nis.isnan()
            self._add_squares("nis", estimate.nis, measured)
            steps = (measured > 0).sum(-1)
            self._keep("log_likelihood", torch.where(measured > 0, estimate.log_likelihood, 0.0).sum(-1) / steps)

    def _add_squares(self, name: str, squares: Tensor, components: Tensor) -> None:
        """Adds normalised squares ``(B, T)`` with their numbers of components."""
        known = torch.where(components > 0, squares, 0.0)
        self._keep(name, known.sum(-1) / components.sum(-1))
        self._sum(name, known.sum(0))
        self._sum(f"{name}_components", components.to(known).sum(0))

    def _sum(self, name: str, values: Tensor) -> None:
        self.sums[name] = self.sums.get(name, 0) + values

    def _keep(self, name: str, values: Tensor) -> None:
        self.of_runs.setdefault(name, []).append(values)

    def _add_coordinates(self, estimate: Estimate, truth: Tensor) -> None:
        """Adds errors of each coordinate of the position, and the probabilities of models or regimes."""
        gap = estimate.mean[..., self.states["position"]] - truth
        gap = torch.where(gap.isnan() & ~truth.isnan(), torch.inf, gap)  # NaN in an estimate is an infinite error
        more = {"error": gap, "square": gap.square(), "share": gap.abs() / truth.abs().clamp_min(FLOOR)}
        if hasattr(estimate.info, "probabilities"):
            more["probabilities"] = estimate.info.probabilities
        for name, values in more.items():
            self._sum(name, values.nansum(0))

    def merge(self, other: RunningMetrics) -> None:
        """Adds the tracks of other metrics."""
        for name, total in other.sums.items():
            self._sum(name, total)
        for name, values in other.of_runs.items():
            self.of_runs[name] = self.of_runs[name] + values
        self.error.merge(other.error)
        self.nees.merge(other.nees)
        self.seconds += other.seconds

    def runs(self, name: str) -> Tensor:
        """A number for each track, in the order of ``add``: see ``of_runs``."""
        return torch.cat(self.of_runs[name])

    def errors(self) -> Tensor:
        """Position errors of all tracks, root mean square over time, in the order of ``add``."""
        return self.runs("rmse_position")

    def summary(self, limit: float) -> dict[str, Any]:
        """The metrics of all tracks, by the names that ``evaluate`` documents.

        Args:
            limit: root mean square position error from which a track has diverged, m.
        """
        track_rmse = self.errors()
        over_time = {name: (self.sums[f"square_{name}"] / self.sums[f"count_{name}"]).sqrt() for name in self.states}
        return {
            **{f"rmse_{name}": values.tolist() for name, values in over_time.items()},
            **{f"mean_rmse_{name}": values.nanmean().item() for name, values in over_time.items()},
            **self._coordinates(),
            "median_error_position": self.error(),
            **_quantiles(track_rmse),
            "failed": int(track_rmse.isposinf().sum()),
            "diverged": int((track_rmse > limit).sum()),
            "divergence_rate": (track_rmse > limit).double().mean().item(),
            "nees_position": self.nees(),
        }

    def _coordinates(self) -> dict[str, Any]:
        """Over time, for each coordinate: signed mean error, root mean square error, mean relative error (%)."""
        counts, over_time = self.sums["count_position"].unsqueeze(-1), {}
        means = {name: self.sums[name] / counts for name in ("error", "square", "share")}
        for i, axis in enumerate("xyz"[: means["error"].shape[-1]]):
            over_time[f"mean_error_{axis}"] = means["error"][:, i].tolist()
            over_time[f"rmse_{axis}"] = means["square"][:, i].sqrt().tolist()
            over_time[f"mape_{axis}"] = (100 * means["share"][:, i]).tolist()
        if "probabilities" in self.sums:
            over_time["probabilities"] = (self.sums["probabilities"] / len(self.errors())).tolist()
        return over_time

    def intervals(self) -> dict[str, Any]:
        """Intervals of 95 % over the runs, ``[value, low, high]``, and the consistency of covariances.

        Returns:
            ``mean_track_rmse_position``, ``median_track_rmse_position`` and so on, of the root mean square errors of
            single runs, for all quantities; ``mean_log_likelihood`` per measurement (not of scans); ``anees``, the mean
            normalised error squared of the position per component, and ``anis``, that of the innovations per element
            (not of scans), both 1 of a consistent filter.  ``anees_bounds`` and ``anis_bounds`` are those within which
            the mean of a step of such a filter lies with 95 % probability (chi-square); ``anees_inside`` and
            ``anis_inside`` are the shares of steps whose mean does.
        """
        found: dict[str, Any] = {}
        for name in self.states:
            errors = self.runs(f"rmse_{name}")
            found[f"mean_track_rmse_{name}"] = list(mean_interval(errors))
            found[f"median_track_rmse_{name}"] = list(median_interval(errors))
        if "log_likelihood" in self.of_runs:
            found["mean_log_likelihood"] = list(mean_interval(self.runs("log_likelihood")))
        for name in ("nees", "nis"):
            if name in self.sums:
                found |= _consistency(f"a{name}", self.sums[name], self.sums[f"{name}_components"])
                found[f"a{name}"] = list(mean_interval(self.runs(name)))
        return found


def _consistency(name: str, squares: Tensor, components: Tensor) -> dict[str, Any]:
    """The bounds of the step with the most components, and the share of steps within their own bounds."""
    known = components > 0
    if not bool(known.any()):
        return {f"{name}_bounds": [torch.nan, torch.nan], f"{name}_inside": torch.nan}
    bounds = {count: chi_square_bounds(count) for count in components[known].unique().tolist()}
    mean = squares[known] / components[known]
    pairs = torch.tensor([bounds[count] for count in components[known].tolist()], dtype=mean.dtype)
    inside = (mean >= pairs[:, 0]) & (mean <= pairs[:, 1])
    return {f"{name}_bounds": list(bounds[float(components.max())]), f"{name}_inside": inside.double().mean().item()}
