"""Where two lines of sight cross, by solving for both ranges, and its covariance by the information of each line."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from oracles.basics import Array


def crossing(stations: Array, bearings: Sequence[float], stds: Sequence[float]) -> tuple[Array, Array, Array]:
    """Position (2,), covariance (2, 2) and ranges (2,) of lines from stations (2, 2), clockwise from +y."""
    along = np.array([[math.sin(b), math.cos(b)] for b in bearings])
    ranges = np.linalg.solve(np.stack([along[0], -along[1]], 1), stations[1] - stations[0])
    information = np.zeros((2, 2))
    for (x, y), r, std in zip(along, ranges, stds, strict=True):
        across = np.array([y, -x])
        information += np.outer(across, across) / (r * std) ** 2
    return stations[0] + ranges[0] * along[0], np.linalg.inv(information), ranges
