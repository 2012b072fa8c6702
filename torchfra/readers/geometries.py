"""Positions in one cell: "47.1,8.2", objects of JSON, and points of data bases, perhaps with a grid (SRID)."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

from numpy.typing import NDArray

from torchfra.readers.columns import Cells, Head, is_missing
from torchfra.readers.spelling import found, places_in, plain

_HEX = re.compile(r"(?:\\x)?(?P<digits>0[01](?:[0-9A-Fa-f]{2}){20,36})")
_NUMBER = r"[+-]?[0-9]+(?:\.[0-9]*)?(?:[eE][+-]?[0-9]+)?"
_WKT = re.compile(
    rf"(?:SRID=(?P<srid>[0-9]+);)?\s*POINT\s*(?P<kind>Z|M|ZM)?\s*\(\s*(?P<numbers>{_NUMBER}(?:\s+{_NUMBER}){{1,3}})\s*\)",
    re.IGNORECASE,
)
_POINT, _Z, _M, _SRID, _ISO = 1, 0x80000000, 0x40000000, 0x20000000, 1000
"""The type of a point, what PostGIS adds to it for heights, measures and a grid, and what ISO adds per kind."""
_IN_DEGREES = {4326, 4258, 4269, 4979}
"""Grids of longitudes and latitudes: of GPS, Europe and North America."""
_STRETCHED = {3857, 900913, 3785}
"""Grids of maps in the web, whose metres grow with the latitude."""
_FINEST = 1e-4
"""Degrees, of which positions without a grid have some more digits; most lie off 0, 0."""
_PAIRS = {
    "position",
    "latlon",
    "latlng",
    "latlong",
    "latitudelongitude",
    "coordinates",
    "location",
    "gps",
    "координаты",
}
"""Names of columns that may hold a latitude and a longitude."""
_PAIR = re.compile(r"\s*[(\[]?\s*([+-]?[0-9]+\.?[0-9]*)\s*[,; ]\s*([+-]?[0-9]+\.?[0-9]*)\s*[)\]]?\s*(?:\([0-9]+\)\s*)?")
"""Both in one cell, and perhaps the number of satellites in brackets."""


class Point(NamedTuple):
    """A point of a cell."""

    numbers: tuple[float, ...]
    """East or longitude, north or latitude, and perhaps the height."""
    srid: int
    """Number of its grid; 0 where there is none."""


def point_of(text: str) -> Point | None:
    """The point of a cell; None where the cell is something else.

    Source: OGC 06-103r4, Simple Feature Access; PostGIS for EWKB.
    """
    text = text.strip()
    if match := _WKT.fullmatch(text):
        numbers = tuple(map(float, match["numbers"].split()))
        return Point(numbers[:2] if (match["kind"] or "").upper() == "M" else numbers[:3], int(match["srid"] or 0))
    return _decoded(bytes.fromhex(match["digits"])) if (match := _HEX.fullmatch(text)) else None


def _decoded(data: bytes) -> Point | None:
    """A point of WKB, of which PostGIS marks heights and grids by bits, and ISO by thousands."""
    order = "<" if data[0] else ">"
    (kind,) = struct.unpack_from(f"{order}I", data, 1)
    (srid,), start = struct.unpack_from(f"{order}I", data, 5) if kind & _SRID else (0,), 9 if kind & _SRID else 5
    thousands, base = divmod(kind & ~(_Z | _M | _SRID), _ISO)
    count = (len(data) - start) // 8
    height, measure = bool(kind & _Z) or thousands in (1, 3), bool(kind & _M) or thousands in (2, 3)
    if base != _POINT or thousands > 3 or len(data) != start + 8 * (2 + height + measure):
        return None
    return Point(struct.unpack_from(f"{order}{count}d", data, start)[: 2 + height], srid)


def axes_of(points: Sequence[Point]) -> tuple[str, ...]:
    """What the numbers of points are called; () where their grids differ, or some have heights and others not.

    Raises:
        ValueError: their grid has no metres, or they have none and may be degrees as well as metres.
    """
    if points and points[0].srid in _STRETCHED:
        raise ValueError(
            f"expected degrees or metres, received points of SRID {points[0].srid}, whose metres grow with the "
            "latitude: convert them, such as by ST_Transform(geom, 4326)"
        )
    if not points or len({(point.srid, len(point.numbers)) for point in points}) > 1:
        return ()
    degrees = points[0].srid in _IN_DEGREES or (not points[0].srid and _look_like_degrees(points))
    names = ("longitude", "latitude", "altitude") if degrees else ("x", "y", "z")
    return names[: len(points[0].numbers)]


def _look_like_degrees(points: Sequence[Point]) -> bool:
    """Whether all are within the earth's, most have more digits than metres need, and they are not about 0, 0.

    Raises:
        ValueError: all but their digits are those of degrees.
    """
    places = [point.numbers[:2] for point in points]
    if any(abs(x) > 180 or abs(y) > 90 for x, y in places) or max(max(map(abs, place)) for place in places) < 1:
        return False
    fine = sum(any(abs(value / _FINEST - round(value / _FINEST)) > 1e-6 for value in place) for place in places)
    if 2 * fine <= len(places):
        x, y = places[-1]
        raise ValueError(
            f"expected points with a grid, as in SRID=4326;POINT({x:g} {y:g}) or by ST_SetSRID(geom, 4326), received "
            "none: they may be degrees or metres"
        )
    return True


class Together(NamedTuple):
    """A column whose cells hold several numbers."""

    column: str
    axes: tuple[str, ...]
    """Names of the columns that are made of it."""
    numbers: Callable[[str], Sequence[Any] | None]
    """Those of a cell, or texts; None where it holds something else."""


def together_in(head: Head) -> Together | None:
    """The column that holds a position, as "47.1,8.2", a point or an object; None where none does, or names tell it."""
    if any(found(head.names, axis) for axis in ("latitude", "longitude", "x")):
        return None
    for name in head.names:
        cells = [cell for cell in head.cells(name) if isinstance(cell, str) and not is_missing(cell)]
        if plain(name) in _PAIRS and any(map(_PAIR.fullmatch, cells)):
            return Together(name, ("latitude", "longitude"), _pair)
        points = [point for cell in cells if (point := point_of(cell))]
        if points and len(points) == len(cells) and (axes := axes_of(points)):
            return Together(name, axes[:2] if axes[-1] in head.names else axes, _numbers_of_point)
        objects = [one for cell in cells if (one := _object(cell))]
        keys = list(dict.fromkeys(key for one in objects for key in one))
        axes = tuple(f"{name}.{key}" if key in head.names else key for key in keys)
        if objects and len(objects) == len(cells) and places_in(axes):
            return Together(name, axes, partial(_values_of, keys))
    return None


def _pair(cell: str) -> Sequence[str] | None:
    match = _PAIR.fullmatch(cell)
    return match.groups() if match else None


def _numbers_of_point(cell: str) -> Sequence[float] | None:
    point = point_of(cell)
    return point and point.numbers


def _object(cell: str) -> dict[str, Any]:
    """An object of JSON with the values of objects in it beside its own; empty of other text."""
    try:
        parsed = json.loads(cell) if cell.lstrip().startswith("{") else {}
    except (ValueError, RecursionError):
        return {}
    inner = [one for one in parsed.values() if isinstance(one, dict)]
    return {key: value for one in (parsed, *inner) for key, value in one.items() if not isinstance(value, dict)}


def _values_of(keys: Sequence[str], cell: str) -> Sequence[Any] | None:
    found = _object(cell)
    return [found.get(key) for key in keys] if found else None


def parted(cells: Cells, together: Together) -> Cells:
    """The cells of columns, with more: those of ``together``."""

    def part(cell: Any, axis: int) -> Any:
        numbers = together.numbers(cell) if isinstance(cell, str) else None
        return cell if numbers is None or len(numbers) <= axis else numbers[axis]  # what is something else is refused

    def of(name: str) -> Sequence[Any] | NDArray[Any]:
        if name not in together.axes:
            return cells(name)
        return [part(cell, together.axes.index(name)) for cell in cells(together.column)]

    return of
