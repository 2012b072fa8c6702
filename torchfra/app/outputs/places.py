"""Which way is up where a target is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchfra.geodesy import Origin
from torchfra.readers.columns import Array


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
