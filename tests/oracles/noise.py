"""The estimate of the measurement noise, and the filter of one target that uses it; Sage & Husa (1969); Chen, Zou & Wu.

Eq. (19) of Chen, Zou & Wu is the recursion; measurements are [azimuth, elevation, range].
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from oracles.basics import Array, Result, collect, difference, present
from oracles.kalman import update
from oracles.spherical import MEASURED_ANGLES, msc_measure, msc_predict


class Tuned(NamedTuple):
    """Options of the noise estimate, eq. (19)."""

    b: float = 0.96
    confidence: tuple[float, float] = (0.5, 0.5)  # of infrared (elements 0, 1) and laser (2)
    lowest: float = 0.25
    highest: float = 1e4
    warmup: int = 5
    residual: bool = False


class MeasurementNoise(NamedTuple):
    """Estimated variances (3,), and updates so far (3,)."""

    R: Array
    count: Array


def sage_husa(noise: MeasurementNoise, R0: Array, target: Array, weight: Array, how: Tuned) -> MeasurementNoise:
    """Eq. (19), element by element; ``target`` (3,): variance that the innovation shows; ``weight`` (3,)."""
    R, count = noise.R.copy(), noise.count.copy()
    for i in range(3):
        if weight[i] < 0.5:
            continue
        d = (1 - how.b) / (1 - how.b ** (count[i] + 2)) if how.b < 1 else 1 / (count[i] + 2)
        W = how.confidence[0 if i < 2 else 1]
        g = (1 - W) * weight[i]
        if count[i] >= how.warmup:
            R[i] = np.clip((1 - g * d) * R[i] + g * d * target[i], how.lowest * R0[i], how.highest * R0[i])
        count[i] += 1
    return MeasurementNoise(R, count)


def wrapped_azimuth(mean: Array) -> Array:
    """A state whose azimuth lies in [0, 2 pi)."""
    return np.array([*mean[:3], mean[3] % (2 * math.pi), *mean[4:]])


def iaukf(
    z: Array, mean0: Array, P0: Array, F: Array, QC: Array, R0: Array, how: Tuned | None = None, redraw: bool = True
) -> Result:
    """One target without clutter, z (T,3), NaN missing; ``how=None`` leaves the measurement noise as it is."""
    mean, P, noise, steps = mean0, P0, MeasurementNoise(R0, np.zeros(3)), []
    for row in z:
        u = msc_predict(mean, P, F, QC, redraw)
        seen = present(row)
        e = difference(row, u.zhat, MEASURED_ANGLES)
        weight = np.array([float(i in seen) for i in range(3)])
        if how is not None and not how.residual:
            noise = sage_husa(noise, R0, e**2 - np.diag(u.Pzz), weight, how)
        mean, P = u.mean, u.P
        if seen:
            mean, P = update(mean, P, u.Pzz[np.ix_(seen, seen)] + np.diag(noise.R[seen]), u.Pxz[:, seen], e[seen])
        if how is not None and how.residual:
            zhat, Pzz = msc_measure(mean, P)
            r = difference(row, zhat, MEASURED_ANGLES)
            noise = sage_husa(noise, R0, r**2 + np.diag(Pzz), weight, how)
        mean = wrapped_azimuth(mean)
        steps.append({"mean": mean, "P": P, "R": noise.R})
    return collect(steps)
