"""What a recording is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from torchfra.readers.columns import Array

Origin: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Recording:
    """The track of one target."""

    name: str
    """icao24 and first callsign, as far as the file has them; otherwise the stem of the file."""
    time: Array
    """``(k,)`` seconds, strictly increasing; since 1970 if the file counts so."""
    position: Array
    """``(k, 3)`` metres east, north, up of the origin; ``(k, 2)`` for a target without any altitude."""
    origin: Origin | None
    """Latitude and longitude in degrees, altitude in metres; None for a file of x and y."""
    repairs: dict[str, int]
    """Each kind of repair, and the number of rows; empty if there was none."""
