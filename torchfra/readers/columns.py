"""From cells to columns of numbers and of text, and which format the columns are in."""

from __future__ import annotations

import math
from collections.abc import Callable
from datetime import datetime
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from torchfra.readers.tables import HEADERS, Table, listed

Array: TypeAlias = NDArray[np.float64]
Layout: TypeAlias = tuple[str, str, str, str, str, str]
"""Names of the columns with time, two coordinates, what marks a new position, altitude, and a second altitude."""

_EPOCH = datetime.fromisoformat("1970-01-01T00:00:00+00:00")
_TRAFFIC: Layout = ("timestamp", "latitude", "longitude", "last_position", "altitude", "")
_OPENSKY: Layout = ("time", "lat", "lon", "lastposupdate", "baroaltitude", "geoaltitude")
PLAIN: Layout = ("t", "x", "y", "z", "z", "")
"""Of files in seconds and metres; all others are in degrees."""
_REQUIRED = {_TRAFFIC: _TRAFFIC[:3], _OPENSKY: ("time", "icao24", "lat", "lon"), PLAIN: PLAIN[:3]}


def layout_of(table: Table) -> Layout:
    """The format that the columns fit best.

    Raises:
        ValueError: a required column is missing, or half of them or more whatever the format.
    """

    def fit(layout: Layout) -> float:
        return sum(name in table for name in _REQUIRED[layout]) / len(_REQUIRED[layout])

    best = max(_REQUIRED, key=fit)
    if fit(best) <= 0.5:
        raise ValueError(f"{HEADERS}; received {listed(table)}")
    if missing := [name for name in _REQUIRED[best] if name not in table]:
        formats = "; or ".join(", ".join(names) for names in _REQUIRED.values())
        raise ValueError(f"expected the columns {formats}; missing {listed(missing)}, received {listed(table)}")
    return best


def number(value: Any, limit: float = 1e15, unit: float = 1.0) -> float:
    """A cell as a number, NaN if empty; above ``limit``, far from all that moves, it is an error."""
    if value is None or (isinstance(value, str) and not value.strip()):
        return math.nan
    parsed = math.inf if isinstance(value, bool) else float(value)
    if abs(parsed) > limit:
        raise ValueError
    return parsed * unit


def _instant(value: Any) -> float:
    """Ms since 1970, or ISO text, as s since 1970."""
    try:
        milliseconds = number(value)
    except ValueError:
        moment = datetime.fromisoformat(str(value).strip().replace("Z", "+00:00"))
        return ((moment if moment.tzinfo else moment.replace(tzinfo=_EPOCH.tzinfo)) - _EPOCH).total_seconds()
    if 1e9 < milliseconds < 1e10:  # seconds since 1970 of this century, not ms
        raise ValueError
    return milliseconds / 1e3


_CELLS: dict[str, tuple[str, Callable[[Any], float]]] = {
    "timestamp": ("ms since 1970 or ISO text", _instant),
    "altitude": ("a number", partial(number, unit=0.3048)),
    **dict.fromkeys(("latitude", "lat"), ("degrees within +-90", partial(number, limit=90.0))),
    **dict.fromkeys(("longitude", "lon"), ("degrees within +-180", partial(number, limit=180.0))),
}


def column(table: Table, name: str) -> Array:
    """A column ``(rows,)`` in s, degrees or m; NaN where empty or absent.

    Raises:
        ValueError: a cell that is not a number of its kind.
    """
    return converted(table, name, *_CELLS.get(name, ("a number", number)))


def converted(table: Table, name: str, kind: str, convert: Callable[[Any], float]) -> Array:
    """A column ``(rows,)`` of cells of some ``kind``; NaN where absent.

    Raises:
        ValueError: a cell that ``convert`` refuses.
    """
    numbers = np.full(len(next(iter(table.values()))), math.nan)
    for i, value in enumerate(table.get(name, ())):
        try:
            numbers[i] = convert(value)
        except (TypeError, ValueError, OverflowError):
            raise ValueError(f"expected {kind} in data row {i + 1}, column {name}, received {value!r:.60}") from None
    return numbers


def text_column(table: Table, name: str) -> list[str]:
    """A column as text; "" where empty or absent."""
    values = table.get(name, [None] * len(next(iter(table.values()))))
    return ["" if value is None or value != value else str(value).strip() for value in values]
