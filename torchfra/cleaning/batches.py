"""Recordings of different lengths as batches: steps at their fixes and between them, padded."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchfra.readers.columns import Array
from torchfra.readers.recording import Recording

_MOST_STEPS = 10**7
"""Of a grid between fixes."""


class Steps(NamedTuple):
    """The steps of one recording."""

    time: Array
    """``(T,)`` seconds since the first fix."""
    raw: Array
    """``(T, d)`` positions there, m; NaN between fixes."""
    row: NDArray[np.int64]
    """``(T,)`` which fix it is; -1 between fixes."""
    std: Array
    """``(T, d)`` what the file says of each fix's standard deviation per axis, m; 1 where it says nothing."""


def steps_of(recording: Recording, dt: float | None = None) -> Steps:
    """The steps at the fixes of a recording; and at every multiple of ``dt`` seconds after the first, if that is given.

    Raises:
        ValueError: more steps between fixes than anyone can want.
    """
    time, position = recording.time - recording.time[0], recording.position
    count, d = position.shape
    steps = Steps(time, position, np.arange(count), _std(recording))
    if dt is None:
        return steps
    if time[-1] > _MOST_STEPS * dt:
        raise ValueError(f"dt: expected at most {_MOST_STEPS:,} steps, received {dt} s in a track of {time[-1]:g} s")
    regular: Array = dt * np.arange(int(time[-1] / dt) + 1, dtype=np.float64)
    between = regular[np.abs(regular - time[_nearest(time, regular)]) > 1e-6 * dt]
    more = len(between)
    order = np.argsort(np.concatenate([time, between]), kind="stable")
    return Steps(
        np.concatenate([time, between])[order],
        np.concatenate([position, np.full((more, d), np.nan)])[order],
        np.concatenate([steps.row, np.full(more, -1)])[order],
        np.concatenate([steps.std, np.ones((more, d))])[order],
    )


def padded(several: Sequence[Steps]) -> tuple[Tensor, Tensor, Tensor]:
    """Positions ``(B, T, d)``, seconds since the step before ``(B, T)`` and ``std (B, T, d)`` of all as one batch.

    The shorter ones end in NaN.
    """
    longest, d = max(len(steps.time) for steps in several), several[0].raw.shape[1]
    z = torch.full((len(several), longest, d), torch.nan, dtype=torch.float64)
    gaps, std = torch.ones(z.shape[:2], dtype=torch.float64), torch.ones_like(z)
    for i, steps in enumerate(several):
        count = len(steps.time)
        z[i, :count], std[i, :count] = torch.from_numpy(steps.raw), torch.from_numpy(steps.std)
        gaps[i, 1:count] = torch.from_numpy(np.diff(steps.time))
    return z, gaps, std


def groups(recordings: Sequence[Recording], size: int) -> list[list[int]]:
    """Numbers of the recordings that are one batch: of the same dimensions and similar length."""
    together = []
    for d in sorted({recording.position.shape[1] for recording in recordings}):
        part = [i for i, recording in enumerate(recordings) if recording.position.shape[1] == d]
        part.sort(key=lambda i: len(recordings[i].time))
        together += [part[i : i + size] for i in range(0, len(part), size)]
    return together


def _std(recording: Recording) -> Array:
    if recording.sigma is None:
        return np.ones_like(recording.position)
    std: Array = np.broadcast_to(recording.sigma.reshape(len(recording.time), -1), recording.position.shape)
    return std


def _nearest(time: Array, at: Array) -> NDArray[np.intp]:
    if len(time) < 2:
        return np.zeros(len(at), dtype=np.intp)
    right = np.searchsorted(time, at).clip(1, len(time) - 1)
    nearest: NDArray[np.intp] = right - (at - time[right - 1] < time[right] - at)
    return nearest
