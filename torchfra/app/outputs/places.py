"""Where on the earth a track is, and which way is up there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pymap3d import enu2geodetic as enu_to_geodetic

from torchfra.readers.columns import Array
from torchfra.readers.recording import Origin

_ROUNDS = 4
"""Of the search for a height: each leaves less than a tenth of the error before it, within 2000 km of the origin."""


def geodetic(position: Array, origin: Origin) -> tuple[Array, Array, Array]:
    """Latitude and longitude in degrees and altitude in m, ``(T,)`` each; a target in the plane has the origin's.

    Args:
        position: ``(T, 3)`` m east, north, up of the origin, or ``(T, 2)``.
        origin: latitude, longitude, altitude.
    """
    east, north = position[:, 0], position[:, 1]
    if position.shape[1] == 3:
        return enu_to_geodetic(east, north, position[:, 2], *origin)
    up = np.zeros(len(position))
    for _ in range(_ROUNDS):  # the earth falls away below the plane
        up = up + origin[2] - enu_to_geodetic(east, north, up, *origin)[2]
    return enu_to_geodetic(east, north, up, *origin)


def turned(latitude: Array, longitude: Array, origin: Origin) -> NDArray[np.float64]:
    """``(T, 3, 3)``: turns vectors along the origin's east, north and up into those along the axes of each place."""
    here = _axes(np.radians(latitude), np.radians(longitude))
    there = _axes(np.radians(np.array([origin[0]])), np.radians(np.array([origin[1]])))
    return here @ there.transpose(0, 2, 1)


def _axes(latitude: Array, longitude: Array) -> NDArray[np.float64]:
    """``(T, 3, 3)``: east, north and up of places as rows, along the axes of the earth."""
    zero, sin, cos, sin_l, cos_l = (
        np.zeros_like(latitude), np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude),
    )  # fmt: skip
    rows = [[-sin_l, cos_l, zero], [-sin * cos_l, -sin * sin_l, cos], [cos * cos_l, cos * sin_l, sin]]
    return np.moveaxis(np.array(rows), -1, 0)
