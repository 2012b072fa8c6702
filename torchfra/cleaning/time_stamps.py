"""Wrong time stamps: fixes are moved along the path to where the target was at the stated time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from torchfra.cleaning.batches import steps_of
from torchfra.cleaning.cleaned import Cleaned
from torchfra.cleaning.kinds import USUAL, Kind
from torchfra.cleaning.positions import Settings, answers
from torchfra.cleaning.second_differences import second_differences, spread
from torchfra.readers.columns import Array
from torchfra.readers.flyable import flyable, running_median
from torchfra.readers.recording import Recording
from torchfra.readers.smoothing import differences
from torchfra.tables import metres

_RATIO = 2.0, 1.5
"""Least ratio of accelerations along the track and across where stamps are wrong, in ADS-B and elsewhere: those of
noise are equal."""
_GROWTH = 1.3
"""Without every second fix, second differences due to white errors of stamps grow less; those of a motion grow by 1.4
or more."""
_LEAST = 8, 60
"""Fewest fixes of ADS-B, and of other tracks, whose targets change their speed more often."""
_ASIDE = 5.0
"""Standard deviations across the path from which on the position of a fix is wrong too."""


def stamps_are_wrong(recording: Recording, kind: Kind) -> bool:
    """Whether fixes jump to and fro along a path that is smooth across.

    Noise of the positions and turns would show across the track as well.  A change of speed lasts for several fixes,
    and is smaller than the kind of target allows.

    Args:
        recording: of a target.
        kind: of the target.
    """
    there = np.isfinite(recording.position[:, :2]).all(1)
    time, path = recording.time[there], recording.position[there, :2]
    reported = _as_reported(recording)
    if len(time) < _LEAST[not reported]:
        return False
    along, across, _ = _along_and_across(time, path)
    size = np.linalg.norm(differences(time, 2), axis=1)
    one, other = (float(np.quantile(np.abs(x * size), 0.8)) for x in (along, across))
    if not (one > USUAL * kind.acceleration and one > _RATIO[not reported] * other):
        return False
    if reported:
        return True
    return _white(time, path)


def _as_reported(recording: Recording) -> bool:
    """Whether a file has reports of aircraft (ADS-B), whose stamps may be wrong for a while."""
    return recording.source.word == "aircraft"


def moved_along(recording: Recording, kind: Kind) -> tuple[Recording, Array]:
    """The recording with each fix moved along the path to where the target was, and variances ``(k,)`` of these, m^2.

    Positions that aircraft report come late, repeat, or are interpolated: ``readers.flyable``.  As a track alone cannot
    show that all of its stamps are late, the variance is that of the usual shift.  Stamps of other targets have white
    errors.

    Outliers stay as they are.
    """
    if not _as_reported(recording):
        return _smoothed_along(recording, kind)
    there, position = np.isfinite(recording.position).all(1), recording.position.copy()
    for piece in flyable(replace(recording, time=recording.time[there], position=position[there])):
        at = np.flatnonzero(np.isin(recording.time, piece.time))
        position[at] = piece.position[np.searchsorted(piece.time, recording.time[at])]
    usual = float(np.nanmedian(np.linalg.norm(position - recording.position, axis=1))) / 0.6745
    return replace(recording, position=position), np.full(len(position), usual**2)


def _smoothed_along(recording: Recording, kind: Kind) -> tuple[Recording, Array]:
    """Smooths distances along the track by a filter whose noise contains the shifts of fixes by wrong stamps.

    Errors along the track are then as large as those across it: a filter of positions has one variance for both.
    """
    time, position, d = recording.time, recording.position.copy(), recording.position.shape[1]
    there = np.isfinite(position[:, :2]).all(1)
    at = time[there]
    along, across, ahead = _along_and_across(at, position[there, :2])
    speed = running_median(ahead / (at[2:] - at[:-2]), 7)
    fast = speed >= np.median(speed)
    seconds, noise = spread(along[fast] / speed[fast], 0.25), spread(across, 0.5)
    std = np.hypot(seconds * np.interp(time, at[1:-1], speed), noise)
    steps = steps_of(recording, kind)._replace(std=np.repeat(std[:, None], d, 1))
    (known,) = answers([steps], Settings(sigma=1.0))
    course = _course(known.mean[:, d : d + 2])
    left = position[:, :2] - known.mean[:, :2]
    aside, wrong = np.abs(left[:, 0] * course[:, 1] - left[:, 1] * course[:, 0]), known.outlier > 0.5
    noise = spread(aside[there & ~wrong], 0.5)
    share = np.where(wrong, aside > _ASIDE * noise, (noise / std).clip(max=1.0))
    position[:, :2] -= ((1 - share) * (left * course).sum(1))[:, None] * course
    return replace(recording, position=position), np.einsum("ti,tij,tj->t", course, known.covariance[:, :2, :2], course)


def as_recorded(one: Cleaned, recording: Recording, variance: Array) -> Cleaned:
    """The result of a recording whose fixes were moved, with the fixes where they were recorded.

    Args:
        one: the result.
        recording: before its fixes were moved.
        variance: ``(k,)`` of the positions along the track, m^2, which is added to the covariances.
    """
    moved = np.linalg.norm((one.recording.position - recording.position)[:, :2], axis=1)
    moved, d = moved[np.isfinite(moved)], one.raw.shape[1]
    raw = np.full_like(one.raw, np.nan)
    raw[one.row >= 0] = recording.position[one.row[one.row >= 0]]
    usual, most = metres(float(np.median(moved))), metres(float(moved.max()))
    note = f"Time stamps were off: fixes moved along the path by {usual} (median) to {most}"
    course, covariance = _course(one.velocity), one.covariance.copy()
    more = np.interp(one.time, recording.time - recording.time[0], variance)
    covariance[:, :d, :d] += more[:, None, None] * course[:, :, None] * course[:, None, :]
    return replace(one, recording=recording, raw=raw, covariance=covariance,
                   found=replace(one.found, notes=(*one.found.notes, note)))  # fmt: skip


def _white(time: Array, path: Array) -> bool:
    """Whether errors along a path are white, and smaller than the distance of fixes; those of a motion are not."""
    along, _, ahead = _along_and_across(time, path)
    fewer = np.concatenate([_along_and_across(time[first::2], path[first::2])[0] for first in (0, 1)])
    return bool(2 * spread(along) < np.median(ahead) and spread(fewer) < _GROWTH * spread(along))


def _along_and_across(time: Array, path: Array) -> tuple[Array, Array, Array]:
    """Second differences of a path ``(k, 2)`` along and across, and the distances between the fixes around each, m."""
    error, ahead = second_differences(time, path), path[2:] - path[:-2]
    course = _course(ahead)
    across = error[:, 0] * course[:, 1] - error[:, 1] * course[:, 0]
    return (error * course).sum(1), across, np.linalg.norm(ahead, axis=1)


def _course(velocity: Array) -> Array:
    """Unit vectors along the velocity."""
    return np.asarray(velocity / np.linalg.norm(velocity, axis=1, keepdims=True).clip(1e-9))
