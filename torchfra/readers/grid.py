"""A recording on a regular grid."""

from __future__ import annotations

import math

import numpy as np

from torchfra.readers.columns import Array
from torchfra.readers.recording import Recording


def resample(recording: Recording, dt: float, *, max_gap: float) -> list[tuple[Array, Array]]:
    """Interpolates a recording on a regular grid: cubic Hermite interpolation, which goes through the fixes.

    Args:
        recording: the track.
        dt: step of the grid in seconds; it starts at the first fix of every piece.
        max_gap: seconds; a longer gap between fixes splits the track.

    Returns:
        ``(time (k,), position (k, d))`` of every piece that lasts a step or longer, so ``k >= 2``, in order of time.

    Raises:
        ValueError: ``dt`` or ``max_gap`` is not above 0.
    """
    if not 0 < dt < math.inf:
        raise ValueError(f"dt: expected seconds above 0, received {dt}")
    if not max_gap > 0:
        raise ValueError(f"max_gap: expected seconds above 0, received {max_gap}")
    breaks = np.flatnonzero(np.diff(recording.time) > max_gap) + 1
    pieces = []
    for time, position in zip(np.split(recording.time, breaks), np.split(recording.position, breaks), strict=True):
        steps = math.floor((time[-1] - time[0]) / dt + 1e-5)  # times since 1970 are exact to 1e-6 s
        if steps >= 1:
            grid = time[0] + dt * np.arange(steps + 1)
            pieces.append((grid, hermite(time, position, grid)))
    return pieces


def hermite(time: Array, position: Array, grid: Array) -> Array:
    """``(k, d)`` on the grid ``(k,)``; the slope at a fix is that of the parabola through it and its neighbours."""
    slope = np.gradient(position, time, axis=0, edge_order=2 if len(time) > 2 else 1)
    i = (np.searchsorted(time, grid, "right") - 1).clip(0, len(time) - 2)
    h, rise = (time[i + 1] - time[i])[:, None], position[i + 1] - position[i]
    s = (grid - time[i])[:, None] / h
    bend = (1 - s) * (slope[i] * h - rise) - s * (slope[i + 1] * h - rise)
    return np.asarray(position[i] + s * rise + s * (1 - s) * bend)
