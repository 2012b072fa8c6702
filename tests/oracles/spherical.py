"""Modified spherical coordinates [omega, elevation rate, d ln r / dt, azimuth, elevation, 1 / r]; Chen, Zou & Wu.

omega is the azimuth rate times cos(elevation), azimuths count from north clockwise. Eqs. (1)-(2) are the coordinates,
(11)-(18) prediction and predicted measurement [azimuth, elevation, range] by unscented points.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from oracles.basics import Array
from oracles.cubature import draw, moments, unscented

RULE = unscented(6, 1.0, 2.0, 0.0)
STATE_ANGLES = np.array([False, False, False, True, False, False])
MEASURED_ANGLES = np.array([True, False, False])


class Predicted(NamedTuple):
    """A prediction and its measurement, R left out."""

    mean: Array  # (6,)
    P: Array  # (6,6)
    zhat: Array  # (3,)
    Pzz: Array  # (3,3)
    Pxz: Array  # (6,3)


def msc_axes(azimuth: float, elevation: float) -> tuple[Array, Array, Array]:
    """Unit vectors out, across and up of a line of sight, azimuth from north clockwise."""
    sb, cb, se, ce = math.sin(azimuth), math.cos(azimuth), math.sin(elevation), math.cos(elevation)
    return np.array([ce * sb, ce * cb, se]), np.array([cb, -sb, 0.0]), np.array([-se * sb, -se * cb, ce])


def msc_to_cartesian(xi: Array) -> Array:
    """Chen, Zou & Wu, eq. (1): [omega, elevation rate, d ln r / dt, azimuth, elevation, 1 / r] to Cartesian."""
    out, across, up = msc_axes(xi[3], xi[4])
    r = 1 / xi[5]
    return np.concatenate([r * out, r * (xi[2] * out + xi[0] * across + xi[1] * up)])


def msc_from_cartesian(X: Array) -> Array:
    """Eq. (2), by projections on the line of sight."""
    x, y, z = X[:3]
    azimuth, elevation, r = math.atan2(x, y) % (2 * math.pi), math.atan2(z, math.hypot(x, y)), math.sqrt(X[:3] @ X[:3])
    out, across, up = msc_axes(azimuth, elevation)
    v = X[3:]
    return np.array([v @ across / r, v @ up / r, v @ out / r, azimuth, elevation, 1 / r])


def msc_jacobian(xi: Array) -> Array:
    """Derivatives of eq. (2) by the Cartesian state, row by row from the product rule."""
    omega, climb, opening, azimuth, elevation, s = xi
    out, across, up = msc_axes(azimuth, elevation)
    tangent, zero = math.tan(elevation), np.zeros(3)
    return np.array([
        np.concatenate([s * (-(opening - climb * tangent) * across - omega * out), s * across]),
        np.concatenate([s * (-opening * up - omega * tangent * across - climb * out), s * up]),
        np.concatenate([s * (omega * across + climb * up - opening * out), s * out]),
        np.concatenate([s / math.cos(elevation) * across, zero]),
        np.concatenate([s * up, zero]),
        np.concatenate([-(s**2) * out, zero]),
    ])  # fmt: skip


def _measured(points: Array) -> tuple[Array, Array]:
    """Mean (3,) and deviations (k,3) of the measurements of points (k,6)."""
    h = np.array([[x[3], x[4], 1 / x[5]] for x in points])
    return moments(h, h[0], MEASURED_ANGLES, RULE[1])


def msc_measure(mean: Array, P: Array) -> tuple[Array, Array]:
    """What a belief predicts of the measurement: mean (3,) and covariance (3,3), R left out."""
    zhat, off = _measured(draw(mean, P, RULE))
    return zhat, off.T @ np.diag(RULE[2]) @ off


def msc_predict(mean: Array, P: Array, F: Array, QC: Array, redraw: bool = True) -> Predicted:
    """Eqs. (11)-(18) with alpha 1, kappa 0, psi 2; ``redraw=False`` measures the propagated points, as printed."""
    wc = np.diag(RULE[2])
    moved = np.array([msc_from_cartesian(F @ msc_to_cartesian(x)) for x in draw(mean, P, RULE)])
    ahead, gap = moments(moved, moved[0], STATE_ANGLES, RULE[1])
    J = msc_jacobian(ahead)
    P = gap.T @ wc @ gap + J @ QC @ J.T
    if redraw:
        moved = draw(ahead, P, RULE)
        gap = moved - ahead
    zhat, off = _measured(moved)
    return Predicted(ahead, P, zhat, off.T @ wc @ off, gap.T @ wc @ off)
