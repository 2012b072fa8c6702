"""Cleans tracks by ``cleaning.closed_form``: divides them into rows of a batch, and joins the results."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchfra.cleaning.batches import Steps, padded
from torchfra.cleaning.cleaned import FilterParameters
from torchfra.cleaning.closed_form import DEFAULT, Fixes, OutlierModel
from torchfra.cleaning.kinds import USUAL
from torchfra.cleaning.parameters import estimated, fitted
from torchfra.cleaning.parts import SHORT, Part
from torchfra.cleaning.process_noise import LONGEST, levels_up_to, may_stop
from torchfra.cleaning.sigma import first_sigma, most_by_shapes
from torchfra.cleaning.two_filters import Smoothed
from torchfra.readers.columns import Array
from torchfra.tree import map_tensors

if TYPE_CHECKING:
    from torchfra.motion.bank import Bank

_AXES = ((slice(0, 2), "acceleration", 8), (slice(2, 3), "climb", 5))
"""Axes with one variance, their bound in ``Kind``, and the number of levels."""
ROW, _OVERLAP = 256, 64
"""Steps of a row, and the number of fixes on either side by which it overlaps its neighbours."""
_FEW = 60
"""Fixes from which on a track has a sigma of its own; shorter tracks of a batch share one."""
_ANYWHERE = 700.0
"""Seconds between fixes from which on a target may rest, go or come back in between."""
_SEEN = 10.0
"""Usual way between two fixes, in standard deviations of a given noise, from which on all motion is seen."""
_CALM = 0.05
"""A level of process noise is calm while it changes the speed over ten seconds by less than this share of the kind's
hardest acceleration times ten seconds, or while it is below ten times the track's usual level."""
_LEAST_OF_HEIGHT = 1 / 3
"""Least ratio of the sigma of the height to that across the ground: heights often come in coarse steps."""


class Settings(NamedTuple):
    """Settings of cleaning: see ``clean_tracks``."""

    sigma: float | None = None
    q: float | None = None
    smooth: bool = True
    filter: str = "gpb"
    bank: str | Bank | None = None
    dt: float | None = None
    repair: bool = True


class Row(NamedTuple):
    """A part of a track."""

    track: int
    chosen: NDArray[np.intp]
    """Numbers of its steps in the track."""
    first: int
    last: int
    """Range of these steps whose estimates are taken from this row."""


class Answer(NamedTuple):
    """Estimates ``(T, ...)`` and parameters of a track."""

    mean: Array
    covariance: Array
    nis: Array
    outlier: Array
    manoeuvre: Array
    sigma: float
    height: float
    """Sigma of the height; NaN in the plane."""
    lowest: float
    """The lowest sigma that the track does not rule out."""
    q: float
    parameters: tuple[FilterParameters, ...]
    """Those of the filter for each part."""
    log_likelihood: float
    """Of the fixes across the ground."""


@torch.inference_mode()  # a tenth less of the time of each small operation
def answers(tracks: Sequence[Steps], settings: Settings) -> list[Answer]:
    """Tracks of the same dimensions, cleaned.

    Between rare fixes beside a given noise, positions are as unsure as those of targets that rest and move there, which
    have no velocity; what has one is the motion from fix to fix.
    """
    found = _answers(tracks, settings)
    if settings.sigma is None or settings.q is not None:
        return found
    ways = [_seen_way(steps, settings.sigma) for steps in tracks]
    chosen = [i for i, way in enumerate(ways) if not math.isnan(way)]
    resting = _answers([tracks[i]._replace(way=ways[i]) for i in chosen], settings) if chosen else []
    for i, one in zip(chosen, resting, strict=True):
        axes, covariance = range(tracks[i].raw.shape[1]), found[i].covariance.copy()
        more = (one.covariance - covariance)[:, axes, axes]
        covariance[:, axes, axes] += np.maximum(more, 0.0)
        found[i] = found[i]._replace(covariance=covariance)
    return found


def _answers(tracks: Sequence[Steps], settings: Settings) -> list[Answer]:
    """The same; targets go at random by ``way``, where there is one."""
    measured = [steps.at(steps.measured) for steps in tracks]
    rows, parts = _parts(measured, settings)
    parts = fitted(parts, _owners(rows, measured), find_sigma=settings.sigma is None, find_q=settings.q is None)
    if any(len(some.time) < len(every.time) for some, every in zip(measured, tracks, strict=True)):
        rows, parts = _between(tracks, rows, parts)
    if not settings.smooth:  # the evidence of other axes and the probabilities of outliers are those of all fixes
        parts = [part.on_line for part in parts]
    known, outlier = estimated(parts, smooth=settings.smooth)
    return _joined(tracks, rows, parts, known, outlier)


def _seen_way(steps: Steps, sigma: float) -> float:
    """Usual way between rare fixes, m, where it is far larger than the noise and steps are between them; else NaN."""
    fixes = steps.at(steps.measured)
    if len(fixes.time) < 2 or len(fixes.time) == len(steps.time) or period_of(fixes) <= LONGEST:
        return math.nan
    way = float(np.median(np.linalg.norm(np.diff(fixes.raw[:, :2], axis=0), axis=1)))
    return way if way > _SEEN * sigma * float(np.median(fixes.std[:, 0])) else math.nan


def _parts(tracks: Sequence[Steps], settings: Settings) -> tuple[list[Row], list[Part]]:
    """Rows of tracks, and the initial parameters of their axes."""
    rows = _rows(tracks)
    z, gap, std = padded([tracks[row.track].at(row.chosen) for row in rows])
    period, fastest, steady, way, least, height_step = _of_rows(rows, [
        (period_of(steps), steps.kind.fastest, steps.kind.steady, steps.way, steps.least, steps.height_step)
        for steps in tracks
    ])  # fmt: skip
    parts: list[Part] = []
    for axes, hardest, count in _AXES[: z.shape[-1] - 1]:
        (most,) = _of_rows(rows, [(getattr(steps.kind, hardest),) for steps in tracks])
        fixes = _fixes(z, gap, std, axes)
        levels = levels_up_to(most, fastest, period, count, settings.q, steady, way)
        model = _outliers(most, fastest, period, steady)
        unknown, stops = torch.full_like(most, math.nan), may_stop(most, fastest, period, steady)
        parts.append(Part(fixes, levels, unknown, torch.zeros_like(unknown), unknown, unknown, stops, model))
    return rows, _with_first_sigma(parts, _owners(rows, tracks), settings.sigma, least, height_step)


def _of_rows(rows: Sequence[Row], values: Sequence[tuple[float, ...]]) -> Tensor:
    """Values of each track as ``(..., B)``, for each row."""
    return torch.tensor([values[row.track] for row in rows], dtype=torch.float64).T


def _with_first_sigma(
    parts: Sequence[Part], owner: Tensor, given: float | None, least: Tensor, height_step: Tensor
) -> list[Part]:
    """Parts with sigma as given, or an initial one, and its least value; ``least`` is that across the ground."""
    if given is None:
        parts = [part._replace(most=most_by_shapes(part, owner)) for part in parts]
        several = [first_sigma(part, owner) for part in parts]
    else:
        several, least = [torch.full_like(least, given)] * len(parts), torch.zeros_like(least)
    found = list[Part]()
    for part, sigma in zip(parts, several, strict=True):
        found.append(part._replace(sigma=sigma.maximum(least), least=least))
        # The error of a rounded height is uniform within half a step to either side.
        least = (height_step / math.sqrt(12)).maximum(_LEAST_OF_HEIGHT * found[0].sigma)
    return found


def _outliers(hardest: Tensor, fastest: Tensor, period: Tensor, steady: Tensor) -> OutlierModel:
    """The initial model of outliers.

    Where a target may reach any place within its largest speed from one fix to the next, an outlier is a fix beyond,
    and its offset is independent of the one before, whose cause is over.  A kind that keeps slow courses is more
    regular.
    """
    usual = USUAL * torch.minimum(hardest * period.square() / 4, fastest * period)
    rare = period > _ANYWHERE
    offset = torch.where(rare, 0.0, torch.zeros_like(period) + DEFAULT.same_offset)
    return DEFAULT._replace(
        least_offset=torch.where(rare & (period <= steady), fastest * period, usual), same_offset=offset
    )


def _between(tracks: Sequence[Steps], rows: Sequence[Row], parts: Sequence[Part]) -> tuple[list[Row], list[Part]]:
    """Rows and parts with steps between the fixes, which have the parameters of the fixes."""
    every = _rows(tracks)
    z, gap, std = padded([tracks[row.track].at(row.chosen) for row in every])
    first = torch.tensor([next(b for b, row in enumerate(rows) if row.track == of.track) for of in every])
    more = []
    for (axes, *_), part in zip(_AXES, parts, strict=False):
        fixes, log_odds = _fixes(z, gap, std, axes), [np.zeros(len(steps.time)) for steps in tracks]
        for track, steps in enumerate(tracks):
            log_odds[track][steps.measured] = _of_track(part.fixes.log_odds, rows, track)
        for b, row in enumerate(every):
            fixes.log_odds[: len(row.chosen), b] = torch.from_numpy(log_odds[row.track][row.chosen])
        more.append(part.at(first)._replace(fixes=fixes))
    return every, more


def _fixes(z: Tensor, gap: Tensor, std: Tensor, axes: slice) -> Fixes:
    """The fixes of some axes of rows ``(B, T, d)``, time first."""
    variance = std[..., axes].square().mean(-1).T.contiguous()
    return Fixes(z[..., axes].permute(1, 2, 0).contiguous(), gap.T.contiguous(), variance, torch.zeros_like(variance))


def _rows(tracks: Sequence[Steps]) -> list[Row]:
    """Tracks as rows, that overlap where they are long."""
    return [row for i, steps in enumerate(tracks) for row in _rows_of(i, steps)]


def _rows_of(track: int, steps: Steps) -> list[Row]:
    """A track as rows, if it is long, each with the fixes before and after its steps."""
    count, fixes = len(steps.time), np.flatnonzero(steps.measured)
    edges = np.linspace(0, count, max(1, math.ceil(count / ROW)) + 1).round().astype(int)
    rows = []
    for first, last in pairwise(edges.tolist()):
        earlier, later = np.searchsorted(fixes, (first, last))
        before, after = fixes[max(0, earlier - _OVERLAP) : earlier], fixes[later : later + _OVERLAP]
        chosen = np.concatenate([before, np.arange(first, last), after])
        rows.append(Row(track, chosen, len(before), len(before) + last - first))
    return rows


def _owners(rows: Sequence[Row], tracks: Sequence[Steps]) -> Tensor:
    """Numbers ``(B,)`` that are equal for rows with common values: those of a track, and of all short tracks.

    What mostly repeats its position, as a beacon, tells nothing of the noise of others.
    """
    short = [len(steps.time) < _FEW and not _repeats(steps) for steps in tracks]
    return torch.tensor([SHORT if short[row.track] else SHORT + 1 + row.track for row in rows])


def _repeats(steps: Steps) -> bool:
    """Whether half of the fixes or more are where the one before was."""
    moved = np.diff(steps.raw[steps.measured], axis=0)
    return len(moved) > 0 and bool((moved == 0).all(1).mean() >= 0.5)


def _of_track(x: Tensor, rows: Sequence[Row], track: int) -> Array:
    """Values of a track from rows ``(T, B, ...)``."""
    own = [(b, row) for b, row in enumerate(rows) if row.track == track]
    return np.concatenate([x[row.first : row.last, b].numpy() for b, row in own])


def period_of(steps: Steps) -> float:
    """Median time between fixes, s."""
    time = steps.time[steps.row >= 0]
    return float(np.median(np.diff(time))) if len(time) > 1 else 1.0


def _joined(
    tracks: Sequence[Steps], rows: Sequence[Row], parts: Sequence[Part], known: Sequence[Smoothed], outlier: Tensor
) -> list[Answer]:
    """The result of each track from its rows."""
    nis = torch.stack([_nis(part, of) for part, of in zip(parts, known, strict=True)]).sum(0)
    mean, covariance = _moments(known)
    levels, share = parts[0].levels, parts[0].levels.log_share.exp()
    period, calm = _of_rows(rows, [
        (period_of(steps.at(steps.measured)), _CALM * steps.kind.acceleration) for steps in tracks
    ])  # fmt: skip
    densities = levels.q + 3 * levels.walk / period.square()  # of equal displacement over a period
    q = (share * densities.log()).sum(0).exp()
    manoeuvre = (known[0].levels * (densities > 10 * q.maximum(calm.square()))).sum(1)
    found = []
    for i in range(len(tracks)):
        first = next(b for b, row in enumerate(rows) if row.track == i)
        height = float(parts[1].sigma[first]) if len(parts) == 2 else math.nan
        a, b, c, d, e = (_of_track(x, rows, i) for x in (mean, covariance, nis, outlier, manoeuvre))
        parameters = tuple(_parameters(part, first) for part in parts)
        sigma, lowest = float(parts[0].sigma[first]), float(parts[0].lowest[first])
        fit = float(_of_track(known[0].predictions.log_likelihood, rows, i).sum())
        found.append(Answer(a, b, c, d, e, sigma, height, lowest, float(q[first]), parameters, fit))
    return found


def _parameters(part: Part, row: int) -> FilterParameters:
    """Parameters of the filter on one row."""
    one = slice(row, row + 1)
    stated = torch.where(part.fixes.missing, torch.nan, part.fixes.variance)[:, one].nanquantile(0.5, dim=0).sqrt()
    sigma = part.sigma[one] * stated
    with torch.inference_mode(False):  # so that gradients may flow through the clones
        levels, model = map_tensors(lambda x: x[..., one].clone(), (part.levels, part.model))
        return FilterParameters(part.fixes.z.shape[1], levels, sigma.clone(), model)


def _moments(known: Sequence[Smoothed]) -> tuple[Tensor, Tensor]:
    """Means ``(T, B, 2 d)`` and covariances of positions and velocities, positions first."""
    position = torch.cat([of.belief.position for of in known])
    velocity = torch.cat([of.belief.velocity for of in known])

    def of_axes(name: str) -> Tensor:
        every = [getattr(of.belief, name).expand(len(of.belief.position), -1, -1) for of in known]
        return torch.cat(every).movedim(0, -1).diag_embed()

    pp, pv, vv = (of_axes(name) for name in ("pp", "pv", "vv"))
    covariance = torch.cat([torch.cat([pp, pv], -1), torch.cat([pv, vv], -1)], -2)
    return torch.cat([position, velocity]).movedim(0, -1), covariance


def _nis(part: Part, known: Smoothed) -> Tensor:
    """Normalised innovation squared ``(T, B)`` of these axes; 0 where nothing is measured.

    It is the mean over the levels with their posterior probabilities, ``d`` on average if the model is right.
    """
    fixes, expected = part.scaled, known.predictions.belief
    residual = fixes.z.movedim(1, 0).unsqueeze(2) - expected.position
    variance = expected.pp + fixes.variance.unsqueeze(1)
    nis = residual.square().sum(0) / variance
    fit = known.predictions.log_weights - 0.5 * (nis + len(residual) * variance.log())
    return torch.where(fixes.missing, 0.0, (fit.nan_to_num().softmax(1) * nis).sum(1))
