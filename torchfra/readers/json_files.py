"""JSON: records, columns, objects line by line, tracks of GeoJSON, and what OpenSky and readsb write."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from torchfra.readers.columns import short
from torchfra.readers.options import listed
from torchfra.readers.sheets import Sheet, points_sheet, records_sheet, repeated

_POINTS = {"Point": 0, "MultiPoint": 1, "LineString": 1, "MultiLineString": 2}
"""How deep the places of a geometry are nested."""
_TIMES = ("coordTimes", "coordtimes", "times", "time", "timestamps")
"""Properties of a line with the time of each of its places."""
_ROWS = {
    "states": "icao24 callsign country time contact longitude latitude baroaltitude ground velocity track rate sensors "
              "geoaltitude",
    "path": "time latitude longitude baroaltitude",
}  # fmt: skip
"""Names of what the lists of numbers hold that OpenSky gives for a moment and for a flight."""
_READSB = ("time", "hex", "callsign", "lat", "lon", "alt_baro")


def json_sheet(content: str) -> Sheet:
    """The records, columns or features of a file.

    Raises:
        ValueError: it is no JSON, or neither of these.
    """
    if not content.strip():
        raise ValueError("expected a track, received an empty file")
    try:
        parsed = _parsed(content)
    except (ValueError, RecursionError) as error:
        raise ValueError(
            f"expected JSON, or JSON lines (records one a line), every key of an object once, received other text "
            f"({error})"
        ) from error
    if isinstance(parsed, dict) and isinstance(parsed.get("type"), str) and parsed.keys() & {"features", "geometry"}:
        return _geojson_sheet(parsed)
    several = parsed if isinstance(parsed, list) else [parsed]
    objects = bool(several) and all(isinstance(one, dict) for one in several)
    for rows, names in _ROWS.items() if objects else ():
        lists_of = [one.get(rows) or () if rows in one else None for one in several]
        if all(isinstance(of, list | tuple) and all(isinstance(row, list) for row in of) for of in lists_of):
            fixes = [
                {key: one.get(key) for key in ("icao24", "callsign")} | dict(zip(names.split(), row, strict=False))
                for one in several
                for row in one[rows] or ()
            ]
            return records_sheet(fixes, (f"JSON: {rows} of OpenSky",))._replace(degrees=True)
    for key, fixes_of in (("trace", _of_trace), ("aircraft", _of_moment)):
        if objects and all(isinstance(one.get(key), list) for one in several):
            heard = [fix for one in several for fix in fixes_of(one)]
            cells = {name: [fix[name] for fix in heard] for name in _READSB}
            return points_sheet(cells, (f"JSON: {key} of readsb",))._replace(degrees=True)
    if not isinstance(parsed, dict):
        return records_sheet(_records(several), ())
    columns = [*parsed.values()]
    flat = not any(isinstance(cell, list | dict) for of in columns if isinstance(of, list) for cell in of)
    if flat and all(isinstance(of, list) for of in columns) and len({len(of) for of in columns}) == 1:
        return Sheet([*parsed], [(len(columns[0]), parsed.__getitem__)])
    if all(isinstance(of, dict) for of in columns) and len({frozenset(of) for of in columns}) == 1:
        keys = [*columns[0]]  # as data frames of pandas are written
        return Sheet([*parsed], [(len(keys), lambda name: [parsed[name][key] for key in keys])])
    if not any(isinstance(cell, list | dict) for cell in columns):
        return records_sheet([parsed], ())
    raise _nested(parsed)


def _parsed(content: str) -> Any:
    """What JSON says; a list of all records where each line is an object, or a list of some, of its own."""
    try:
        return json.loads(content, object_pairs_hook=_object)
    except json.JSONDecodeError as error:
        lines = [line for line in content.splitlines() if line.strip()] if error.msg == "Extra data" else []
        if len(lines) < 2 or not all(line.rstrip().endswith(("}", "]")) for line in lines[:2]):
            raise
        several = [json.loads(line, object_pairs_hook=_object) for line in lines]
        return [record for one in several for record in (one if isinstance(one, list) else [one])]


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON, in which each key comes once."""
    whole = dict(pairs)
    if len(whole) < len(pairs):
        raise ValueError(f"several keys named {repeated(key for key, _ in pairs)}")
    return whole


def _records(several: list[Any]) -> list[dict[str, Any]]:
    """Objects as records, none of which has an object in it."""
    for value in several:
        if not isinstance(value, dict):
            kind = type(value).__name__
            raise ValueError(f"expected a list of records or a table of columns, received {kind} instead of an object")
        if any(isinstance(cell, dict) for cell in value.values()):
            raise _nested(value)
    return several


def _nested(value: dict[str, Any]) -> ValueError:
    """The error for objects in others."""
    inner = listed(name for name, cell in value.items() if isinstance(cell, list | dict))
    return ValueError(
        "expected a list of records, or lists of one length by the names of columns, received objects or lists in "
        f"{inner}: pandas.json_normalize makes a table of a list of fixes, which torchfra.clean takes or to_csv writes"
    )


def _of_trace(one: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Fixes of an aircraft, of which those on the ground have no altitude.

    Source: wiedehopf/readsb, README-json.md.
    """
    for row in one["trace"]:
        if not isinstance(row, list) or len(row) < 4 or not isinstance(row[0], int | float):
            raise ValueError(f"expected second, lat, lon, alt_baro in trace, received {short(row)}")
        more = row[8] if len(row) > 8 and isinstance(row[8], dict) else {}
        cells = _sum(one.get("timestamp"), row[0]), one.get("icao"), more.get("flight"), *row[1:4]
        yield dict(zip(_READSB, cells, strict=True)) | {"alt_baro": None if row[3] == "ground" else row[3]}


def _of_moment(one: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Fixes of all aircraft that are heard at a moment."""
    for fix in one["aircraft"]:
        if isinstance(fix, dict) and "lat" in fix:
            height = fix.get("alt_baro")
            yield {name: fix.get(name) for name in _READSB} | {
                "time": _sum(one.get("now"), -fix.get("seen_pos", 0)), "callsign": fix.get("flight"),
                "alt_baro": None if height == "ground" else height}  # fmt: skip


def _sum(start: Any, seconds: Any) -> float:
    """A moment some seconds after another.

    Raises:
        ValueError: one is no number.
    """
    for one in (start, seconds):
        if isinstance(one, bool) or not isinstance(one, int | float):
            raise ValueError(f"expected a number of seconds, received {short(one)}")
    return round(float(start + seconds), 3)


# ---------------------------------------------------------------- GeoJSON


def _geojson_sheet(parsed: dict[str, Any]) -> Sheet:
    """Every place of the features, with their properties."""
    features = parsed["features"] if isinstance(parsed.get("features"), list) else [parsed]
    records = list[dict[str, Any]]()
    for number, feature in enumerate(features):
        feature = feature if isinstance(feature, dict) else {}
        geometry, properties = feature.get("geometry"), feature.get("properties") or {}
        geometry = geometry if isinstance(geometry, dict) else {}
        depth = _POINTS.get(str(geometry.get("type")))
        if depth is None or not isinstance(properties, dict):
            raise ValueError(f"expected points and lines, received another geometry in feature {number + 1}")
        records += _places(geometry.get("coordinates", []), properties, depth, number)
    columns = list(dict.fromkeys(name for record in records for name in record))
    said = "GeoJSON: longitude, latitude[, altitude in metres]"
    cells = {name: [record.get(name) for record in records] for name in columns}
    return points_sheet(cells, (said,))._replace(degrees=True)


def _places(coordinates: Any, properties: dict[str, Any], depth: int, number: int) -> list[dict[str, Any]]:
    """The places of a feature."""
    for _ in range(2 - depth):
        coordinates = [coordinates]
    if not isinstance(coordinates, list) or not all(isinstance(line, list) for line in coordinates):
        raise ValueError(f"expected coordinates, received other in feature {number + 1}")
    places = [place for line in coordinates for place in line]
    nested = properties.get("coordinateProperties")
    more = {**properties, **nested} if isinstance(nested, dict) else properties
    name = next((key for key in _TIMES if isinstance(more.get(key), list)), None)
    shared = {key: value for key, value in properties.items() if not isinstance(value, list | dict)}
    if depth:
        shared = {"id": properties.get("id") or properties.get("name") or (f"line {number + 1}" if number else None)}
    times = [time for part in more[name] for time in (part if isinstance(part, list) else [part])] if name else []
    if depth and len(times) != len(places):
        raise ValueError(
            f"expected a time for each of the {len(places)} places of feature {number + 1} ({', '.join(_TIMES[:3])} of "
            f"its properties), received {len(times)}"
        )
    records = []
    for i, place in enumerate(places):
        if not isinstance(place, list) or not 2 <= len(place) <= 4:
            raise ValueError(f"expected longitude, latitude[, altitude], received {short(place)}")
        axes = dict(zip(("longitude", "latitude", "altitude"), place, strict=False))
        records.append(({"time": times[i]} if depth else {}) | shared | axes)
    return records
