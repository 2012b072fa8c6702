"""Recordings: the track of a target, and the form of the file that it comes from."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from torchfra.geodesy import Origin as Origin
from torchfra.readers.columns import Array


@dataclass(frozen=True)
class Source:
    """The form of the tracks in a file, table or DataFrame, so that results can be written in its units."""

    name: str = ""
    """Of the file."""
    columns: dict[str, str] = field(default_factory=dict)
    """Name of the column of each quantity: ``time, x, y, z, latitude, longitude, altitude, id, sigma``."""
    unit: float = 1.0
    """Metres in one of its units of length: of x, y and z, or of altitudes beside latitudes."""
    word: str = "target"
    """What its targets are: ``"aircraft"``, ``"ship"``, ``"animal"``, ``"drone"``, ``"glider"``, or ``"target"``."""
    notes: tuple[str, ...] = ()
    """Lines for a person: which columns were taken, which ignored, feet or metres."""
    argos: bool = False
    """Whether standard deviations are those of classes or ellipses of Argos, which are the noise as they are."""


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
    row: NDArray[np.int64] | None = None
    """``(k,)`` which row of the file each fix is, from 0; None of tracks that come from no table."""
    sigma: Array | None = None
    """``(k,)`` or ``(k, d)`` standard deviation of each fix per axis as the file says, m; None if it does not."""
    source: Source = Source()
    filled: NDArray[np.bool_] | None = None
    """``(k,)`` whether the altitude of a fix is missing in the file, and is that of the fix before (or after); None of
    tracks without altitudes, and of those that come from no file.  Cleaning takes them for missing."""
