"""Kalman filters of FilterPy as models of torchfra.

FilterPy's other filters have functions of numpy arrays, which have no gradients: write those as a motion and a sensor.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from filterpy.kalman import KalmanFilter

from torchfra.adapters.linear import LinearMotion, LinearSensor, Models, checked_order, gaussian


def models(kf: KalmanFilter, *, order: Sequence[int] | None = None, dims: int | None = None) -> Models:
    """Motion, sensor and prior of a ``KalmanFilter``, by its ``F``, ``Q``, ``B``, ``H``, ``R``, ``x`` and ``P``.

    Its matrices are those of one step, of whatever length: ``dt`` does not matter.

    Args:
        kf: with its matrices set.
        order: numbers of its components in torchfra's order, positions first and then velocities: ``(0, 2, 1, 3)`` of
            ``[x, vx, y, vy]``; None if that is its own.
        dims: how many of them are positions; None for as many as there are measured elements.

    Raises:
        ValueError: another filter, one that fades (``alpha``), or an order that does not name each component once.
    """
    if not isinstance(kf, KalmanFilter):
        raise ValueError(f"kf: expected a filterpy.kalman.KalmanFilter, received {type(kf).__name__}")
    if kf.alpha != 1.0:
        raise ValueError(f"kf: expected alpha 1, received {kf.alpha}: take torchfra.adaptive.Fading")
    index = checked_order(order, kf.dim_x)
    square = np.ix_(index, index)
    matrix, noise = np.array(kf.F, dtype=float)[square], np.array(kf.Q, dtype=float)[square]
    control = None if kf.B is None else np.array(kf.B, dtype=float).reshape(kf.dim_x, -1)[index]
    motion = LinearMotion(lambda seconds: (matrix, noise), kf.dim_x, dims or min(kf.dim_z, kf.dim_x), control)
    sensor = LinearSensor(np.array(kf.H, dtype=float)[:, index], np.array(kf.R, dtype=float))
    return Models(motion, sensor, gaussian(kf.x, kf.P, index))
