"""Fixes of aircraft whose time stamps are off by seconds are moved along the path to where the aircraft was."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from torchfra.cleaning.cleaned import Cleaned
from torchfra.readers.columns import Array
from torchfra.readers.flyable import flyable
from torchfra.readers.recording import Recording
from torchfra.readers.smoothing import differences
from torchfra.tables import metres

_USUAL = 2.0
"""Acceleration along the track that four in five fixes of an aircraft stay below, m/s^2."""
_RATIO = 2.0
"""How much more of it there is along the track than across where stamps are off: noise is alike in both."""
_LEAST = 8
"""Fixes from which on that can be seen."""


def stamps_are_off(recording: Recording) -> bool:
    """Whether fixes of an aircraft jump to and fro along a path that is smooth by itself.

    Noise of the positions would show across the track as well, and so do turns.
    """
    if recording.source.word != "aircraft" or len(recording.time) < _LEAST:
        return False
    path = recording.position[:, :2]
    rows = differences(recording.time, 2)
    acceleration = rows[:, :1] * path[:-2] + rows[:, 1:2] * path[1:-1] + rows[:, 2:] * path[2:]
    ahead = path[2:] - path[:-2]
    ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True).clip(1e-9)
    along, across = (acceleration * ahead).sum(1), acceleration[:, 0] * ahead[:, 1] - acceleration[:, 1] * ahead[:, 0]
    one, other = (np.quantile(np.abs(x), 0.8) for x in (along, across))
    return bool(one > _USUAL and one > _RATIO * other)


def in_place(recording: Recording) -> Recording:
    """The recording with each fix moved along the path to where the aircraft was at that time (``readers.flyable``).

    Fixes that are out of order stay as they are: they are outliers.
    """
    position = recording.position.copy()
    for piece in flyable(recording):
        at = np.flatnonzero(np.isin(recording.time, piece.time))
        position[at] = piece.position[np.searchsorted(piece.time, recording.time[at])]
    return replace(recording, position=position)


def as_recorded(cleaned: Sequence[Cleaned], recordings: Sequence[Recording]) -> list[Cleaned]:
    """Results of recordings whose fixes were put in place, with the fixes where they were recorded.

    How far fixes were usually moved is added to the standard deviation along the track, as a track alone does not tell
    whether all of its stamps are late.
    """
    return [
        one if one.recording is raw else _as_recorded(one, raw) for one, raw in zip(cleaned, recordings, strict=True)
    ]


def _as_recorded(one: Cleaned, recording: Recording) -> Cleaned:
    moved = np.linalg.norm(one.recording.position - recording.position, axis=1)
    usual, d = float(np.median(moved)), one.raw.shape[1]
    raw = np.full_like(one.raw, np.nan)
    raw[one.row >= 0] = recording.position[one.row[one.row >= 0]]
    said = (
        f"Time stamps were off: fixes moved along the path by {metres(usual)} (median) to {metres(float(moved.max()))}"
    )
    covariance = one.covariance.copy()
    covariance[:, :d, :d] += (usual / 0.6745) ** 2 * _along(one.velocity)
    found = replace(one.found, said=(*one.found.said, said))
    return replace(one, recording=recording, raw=raw, covariance=covariance, found=found)


def _along(velocity: Array) -> Array:
    """Projections ``(T, d, d)`` on the way ahead."""
    ahead = velocity / np.linalg.norm(velocity, axis=1, keepdims=True).clip(1e-9)
    return np.asarray(ahead[:, :, None] * ahead[:, None, :])
