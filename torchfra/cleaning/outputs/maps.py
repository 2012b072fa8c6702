"""Cleaned paths as maps take them: GPX 1.1, and KML 2.2 with the track of Google's extension where there are dates."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from html import escape
from typing import Any

import numpy as np

from torchfra.cleaning import Cleaned
from torchfra.cleaning.outputs.times import dates
from torchfra.geodesy import Origin, to_geodetic
from torchfra.readers.recording import Recording
from torchfra.tables import printable

KML, GX = "http://www.opengis.net/kml/2.2", "http://www.google.com/kml/ext/2.2"
_FILE = (
    f'<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="{KML}" xmlns:gx="{GX}"><Document>\n'
    '<Style id="track"><LineStyle><color>ffb27200</color><width>3</width></LineStyle></Style>\n'
)
_MODES = {2: "clampToGround", 3: "absolute"}
"""Whether a place of so many numbers is on the ground or has an altitude above the sea."""


def gpx(results: Sequence[Cleaned]) -> bytes:
    """A track of each target.

    Raises:
        ImportError: gpxpy is missing.
        ValueError: a recording without latitudes.
    """
    from gpxpy.gpx import GPX, GPXTrack, GPXTrackPoint, GPXTrackSegment

    file = GPX()
    file.creator = "torchfra"
    for cleaned in results:
        track, segment = GPXTrack(printable(cleaned.recording.name)), GPXTrackSegment()
        for place, date in _points(cleaned):
            time = None if date is None else datetime.fromisoformat(date.replace("Z", "+00:00"))
            degrees: dict[str, Any] = dict(zip(("longitude", "latitude", "elevation"), place, strict=False))
            segment.points.append(GPXTrackPoint(**degrees, time=time))
        track.segments.append(segment)
        file.tracks.append(track)
    text: str = file.to_xml(version="1.1")
    return text.encode()


def kml(results: Sequence[Cleaned]) -> bytes:
    """A line of each target, with the time of each of its places where there are dates.

    Raises:
        ValueError: a recording without latitudes.
    """
    marks = []
    for cleaned in results:
        points, mode = _points(cleaned), _MODES[cleaned.raw.shape[1]]
        if dates(cleaned) is None:
            places = " ".join(_text(place, ",") for place, _ in points)
            line = f"<LineString><altitudeMode>{mode}</altitudeMode><coordinates>{places}</coordinates></LineString>"
        else:
            whens = "\n".join(f"<when>{date}</when>" for _, date in points)
            places = "\n".join(f"<gx:coord>{_text([*place, 0.0][:3], ' ')}</gx:coord>" for place, _ in points)
            line = f"<gx:Track><altitudeMode>{mode}</altitudeMode>\n{whens}\n{places}\n</gx:Track>"
        name = escape(printable(cleaned.recording.name))
        marks.append(f"<Placemark><name>{name}</name><styleUrl>#track</styleUrl>\n{line}\n</Placemark>\n")
    return (_FILE + "".join(marks) + "</Document></kml>\n").encode()


def origin_of(recording: Recording) -> Origin:
    """Where on the earth a track is.

    Raises:
        ValueError: it has x and y without an origin.
    """
    if recording.origin is None:
        name = recording.source.name or recording.name
        raise ValueError(f"out: maps need latitudes and longitudes, and {name} has x and y: take .csv or .parquet")
    return recording.origin


def _points(cleaned: Cleaned) -> list[tuple[list[float], str | None]]:
    """Longitude, latitude[, altitude in m] and date, or None, of each step whose estimate is finite."""
    good, stamps = np.flatnonzero(~cleaned.failed), dates(cleaned)
    place = np.stack(to_geodetic(cleaned.position[good], origin_of(cleaned.recording))[: cleaned.raw.shape[1]])
    places = np.column_stack([place[1::-1].round(8).T, place[2:].round(3).T]).tolist()
    return [(of, None if stamps is None else stamps[i]) for of, i in zip(places, good, strict=True)]


def _text(place: list[float], between: str) -> str:
    return between.join(f"{v:.{8 if axis < 2 else 3}f}" for axis, v in enumerate(place))
