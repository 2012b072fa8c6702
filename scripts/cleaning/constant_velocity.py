"""A reference: a Kalman smoother of constant velocity with the true sigma and outliers, and the best q."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchfra.readers.columns import Array

DENSITIES = np.logspace(-5, 3, 25)
"""Densities of the process noise that are tried, m^2/s^3."""


def smoothed(z: Array, good: NDArray[np.bool_], dt: float, sigma: float, q: Array) -> Array:
    """Positions of a Kalman filter and the Rauch-Tung-Striebel pass back, for several densities of the noise.

    Every axis moves at a constant velocity that white noise disturbs; the axes have the same gains.

    Args:
        z: ``(..., k, d)`` positions, m.
        good: ``(..., k)`` which of them are used.
        dt: seconds.
        sigma: of the positions per axis, m.
        q: ``(Q,)`` densities, m^2/s^3.

    Returns:
        ``(Q, ..., k, d)``.
    """
    batch, steps = good.shape[:-1], good.shape[-1]
    f = np.array([[1.0, dt], [0.0, 1.0]])
    q = np.reshape(q, (-1, *[1] * len(batch)))
    noise = q[..., None, None] * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    first = _first(z, good)
    x = np.broadcast_to(np.stack([first, 0 * first], -2), (len(q), *batch, 2, z.shape[-1]))
    p = np.broadcast_to(np.diag([1e4 * sigma**2, 1e6]), (len(q), *batch, 2, 2))
    kept = []
    for step in range(steps):
        before_x, before_p = (x, p) if step == 0 else (f @ x, f @ p @ f.T + noise)
        variance = before_p[..., :1, :1] + sigma**2
        gain = np.where(good[..., step, None, None], before_p[..., :1] / variance, 0.0)
        x = before_x + gain * (z[..., step, None, :] - before_x[..., :1, :])
        p = before_p - gain * before_p[..., :1, :]
        kept.append((before_x, before_p, x, p))
    out = [x[..., 0, :]]
    for step in range(steps - 2, -1, -1):
        before_x, before_p = kept[step + 1][:2]
        gain = kept[step][3] @ f.T @ np.linalg.inv(before_p)
        x = kept[step][2] + gain @ (x - before_x)
        out.append(x[..., 0, :])
    return np.stack(out[::-1], -2)


def _first(z: Array, good: NDArray[np.bool_]) -> Array:
    """The first of the positions that are used, ``(..., d)``."""
    return np.take_along_axis(z, good.argmax(-1)[..., None, None], -2)[..., 0, :]


class Best(NamedTuple):
    """Errors with the best density."""

    rmse: float
    """RMSE over all fixes of all runs, m."""
    there: float
    """RMSE over the fixes that are no outliers, m."""
    q: float
    """The best density, m^2/s^3."""


def best(z: Array, good: NDArray[np.bool_], dt: float, sigma: float, truth: Array) -> Best:
    """The density with the least RMSE over all runs ``z (r, k, d)`` of a truth ``(k, d)``."""
    error = np.square(smoothed(z, good, dt, sigma, DENSITIES) - truth).sum(-1)
    least = int(error.mean((1, 2)).argmin())
    rmse, there = np.sqrt([error[least].mean(), error[least][good].mean()])
    return Best(float(rmse), float(there), float(DENSITIES[least]))
