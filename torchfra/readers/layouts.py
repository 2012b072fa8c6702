"""Which format the columns of a file of tracks are in."""

from __future__ import annotations

from typing import TypeAlias

from torchfra.readers.columns import INSTANT, SECONDS, Kind
from torchfra.readers.tables import HEADERS, Wanted, listed

Layout: TypeAlias = tuple[str, str, str, str, str, str]
"""Names of the columns with time, two coordinates, what marks a new position, altitude, and a second altitude."""

_TRAFFIC: Layout = ("timestamp", "latitude", "longitude", "last_position", "altitude", "")
_OPENSKY: Layout = ("time", "lat", "lon", "lastposupdate", "baroaltitude", "geoaltitude")
PLAIN: Layout = ("t", "x", "y", "z", "z", "")
"""Of files in seconds and metres; all others are in degrees."""
_REQUIRED = {_TRAFFIC: _TRAFFIC[:3], _OPENSKY: ("time", "icao24", "lat", "lon"), PLAIN: PLAIN[:3]}
_KINDS = {
    "timestamp": INSTANT,
    **dict.fromkeys(("time", "t"), SECONDS),
    "altitude": Kind(unit=0.3048),
    **dict.fromkeys(("latitude", "lat"), Kind("degrees within +-90", limit=90.0)),
    **dict.fromkeys(("longitude", "lon"), Kind("degrees within +-180", limit=180.0)),
}


def layout_of(names: list[str]) -> Layout:
    """The format that the columns fit best.

    Raises:
        ValueError: a required column is missing, or half of them or more whatever the format.
    """

    def fit(layout: Layout) -> float:
        return sum(name in names for name in _REQUIRED[layout]) / len(_REQUIRED[layout])

    best = max(_REQUIRED, key=fit)
    if fit(best) <= 0.5:
        raise ValueError(f"{HEADERS}; received {listed(names)}")
    if missing := [name for name in _REQUIRED[best] if name not in names]:
        formats = "; or ".join(", ".join(columns) for columns in _REQUIRED.values())
        raise ValueError(f"expected the columns {formats}; missing {listed(missing)}, received {listed(names)}")
    return best


def columns_wanted(names: list[str]) -> Wanted:
    """What is read of a file with these columns.

    Raises:
        ValueError: see ``layout_of``.
    """
    layout = layout_of(names)
    wanted: Wanted = {name: _KINDS.get(name, Kind()) for name in layout if name in names}
    texts = () if layout is PLAIN else ("icao24", "callsign")
    return wanted | dict.fromkeys((name for name in texts if name in names), None)
