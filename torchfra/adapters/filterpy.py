"""Kalman filters of FilterPy as models of torchfra.

FilterPy's other filters have functions of numpy arrays, which have no gradients: write those as a motion and a sensor.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from filterpy.kalman import KalmanFilter

from torchfra import motion, sensors
from torchfra.adapters.linear import Models, checked_order, gaussian
from torchfra.linalg import covariance_root
from torchfra.numbers import Array


def models(kf: KalmanFilter, *, order: Sequence[int] | None = None, dims: int | None = None) -> Models:
    """Motion, sensor and prior of a ``KalmanFilter``, by its ``F``, ``Q``, ``B``, ``H``, ``R``, ``x`` and ``P``.

    Its matrices are those of one step, of whatever length, and a ``dt`` of 0 is no step.  A number is what it is in a
    step of FilterPy: ``Q`` is added to every element, ``P`` is times the identity, and ``R`` is of a single
    measured element.

    Args:
        kf: with its matrices set.
        order: numbers of its components in torchfra's order, positions first and then velocities: ``(0, 2, 1, 3)`` of
            ``[x, vx, y, vy]``; None if that is its own.
        dims: how many of them are positions; None for as many as there are measured elements.

    Raises:
        ValueError: another filter, one that fades (``alpha``), an order that does not name each component once, or a
            matrix that does not fit.
    """
    if not isinstance(kf, KalmanFilter):
        raise ValueError(f"kf: expected a filterpy.kalman.KalmanFilter, received {type(kf).__name__}")
    if kf.alpha != 1.0:
        raise ValueError(f"kf: expected alpha 1, received {kf.alpha}: take torchfra.adaptive.Fading")
    index = checked_order(order, kf.dim_x)
    square = np.ix_(index, index)
    n, m = kf.dim_x, kf.dim_z
    matrix, noise = _matrix(kf, "F", n, n)[square], _matrix(kf, "Q", n, n, np.ones((n, n)))[square]
    root = covariance_root(torch.from_numpy(noise), "kf.Q")
    control = None if kf.B is None else np.array(kf.B, dtype=float).reshape(n, -1)[index]
    moves = motion.Linear(matrix, root=root, B=control, dims=dims or min(m, n))
    sensor = sensors.Linear(_matrix(kf, "H", m, n)[:, index], _matrix(kf, "R", m, m))
    return Models(moves, sensor, gaussian(kf.x, _matrix(kf, "P", n, n, np.eye(n)), index))


def _matrix(kf: KalmanFilter, name: str, rows: int, columns: int, unit: Array | None = None) -> Array:
    """A matrix of a filter.

    Args:
        kf: the filter.
        name: of the matrix.
        rows: it has.
        columns: it has.
        unit: what a number is times of; None where it is nothing but the single element of a matrix.

    Raises:
        ValueError: another shape.
    """
    given = np.array(getattr(kf, name), dtype=float)
    if given.ndim == 0 and (unit is not None or rows == columns == 1):
        return given * (np.ones((1, 1)) if unit is None else unit)
    if given.shape != (rows, columns):
        received = f"the number {given:g}" if given.ndim == 0 else given.shape
        raise ValueError(f"kf.{name}: expected a matrix ({rows}, {columns}), received {received}")
    return given
