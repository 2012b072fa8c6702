"""The state-space model of an oracle, the motions and sensors of the tests, angles, missing elements.

Wang et al. (2021), J. Air Force Eng. Univ. 22(1):70-76, eqs. (1)-(6); coordinated turn: Bar-Shalom, Li & Kirubarajan.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Result = dict[str, Array]


class Model(NamedTuple):
    """x_k = F x_{k-1} + SQ w, z_k = h(x_k, k) + SR v. F, SQ and SR may also be callables of k."""

    F: Array | Callable[[int], Array]  # (n,n)
    SQ: Array | Callable[[int], Array]  # (n,r), Q = SQ SQ^T
    SR: Array | Callable[[int], Array]  # (m,m) lower triangular, R = SR SR^T
    h: Callable[[Array, int], Array]  # (n,), k -> (m,)
    angles: Array  # (m,) True where the element is an angle


def wrap(a: Any) -> Any:
    """Angle(s) into [-pi, pi)."""
    return np.mod(np.asarray(a) + np.pi, 2 * np.pi) - np.pi


def difference(a: Array, b: Array, angles: Array) -> Array:
    """a - b, wrapped where it is an angle."""
    return np.where(angles, wrap(a - b), a - b)


def at(value: Any, k: int) -> Array:
    """A constant, or a callable's value at step k."""
    return np.array(value(k) if callable(value) else value, dtype=float)


def present(z: Array) -> list[int]:
    """Indices of the elements of z (m,) that are not missing."""
    return [i for i, value in enumerate(z) if not math.isnan(value)]


def measurement_noise(model: Model, k: int, seen: list[int]) -> Array:
    """R (s,s) of the elements that are not missing."""
    SR = at(model.SR, k)
    return (SR @ SR.T)[np.ix_(seen, seen)]


def collect(steps: list[dict[str, Any]]) -> Result:
    """Steps of a filter as one array for each key."""
    return {key: np.array([step[key] for step in steps]) for key in steps[0]}


def ca(dt: float, q: float) -> tuple[Array, Array]:
    """Constant acceleration, eqs. (1)-(5): F (6,6) and SQ (6,2) on [x, y, vx, vy, ax, ay]; q is a variance."""
    F = np.kron(np.array([[1, dt, dt**2 / 2], [0, 1, dt], [0, 0, 1]]), np.eye(2))
    return F, math.sqrt(q) * np.kron(np.array([[dt**2 / 2], [dt], [1]]), np.eye(2))


def cv(dt: float, q: float) -> tuple[Array, Array]:
    """Constant velocity: F (4,4) and SQ (4,2) on [x, y, vx, vy]."""
    F = np.kron(np.array([[1, dt], [0, 1]]), np.eye(2))
    return F, math.sqrt(q) * np.kron(np.array([[dt**2 / 2], [dt]]), np.eye(2))


def turn(dt: float, rate: float, q: float) -> tuple[Array, Array]:
    """Coordinated turn of known rate (rad/s, counter-clockwise positive): F (4,4), SQ (4,2) on [x, y, vx, vy]."""
    (F, SQ), s, c = cv(dt, q), math.sin(rate * dt), math.cos(rate * dt)
    if rate != 0:
        less = 2 * math.sin(rate * dt / 2) ** 2  # 1 - c, without cancellation at small rates
        F[:2, 2:] = np.array([[s, -less], [less, s]]) / rate
        F[2:, 2:] = np.array([[c, -s], [s, c]])
    return F, SQ


def bearings(x: Array, stations: Array) -> Array:
    """Bearings (k,) of the position x[:2] from stations (k,2), from +y, clockwise positive, eq. (6)."""
    return np.array([math.atan2(x[0] - sx, x[1] - sy) for sx, sy in stations])
