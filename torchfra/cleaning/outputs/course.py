"""Speed, course and climb of a target, with their standard deviations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchfra.cleaning import Cleaned
from torchfra.geodesy import to_geodetic, turned
from torchfra.readers.columns import Array


class Course(NamedTuple):
    """Each ``(T,)``; in the local axes of the target, not those of a far origin."""

    speed: Array
    """Over ground, m/s."""
    speed_std: Array
    """Its standard deviation, m/s."""
    course: Array
    """Degrees clockwise from north (from +y without an origin), in [0, 360)."""
    climb: Array | None
    """Vertical velocity, m/s; None in the plane."""
    along: Array
    """Standard deviation of the position along the course, m."""
    across: Array
    """Standard deviation to the right of the course, horizontally, m."""
    up: Array | None
    """Vertical standard deviation, m; None in the plane."""


def course(cleaned: Cleaned) -> Course:
    """Speed, course and climb of each step, and the standard deviations of the position along and across."""
    d = cleaned.raw.shape[1]
    velocity, covariance, of_velocity = _at_the_target(cleaned)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    angle = np.arctan2(velocity[:, 0], velocity[:, 1])
    sin, cos, zero = np.sin(angle), np.cos(angle), np.zeros_like(angle)
    along, across = np.stack([sin, cos, zero], 1)[:, :d], np.stack([cos, -sin, zero], 1)[:, :d]
    return Course(
        speed=speed,
        speed_std=_std(of_velocity, along),
        course=np.degrees(angle) % 360,
        climb=velocity[:, 2] if d == 3 else None,
        along=_std(covariance, along),
        across=_std(covariance, across),
        up=np.sqrt(covariance[:, 2, 2]) if d == 3 else None,
    )


def _std(covariance: NDArray[np.float64], way: Array) -> Array:
    variance: Array = np.einsum("ti,tij,tj->t", way, covariance, way)
    return np.sqrt(variance)


def _at_the_target(cleaned: Cleaned) -> tuple[Array, NDArray[np.float64], NDArray[np.float64]]:
    """Velocity ``(T, d)`` along east, north and up where the target is; covariances of position and velocity."""
    d, origin = cleaned.raw.shape[1], cleaned.recording.origin
    position, velocity = cleaned.covariance[:, :d, :d], cleaned.covariance[:, d:, d:]
    if origin is None:
        return cleaned.velocity, position, velocity
    turn = turned(*to_geodetic(cleaned.position, origin)[:2], origin)
    if d == 2:  # it stays level, whatever that is in the axes of the origin
        turn = turn[:, :2, :2] - turn[:, :2, 2:] * turn[:, 2:, :2] / turn[:, 2:, 2:]
    back = turn.transpose(0, 2, 1)
    return np.einsum("tij,tj->ti", turn, cleaned.velocity), turn @ position @ back, turn @ velocity @ back
