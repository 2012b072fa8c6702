"""A recorded track with its truth, and how good estimates of it are."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfra import metrics
from torchfra.filters import Filter, biased_copies, considered, protection_level
from torchfra.types import Estimate, Gaussian

Figures = dict[str, Any]


class Track(NamedTuple):
    """What sensors recorded of one target, and where it was."""

    name: str
    z: Tensor
    """``(T, m)`` measurements, NaN where there is none."""
    u: Tensor | None
    """``(T, k)`` what motion or sensor need to know."""
    dt: Tensor
    """``(T,)`` seconds that lead to each step."""
    truth: Tensor
    """``(T, dims)`` positions, m; NaN where unknown."""
    prior: Gaussian
    """Before the first step."""
    fixes: Tensor | None
    """``(T, 2)`` positions that were measured, to be drawn; None where none were."""
    published: Figures
    """Errors of others on this track, m, by the method's name."""
    per_axis: bool
    """Whether errors are per axis, as the published ones are: those of the distance by the root of the dimensions."""
    std: Tensor | None = None
    """``(T, m)`` standard deviations of the measurements; None for the sensor's."""
    groups: tuple[int, ...] = ()
    """Of each element of a measurement the number of what it has in common with others, such as a clock."""


class Found(NamedTuple):
    """What a filter made of a track."""

    figures: Figures
    mean: Tensor
    """``(T, dims)`` positions on line, m."""


def measured(
    f: Filter, prior: Gaussian, track: Track, metric: str, unnoticed: tuple[float, float] | None = None,
    bias: float | None = None,
) -> Found:  # fmt: skip
    """Errors of a filter on a track, as it filters and smoothed.

    Args:
        f: the filter.
        prior: its belief before the first step.
        track: the track.
        metric: what the error on line is called.
        unnoticed: of the protection level: ``fault`` of ``filters.protection_level``.
        bias: standard deviation of a constant bias of each element of a measurement, which covariances contain and
            nothing estimates (``filters.considered``); None for none.

    Returns:
        That error and ``smoothed``, m, over all steps whose truth is known, and the mean normalised estimation error
        squared per dimension of both, ``nees`` and ``nees_smoothed``, which is 1 where covariances are honest; and
        ``beyond``, the percentage of steps on line whose error is beyond its protection level.  No number is finite
        where the track has failed.
    """
    dims = track.truth.shape[-1]
    states = slice(0, dims)
    z, u, std = track.z, track.u, track.std
    if bias is not None:
        z = biased_copies(z, bias)
        u, std = (None if x is None else x.expand(len(z), -1, -1) for x in (u, std))
    with torch.no_grad():
        estimate = f(z, prior, dt=track.dt, u=u, std=std, past=True)
        later = f.smooth(z, prior, dt=track.dt, u=u, std=std, estimate=estimate)
        if bias is not None:
            estimate, later = considered(f, estimate), considered(f, later)

    def errors(of: Estimate) -> tuple[float, float]:
        rmse = metrics.track_rmse(of.mean, track.truth, states) / math.sqrt(dims if track.per_axis else 1)
        return float(rmse), float(metrics.nees(of, track.truth, states).nanmean()) / dims

    (rmse, nees), (smoothed, nees_smoothed) = errors(estimate), errors(later)
    off = (estimate.mean[..., states] - track.truth).norm(dim=-1)
    level = protection_level(f, estimate, fault=unnoticed)
    beyond = 100 * float(torch.where((off - level).isnan(), torch.nan, (off > level).to(off)).nanmean())
    figures = {metric: rmse, "nees": nees, "smoothed": smoothed, "nees_smoothed": nees_smoothed, "beyond": beyond}
    return Found(figures, estimate.mean[..., states])
