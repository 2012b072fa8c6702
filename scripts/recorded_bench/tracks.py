"""A recorded track with its truth, errors of estimates, and a picture of both."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from torchfra import metrics
from torchfra.filters import Filter, biased_copies, considered, protection_level
from torchfra.pictures import BLACK, GREY
from torchfra.plotting.style import TITLE, finish, line_styles, words
from torchfra.types import Estimate, Gaussian

Figures = dict[str, Any]


class Track(NamedTuple):
    """Measurements of one target, and its true path."""

    name: str
    z: Tensor
    """``(T, m)`` measurements, NaN where there is none."""
    u: Tensor | None
    """``(T, k)`` inputs of motion and sensor."""
    dt: Tensor
    """``(T,)`` seconds that lead to each step."""
    truth: Tensor
    """``(T, dims)`` positions, m; NaN where unknown."""
    prior: Gaussian
    """The prior, one step before the first."""
    fixes: Tensor | None
    """``(T, 2)`` positions that were measured, to be drawn; None where none were."""
    published: Figures
    """Published errors on this track, m, by the name of the method."""
    per_axis: bool
    """Whether errors are per axis, as the published ones are: those of the distance by the root of the dimensions."""
    groups: tuple[int, ...] = ()
    """Of each element of a measurement the number of what it has in common with others, such as a clock."""


class Followed(NamedTuple):
    """What a filter, or what weighs several, says of a track; positions are the leading states."""

    estimate: Estimate
    """The estimate on line."""
    smoothed: Estimate
    level: Tensor
    """``(T,)`` protection levels of the estimate on line, m."""


class Found(NamedTuple):
    """The result of a filter, or of a network that weighs several."""

    figures: Figures
    mean: Tensor
    """``(T, dims)`` positions on line, m."""


def followed(
    f: Filter, prior: Gaussian, track: Track, unnoticed: tuple[float, float] | None = None, bias: float | None = None
) -> Followed:
    """Filters a track, and smooths it.

    Args:
        f: the filter.
        prior: its belief before the first step.
        track: the track.
        unnoticed: of the protection level: ``fault`` of ``filters.protection_level``.
        bias: standard deviation of a constant bias of each element of a measurement, which covariances contain and
            nothing estimates (``filters.considered``); None for none.
    """
    z, u = track.z, track.u
    if bias is not None:
        z = biased_copies(z, bias)
        u = None if u is None else u.expand(len(z), -1, -1)
    with torch.no_grad():
        estimate = f(z, prior, dt=track.dt, u=u, past=True)
        smoothed = f.smooth(z, prior, dt=track.dt, u=u, estimate=estimate)
        if bias is not None:
            estimate, smoothed = considered(f, estimate), considered(f, smoothed)
    return Followed(estimate, smoothed, protection_level(f, estimate, fault=unnoticed))


def judged(of: Followed, track: Track, metric: str) -> Found:
    """Errors on a track.

    Args:
        of: what is said of it.
        track: the track.
        metric: what the error on line is called.

    Returns:
        That error and ``smoothed``, m, over all steps whose truth is known, and the mean normalised estimation error
        squared per dimension of both, ``nees`` and ``nees_smoothed``, which is 1 where covariances are consistent; and
        ``beyond``, the percentage of steps on line whose error is beyond its protection level.  No number is finite
        where the track has failed.
    """
    dims = track.truth.shape[-1]
    states = slice(0, dims)

    def errors(of: Estimate) -> tuple[float, float]:
        rmse = metrics.track_rmse(of.mean, track.truth, states) / math.sqrt(dims if track.per_axis else 1)
        return float(rmse), float(metrics.nees(of, track.truth, states).nanmean()) / dims

    (rmse, nees), (smoothed, nees_smoothed) = errors(of.estimate), errors(of.smoothed)
    off = (of.estimate.mean[..., states] - track.truth).norm(dim=-1)
    beyond = 100 * float(torch.where((off - of.level).isnan(), torch.nan, (off > of.level).to(off)).nanmean())
    figures = {metric: rmse, "nees": nees, "smoothed": smoothed, "nees_smoothed": nees_smoothed, "beyond": beyond}
    return Found(figures, of.estimate.mean[..., states])


# ---------------------------------------------------------------- a picture


def picture(tracks: Sequence[Track], found: Mapping[str, Mapping[str, Found]]) -> Figure:
    """A row for each recording: the path in the plane, and how far estimates on line are from it over time."""
    figure = Figure(figsize=(12, 4.5 * len(tracks)), layout="constrained")
    rows = figure.subplots(len(tracks), 2, squeeze=False)
    for (path, error), track in zip(rows, tracks, strict=True):
        truth, time = track.truth.numpy(), np.cumsum(track.dt.numpy())
        path.plot(*truth[:, :2].T, color=BLACK, linewidth=4, alpha=0.25, label="truth")
        if track.fixes is not None:
            path.plot(*track.fixes[:, :2].numpy().T, ".", color=GREY, markersize=2, label="measured")
        styles = line_styles(found[track.name])
        for name, one in found[track.name].items():
            path.plot(*one.mean[:, :2].numpy().T, label=name, **styles[name])
            error.plot(time, metrics.error(one.mean, track.truth, slice(0, truth.shape[1])).numpy(), **styles[name])
        path.set(xlabel="x, m", ylabel="y, m", title=words(track.name, TITLE), aspect="equal", adjustable="datalim")
        path.legend(fontsize=8)
        error.set(xlabel="time, s", ylabel="error, m", yscale="symlog")
        finish(path)
        finish(error)
    return figure
