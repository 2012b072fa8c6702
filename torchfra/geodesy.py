"""Latitudes, longitudes and altitudes on WGS84, and metres east, north and up of a place.

Source: J. Zhu, "Conversion of Earth-centered Earth-fixed coordinates to geodetic coordinates", IEEE Transactions on
Aerospace and Electronic Systems 30(3), 1994, with Bowring's iteration on the reduced latitude.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from torchfra.numbers import Array

Origin: TypeAlias = tuple[float, float, float]
"""Latitude and longitude in degrees, altitude in metres."""

_AXIS = 6378137.0
"""Radius of the equator, m."""
_FLAT = 1 / 298.257223563
_SQUASH = _FLAT * (2 - _FLAT)
"""Eccentricity squared."""


def to_enu(latitude: ArrayLike, longitude: ArrayLike, altitude: ArrayLike, origin: Origin) -> Array:
    """Metres ``(..., 3)`` east, north and up of the origin, on the plane that touches the earth there.

    Args:
        latitude: ``(...)`` degrees.
        longitude: ``(...)`` degrees.
        altitude: ``(...)`` metres above the ellipsoid.
        origin: what becomes (0, 0, 0).

    Example:
        >>> torchfra.geodesy.to_enu(48.01, 11.0, 500.0, (48.0, 11.0, 500.0)).round(1).tolist()
        [0.0, 1112.0, -0.1]
    """
    return np.asarray((_ecef(latitude, longitude, altitude) - _ecef(*origin)) @ _axes(*origin[:2]))


def to_geodetic(position: ArrayLike, origin: Origin) -> tuple[Array, Array, Array]:
    """Latitude and longitude in degrees and altitude in metres, ``(...)`` each.

    Args:
        position: ``(..., 3)`` metres east, north and up; or ``(..., 2)`` of targets without altitudes, which are then
            at that of the origin.
        origin: where (0, 0, 0) is.

    Example:
        >>> [round(float(x), 4) for x in torchfra.geodesy.to_geodetic([0.0, 1112.0], (48.0, 11.0, 500.0))]
        [48.01, 11.0, 500.0]
    """
    position = np.asarray(position, dtype=np.float64)
    if position.shape[-1] == 3:
        return _geodetic(position, origin)
    up = np.zeros(position.shape[:-1])
    for _ in range(12):  # Newton's method, as the earth curves down; a few rounds up to 85 degrees from the origin
        latitude, longitude, altitude = _geodetic(np.concatenate([position, up[..., None]], -1), origin)
        step = (origin[2] - altitude) / cosine(latitude, longitude, origin)
        up = up + step
        if not (np.abs(step) > 1e-4).any():
            break
    return latitude, longitude, np.full_like(up, origin[2])


def turned(latitude: ArrayLike, longitude: ArrayLike, origin: Origin) -> Array:
    """``(..., 3, 3)``: turns vectors along east, north and up of the origin into those along the axes of each place.

    Args:
        latitude: ``(...)`` degrees.
        longitude: ``(...)`` degrees.
        origin: whose axes the vectors have.
    """
    return np.asarray(np.swapaxes(_axes(latitude, longitude), -1, -2) @ _axes(*origin[:2]))


def cosine(latitude: ArrayLike, longitude: ArrayLike, origin: Origin) -> Array:
    """``(...)`` cosine of the angle between up at each place and up at the origin.

    Args:
        latitude: ``(...)`` degrees.
        longitude: ``(...)`` degrees.
        origin: whose altitude does not matter.
    """
    return np.asarray(_axes(latitude, longitude)[..., 2] @ _axes(*origin[:2])[:, 2])


def _geodetic(position: Array, origin: Origin) -> tuple[Array, Array, Array]:
    x, y, z = np.moveaxis(position @ _axes(*origin[:2]).T + _ecef(*origin), -1, 0)
    out, polar = np.hypot(x, y), _AXIS * (1 - _FLAT)
    reduced = np.arctan2(z, (1 - _FLAT) * out)
    for _ in range(3):
        rise = z + _SQUASH / (1 - _SQUASH) * polar * np.sin(reduced) ** 3
        latitude = np.arctan2(rise, out - _SQUASH * _AXIS * np.cos(reduced) ** 3)
        reduced = np.arctan2((1 - _FLAT) * np.sin(latitude), np.cos(latitude))
    surface = _AXIS * np.sqrt(1 - _SQUASH * np.sin(latitude) ** 2)
    altitude = out * np.cos(latitude) + z * np.sin(latitude) - surface
    return np.degrees(latitude), np.degrees(np.arctan2(y, x)), altitude


def _ecef(latitude: ArrayLike, longitude: ArrayLike, altitude: ArrayLike) -> Array:
    """Metres ``(..., 3)`` from the centre of the earth, which turns with them."""
    lat, lon, up = np.radians(latitude), np.radians(longitude), np.asarray(altitude)
    across = _AXIS / np.sqrt(1 - _SQUASH * np.sin(lat) ** 2)
    out = (across + up) * np.cos(lat)
    return np.stack(
        np.broadcast_arrays(out * np.cos(lon), out * np.sin(lon), (across * (1 - _SQUASH) + up) * np.sin(lat)), -1
    )


def _axes(latitude: ArrayLike, longitude: ArrayLike) -> Array:
    """Columns ``(..., 3, 3)`` that point east, north and up."""
    lat, lon = np.broadcast_arrays(np.radians(latitude), np.radians(longitude))
    east = [-np.sin(lon), np.cos(lon), np.zeros_like(lon)]
    north = [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)]
    up = [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]
    return np.moveaxis(np.array([east, north, up]), (0, 1), (-1, -2))
