"""Tracks in XML: GPX and KML.

None needs entities, so that a file that defines some is refused.
"""

from __future__ import annotations

import re
from collections import Counter
from typing import Any
from xml.etree import ElementTree

from torchfra.readers.columns import short
from torchfra.readers.sheets import Sheet, points_sheet

_COLUMNS = ("time", "latitude", "longitude", "altitude", "id", "hdop")
Point = tuple[Any, ...]
"""The cells of a fix, in the order of ``_COLUMNS``."""


def xml_sheet(text: str) -> Sheet:
    """The points of GPX or KML.

    Raises:
        ValueError: none of these, or it defines entities.
    """
    text = re.sub(r"^\s*<\?xml[^>]*\?>", "", text)
    if "<!DOCTYPE" in text:
        raise ValueError("expected GPX or KML without <!DOCTYPE>, received one that has it")
    try:
        tree = ElementTree.fromstring(text)
    except (ElementTree.ParseError, UnicodeError) as error:
        raise ValueError(f"expected GPX or KML, received other text ({error})") from error
    if _tag(tree) == "gpx":
        return _gpx_sheet(tree)
    if _tag(tree) == "kml":
        return _kml_sheet(tree)
    raise ValueError(
        "expected GPX or KML, received other XML: export TCX as GPX, or write points as CSV under time,x,y or "
        "time,lat,lon, as xml2csv.py of SUMO does"
    )


def _gpx_sheet(root: ElementTree.Element) -> Sheet:
    """Points of tracks; waypoints and points of routes are no track."""
    tracks = [one for one in root if _tag(one) == "trk"]
    rows, used = list[Point](), Counter[str]()
    for number, track in enumerate(tracks):
        name = _text(track, "name") or (f"track {number + 1}" if len(tracks) > 1 else "")
        used[name] += 1
        label = name if used[name] == 1 else f"{name} {used[name]}"
        for point in (one for one in track.iter() if _tag(one) == "trkpt"):
            place = point.get("lat"), point.get("lon")
            rows.append((_text(point, "time"), *place, _text(point, "ele"), label, _text(point, "hdop")))
    others = sum(_tag(one) in ("wpt", "rtept") for one in root.iter())
    left_out = f"; waypoints and points of routes left out: {others}" if others else ""
    return _timed(rows, (f"GPX: {len(tracks)} track{'s' * (len(tracks) != 1)}{left_out}",), "GPX")


def _kml_sheet(root: ElementTree.Element) -> Sheet:
    """Tracks of the extension gx; where there are none, placemarks with a point and a time, else pins."""
    rows, pins, lines = list[Point](), list[Point](), 0
    for number, placemark in enumerate(one for one in root.iter() if _tag(one) == "Placemark"):
        parts = list(placemark.iter())
        name = next((part.text or "" for part in parts if _tag(part) == "name"), "").strip() or f"track {number + 1}"
        tracks = [part for part in parts if _tag(part) == "Track"]
        lines += any(_tag(part) == "LineString" for part in parts)
        for track in tracks:
            times = [part.text for part in track if _tag(part) == "when"]
            places = [part for part in track if _tag(part) == "coord"]
            if len(times) != len(places):
                raise ValueError(f"expected a time for each of {len(places)} places of a track, received {len(times)}")
            rows += [_point(time, (part.text or "").split(), name) for time, part in zip(times, places, strict=True)]
        when = [part.text for part in parts if _tag(part) == "when"]
        inner = [part for one in parts if _tag(one) == "Point" for part in one]
        point = [part.text or "" for part in inner if _tag(part) == "coordinates"]
        if not tracks and when and point:
            pins.append(_point(when[0], point[0].strip().split(","), ""))
    if not rows and lines:
        raise ValueError("expected KML with times (gx:Track, or points with a TimeStamp), received lines without any")
    said = (
        "KML: longitude, latitude[, altitude in metres]",
        *([f"pins left out: {len(pins)}"] if rows and pins else []),
    )
    return _timed(rows or pins, said, "KML")


def _point(time: str | None, place: list[str], name: str) -> Point:
    """A point of KML, whose place is longitude, latitude and perhaps altitude, or empty."""
    if place and not 2 <= len(place) <= 3:
        raise ValueError(f"expected longitude, latitude[, altitude], received {short(' '.join(place))}")
    longitude, latitude, altitude = (*place, "", "", "")[:3]
    return time, latitude, longitude, altitude, name, None


def _timed(rows: list[Point], said: tuple[str, ...], what: str) -> Sheet:
    """A sheet of points, of which some have times."""
    if not rows:
        raise ValueError(f"expected {what} with tracks, received none")
    columns = dict(zip(_COLUMNS, map(list, zip(*rows, strict=True)), strict=True))
    if not any(columns["time"]):
        raise ValueError(f"expected {what} with times, received {len(rows)} points without any")
    return points_sheet(columns, said)._replace(degrees=True)


def _tag(element: ElementTree.Element) -> str:
    """The name of an element without its namespace."""
    return str(element.tag).rpartition("}")[2]


def _text(element: ElementTree.Element, name: str) -> str:
    """The text of an element in another; "" without one."""
    return next((one.text or "" for one in element if _tag(one) == name), "").strip()
