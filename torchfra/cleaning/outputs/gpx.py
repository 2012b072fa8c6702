"""Tracks as GPX 1.1."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Any
from xml.etree.ElementTree import Element

from torchfra.cleaning import Cleaned
from torchfra.cleaning.outputs.points import Points, points
from torchfra.tables import printable

NAMESPACE = "https://pypi.org/project/torchfra/gpx"
"""Namespace of the elements that extend GPX."""


def encode(results: Sequence[Cleaned]) -> bytes:
    """A track of each target, and its rejected fixes as waypoints where they were recorded.

    The attributes of the points are extensions of them, and manoeuvres are extensions of the track.

    Raises:
        ImportError: gpxpy is missing.
        ValueError: a recording without latitudes.
    """
    from gpxpy.gpx import GPX

    file = GPX()
    file.creator = "torchfra"
    file.nsmap["torchfra"] = NAMESPACE
    for cleaned in results:
        _add(file, points(cleaned))
    text: str = file.to_xml(version="1.1")
    return text.encode()


def _add(file: Any, of: Points) -> None:
    from gpxpy.gpx import GPXTrack, GPXTrackPoint, GPXTrackSegment, GPXWaypoint

    name = printable(of.name)
    track, segment = GPXTrack(name), GPXTrackSegment()
    for i, place in enumerate(of.place.tolist()):
        time = None if of.dates is None else datetime.fromisoformat(of.dates[i].replace("Z", "+00:00"))
        point = GPXTrackPoint(**_degrees(place), time=time)
        known = {key: values[i] for key, values in of.attributes.items() if values[i] not in (None, "")}
        point.extensions = [_element(key, str(value)) for key, value in known.items()]
        segment.points.append(point)
    track.segments.append(segment)
    track.extensions = [_element("manoeuvre", None, **manoeuvre._asdict()) for manoeuvre, _ in of.manoeuvres]
    file.tracks.append(track)
    for place, row in zip(of.rejected, of.rejected_rows, strict=True):
        file.waypoints.append(GPXWaypoint(**_degrees(place), name=f"{name}: rejected, row {row}", symbol="Flag, Red"))


def _degrees(place: list[float]) -> dict[str, Any]:
    return dict(zip(("longitude", "latitude", "elevation"), place, strict=False))


def _element(name: str, text: str | None, **attributes: Any) -> Element:
    element = Element(f"{{{NAMESPACE}}}{name}", {key: str(value) for key, value in attributes.items()})
    element.text = text
    return element
