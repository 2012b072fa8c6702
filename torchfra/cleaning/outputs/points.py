"""A cleaned track as the formats of maps take it."""

from __future__ import annotations

from math import isfinite
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchfra.cleaning import Cleaned, Segment
from torchfra.cleaning.outputs.table import columns, recorded
from torchfra.cleaning.outputs.times import dates
from torchfra.geodesy import Origin, to_geodetic
from torchfra.readers.columns import Array
from torchfra.readers.recording import Recording

ATTRIBUTES = ("row", "seconds", "speed", "course", "climb", "std_along", "std_across", "std_up",
              "outlier", "manoeuvre", "flag")  # fmt: skip
"""Columns of the table that each point of a map keeps, as far as there are."""


class Points(NamedTuple):
    """One target, with values ``(T,)`` of the steps whose estimate is finite."""

    name: str
    place: Array
    """``(T, 2 or 3)`` longitude and latitude in degrees, altitude in m, to a millimetre as all places here."""
    dates: list[str] | None
    """UTC, ISO 8601; None where the times of the input are no dates."""
    attributes: dict[str, list[Any]]
    """By name of ``ATTRIBUTES``; None where unknown."""
    rejected: list[list[float]]
    """The recorded place of each outlier: longitude, latitude and, if it is known, altitude."""
    rejected_rows: list[int]
    """Rows of these outliers in the input."""
    manoeuvres: list[tuple[Segment, NDArray[np.intp]]]
    """Each with the numbers of its steps."""


def points(cleaned: Cleaned) -> Points:
    """A track in degrees.

    Raises:
        ValueError: the recording has x and y without an origin.
    """
    origin = origin_of(cleaned.recording)
    good, rejected = ~cleaned.failed, cleaned.flag == "outlier"
    table, at = columns(cleaned), np.flatnonzero(good)
    stamps = dates(cleaned)
    attributes = {name: _known(name, table[name][good]) for name in ATTRIBUTES if name in table}
    number = np.cumsum(good) - 1
    manoeuvres = [
        (segment, number[at[(cleaned.time[at] >= segment.begin) & (cleaned.time[at] <= segment.end)]])
        for segment in cleaned.segments
    ]
    return Points(
        cleaned.recording.name,
        _place(np.stack(to_geodetic(cleaned.position[good], origin)[: cleaned.raw.shape[1]])),
        None if stamps is None else [stamps[i] for i in at],
        attributes,
        [[*filter(isfinite, place)] for place in _place(recorded(cleaned, origin)[:, rejected]).tolist()],
        table["row"][rejected].tolist(),
        manoeuvres,
    )


def origin_of(recording: Recording) -> Origin:
    """Where on the earth a track is.

    Raises:
        ValueError: it has x and y without an origin.
    """
    if recording.origin is None:
        name = recording.source.name or recording.name
        raise ValueError(f"out: maps need latitudes and longitudes, and {name} has x and y: take .csv or .parquet")
    return recording.origin


def _place(geodetic: Array) -> Array:
    """Longitudes, latitudes and altitudes ``(T, 2 or 3)``, of latitudes, longitudes and altitudes ``(2 or 3, T)``."""
    return np.column_stack([geodetic[1::-1].round(8).T, geodetic[2:].round(3).T])


def _known(name: str, values: NDArray[Any]) -> list[Any]:
    if values.dtype.kind == "f":
        return [round(v, 4) if np.isfinite(v) else None for v in values.tolist()]
    return [None if name == "row" and v < 0 else v for v in values.tolist()]
