"""Recordings of different lengths as batches: steps at their fixes and between them, padded."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchfra.cleaning.kinds import Kind
from torchfra.geodesy import to_geodetic
from torchfra.readers.columns import Array
from torchfra.readers.recording import Recording

_MOST_STEPS = 10**7
"""Largest number of steps of a regular grid."""
_COARSEST = 31.0
"""Coarsest resolution of the heights of a transponder, m: 100 ft."""
_LEAST, _FINEST = 0.01, 1e-4
"""Least standard deviation of fixes across the ground, m: of degrees, whose last digit is often as coarse, and of
metres with many digits."""
_SHORT = 100
"""Difference in fixes that tracks of one batch may always have."""
_ALONE, _PAIR = 45_000, 100_000
"""Largest number of fixes of a batch that is not divided, and the approximate number of two batches: larger ones have
more padding and exceed the caches, smaller ones repeat the overhead of each operation."""


class Steps(NamedTuple):
    """The steps of one recording."""

    time: Array
    """``(T,)`` seconds since the first fix."""
    raw: Array
    """``(T, d)`` positions there, m; NaN between fixes."""
    row: NDArray[np.int64]
    """``(T,)`` number of the fix; -1 between fixes."""
    std: Array
    """``(T, d)`` the standard deviation of each fix per axis as the file states it, m; 1 where it states none."""
    kind: Kind
    least: float = 0.0
    """Least sigma that may be estimated, m."""
    height_step: float = 0.0
    """Resolution of the heights, m."""
    way: float = math.nan
    """Usual way between rare fixes that the target goes at random, m; NaN if nothing is known of it."""

    @property
    def measured(self) -> NDArray[np.bool_]:
        """``(T,)`` whether a step has a position; True for all where none has."""
        there = ~np.isnan(self.raw).any(1)
        return np.asarray(there if there.any() else ~there)

    def at(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> Steps:
        """Some of the steps."""
        time, raw, row, std = self.time[chosen], self.raw[chosen], self.row[chosen], self.std[chosen]
        return self._replace(time=time, raw=raw, row=row, std=std)


def steps_of(recording: Recording, kind: Kind, dt: float | None = None) -> Steps:
    """The steps at the fixes of a recording; and at its times that are multiples of ``dt`` seconds, if that is given.

    So the steps of all targets between their fixes are at the same times, and of dates at whole hours.

    Raises:
        ValueError: more than ten million steps between fixes.
    """
    time, position = recording.time - recording.time[0], recording.position
    count, d = position.shape
    steps = Steps(time, position, np.arange(count), _std(recording), kind)
    if dt is None:
        return steps
    if time[-1] > _MOST_STEPS * dt:
        raise ValueError(f"dt: expected at most {_MOST_STEPS:,} steps, received {dt} s in a track of {time[-1]:g} s")
    begin, end = recording.time[[0, -1]]
    regular: Array = dt * np.arange(math.ceil(begin / dt), math.floor(end / dt) + 1, dtype=np.float64) - begin
    apart = max(1e-6 * dt, 4 * np.spacing(max(abs(begin), abs(end))))  # what times since 1970 resolve
    between = regular[np.abs(regular - time[_nearest(time, regular)]) > apart]
    more = len(between)
    order = np.argsort(np.concatenate([time, between]), kind="stable")
    return Steps(
        np.concatenate([time, between])[order],
        np.concatenate([position, np.full((more, d), np.nan)])[order],
        np.concatenate([steps.row, np.full(more, -1)])[order],
        np.concatenate([steps.std, np.ones((more, d))])[order],
        kind,
    )


def step_of_heights(recording: Recording) -> float:
    """Resolution of the heights of a recording, m: 7.6 for altitudes in steps of 25 ft, about 0 for others.

    Gaps larger than ``_COARSEST`` are not due to rounding.
    """
    if recording.position.shape[1] == 2:
        return 0.0
    here = recording.position[np.isfinite(recording.position).all(1)]
    heights = here[:, 2] if recording.origin is None else to_geodetic(here, recording.origin)[2]
    gaps = np.diff(np.unique(heights.round(3)))
    step = float(np.quantile(gaps, 0.1)) if len(gaps) else 0.0
    return step if step <= _COARSEST else 0.0


def least_sigma(recording: Recording) -> float:
    """The least standard deviation of fixes across the ground that may be estimated, m, or as a factor.

    For positions in metres it is that of their rounding.
    """
    if recording.sigma is not None or recording.origin is not None:
        return _LEAST
    ground = recording.position[np.isfinite(recording.position).all(1), :2]
    for digits in range(4):
        scaled = ground * 10.0**digits
        if np.isclose(scaled, np.rint(scaled), rtol=0, atol=1e-4).all():
            return min(10.0**-digits / math.sqrt(12), _LEAST)
    return _FINEST


def padded(several: Sequence[Steps]) -> tuple[Tensor, Tensor, Tensor]:
    """Positions ``(B, T, d)``, seconds since the step before ``(B, T)`` and ``std (B, T, d)`` as one batch.

    Shorter tracks are padded with NaN.
    """
    longest, d = max(len(steps.time) for steps in several), several[0].raw.shape[1]
    z = torch.full((len(several), longest, d), torch.nan, dtype=torch.float64)
    gaps, std = torch.ones(z.shape[:2], dtype=torch.float64), torch.ones_like(z)
    for i, steps in enumerate(several):
        count = len(steps.time)
        z[i, :count], std[i, :count] = torch.from_numpy(steps.raw), torch.from_numpy(steps.std)
        gaps[i, 1:count] = torch.from_numpy(np.diff(steps.time))
    return z, gaps, std


def groups(recordings: Sequence[Recording], alike: float = math.inf) -> list[list[int]]:
    """Numbers of the recordings of each batch: of the same dimensions, and at most twice as long as the shortest.

    The size of a batch is bounded, and with it the memory: recordings of similar length are divided in order of length
    into an even number of batches of as many fixes, for two processes or more.  Batches depend on nothing but the
    recordings, as tracks of one batch may share values.

    Args:
        recordings: of any length.
        alike: fixes from which on recordings count as equally long, as they are divided into rows of about that length.
    """
    together: list[list[int]] = []
    for i in sorted(range(len(recordings)), key=lambda i: recordings[i].position.shape[::-1]):
        length, d = recordings[i].position.shape
        first = recordings[together[-1][0]].position.shape if together else (0, 0)
        if d != first[1] or min(length, alike) > 2 * first[0] + _SHORT:
            together.append([])
        together[-1].append(i)
    return [some for group in together for some in _divided(group, [len(recordings[i].time) for i in group])]


def _divided(group: Sequence[int], lengths: Sequence[int]) -> list[list[int]]:
    """Divides a group in order into parts of about as many fixes; none is empty."""
    middle, total = np.cumsum(lengths) - np.asarray(lengths) / 2, sum(lengths)
    count = 1 if total <= _ALONE else 2 * max(1, round(total / _PAIR))
    share = (middle * count / total).astype(int)
    return [some.tolist() for some in np.split(group, np.flatnonzero(np.diff(share)) + 1)]


def _std(recording: Recording) -> Array:
    if recording.sigma is None:
        return np.ones_like(recording.position)
    return np.array(np.broadcast_to(recording.sigma.reshape(len(recording.time), -1), recording.position.shape))


def _nearest(time: Array, at: Array) -> NDArray[np.intp]:
    if len(time) < 2:
        return np.zeros(len(at), dtype=np.intp)
    right = np.searchsorted(time, at).clip(1, len(time) - 1)
    nearest: NDArray[np.intp] = right - (at - time[right - 1] < time[right] - at)
    return nearest
