"""JSON: records, columns, objects line by line, tracks of GeoJSON, and what phones and receivers of aircraft write."""

from __future__ import annotations

import json
import re
from typing import Any

from torchfra.readers.columns import Cells, short
from torchfra.readers.json_apps import app_sheet
from torchfra.readers.sheets import Sheet, points_sheet, repeated, whole_text
from torchfra.readers.spelling import found, is_header
from torchfra.readers.times import seconds_of

_RECORDED = re.compile(rb"[0-9TZ:.-]+\t[^\t\n]+\t\{")
"""How lines of OwnTracks' recorder begin, of which only what follows is JSON."""
_BEGIN = 200
_POINTS = {"Point": 0, "MultiPoint": 1, "LineString": 1, "MultiLineString": 2}
"""How deep the places of a geometry are nested."""
_TIMES = ("coordTimes", "coordtimes", "times", "time", "timestamps")
"""Properties of a line with the time of each of its places."""
_AXES = ("latitude", "longitude")
_RAW = {"time": "timestamp", "altitude": "altitudeMeters", "accuracy": "accuracyMeters"}
"""Columns by what a fix of a phone calls them."""
_MINUTES = "durationMinutesOffsetFromStartTime"
"""Of a place since its segment of a phone's timeline began."""
_CALLED = 3
"""Names of a target at most that its fixes are given, which may be many."""
_TRACE = ("second", "lat", "lon", "alt_baro")
"""What a row of a trace begins with: seconds since the file's, degrees, and feet."""


def is_json(start: bytes) -> bool:
    """Whether a file that begins so is JSON."""
    return start[:1] in (b"[", b"{") or _RECORDED.match(start) is not None


def json_sheet(file: Any, max_bytes: int) -> Sheet:
    """The records, columns or features of a file.

    Raises:
        ValueError: it is no JSON, or neither of these.
    """
    content = whole_text(file, max_bytes, "JSON")
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
    if (sheet := _readsb_sheet(parsed)) is not None:
        return sheet
    if (sheet := _timeline_sheet(parsed) or app_sheet(parsed)) is not None:
        return sheet
    names, rows, cells, of = _columns(parsed)
    said = (f"JSON: a row for each record in {of}",) if of else ()
    return Sheet(names, [(rows, cells)] if names else [], said, json=of in ("", "aircraft"))


def _parsed(content: str) -> Any:
    """What JSON says; a list of all records where each line is an object, or a list of some, of its own."""
    if _RECORDED.match(content[:_BEGIN].encode()):
        content = re.sub(r"(?m)^[^{\n]*", "", content)
    try:
        return json.loads(content, object_pairs_hook=_object)
    except json.JSONDecodeError as error:
        lines = [line for line in content.splitlines() if line.strip()] if error.msg == "Extra data" else []
        if len(lines) < 2 or not all(line.rstrip().endswith(("}", "]")) for line in lines[:2]):
            raise
        several = [json.loads(line, object_pairs_hook=_object) for line in lines]
        return [record for one in several for record in (one if isinstance(one, list) else [one])]


def _columns(parsed: Any) -> tuple[list[str], int, Cells, str]:
    """Names of the columns, the number of rows, the cells of a column by its name, and the name of lists of rows."""
    if isinstance(parsed, dict):
        if inner := _inner([parsed]):
            return _columns_of(*inner)
        lists = {name: column for name, column in parsed.items() if isinstance(column, list)}
        if len(lists) > 1 and len({len(column) for column in lists.values()}) == 1:
            return list(lists), len(next(iter(lists.values()))), lists.__getitem__, ""
        columns = {name: column for name, column in parsed.items() if isinstance(column, dict)}
        is_table = len(columns) > 1 and len({frozenset(column) for column in columns.values()}) == 1
        records = next(iter(lists.values())) if len(lists) == 1 and not is_table else []
        if records and all(isinstance(one, dict) for one in records):
            return _columns(records)  # under one name, as "locations" of a phone
        keys = list(dict.fromkeys(key for column in columns.values() for key in column))
        return list(columns), len(keys), lambda name: [columns[name].get(key) for key in keys], ""
    records = parsed if isinstance(parsed, list) else [parsed]
    if records and all(isinstance(one, list) for one in records):  # in parts
        records = [record for part in records for record in part]
    if other := next((type(one).__name__ for one in records if not isinstance(one, dict)), ""):
        raise ValueError(f"expected a list of records or a table of columns, received {other} instead of an object")
    records = _flat(records)
    return _columns_of(*(_inner(records, asked=True) or (records, "")))


def _columns_of(records: list[dict[str, Any]], of: str) -> tuple[list[str], int, Cells, str]:
    """Those of records, which stand in lists of that name."""
    records = [_parted(record) for record in records]
    names = list(dict.fromkeys(name for record in records for name in record))
    return names, len(records), lambda name: [record.get(name) for record in records], of


def _inner(
    records: list[dict[str, Any]], depth: int = 4, *, asked: bool = False
) -> tuple[list[dict[str, Any]], str] | None:
    """The records in the lists of one name that alone have times and places, each with what its target is called.

    So services answer: the targets, and the fixes of each.  None where the records have places, or no such list is
    the only one.  Where it is ``asked`` and the records have no numbers of their own, the only list of all is one, as a
    person may name columns of its records.
    """
    records = _flat(records)
    names = dict[str, list[dict[str, Any]]]()
    for record in records:
        for name, value in record.items():
            names.setdefault(name, []).extend([record] if value else [])
    if not depth or is_header(names):
        return None
    likely, every = list[tuple[list[dict[str, Any]], str]](), list[tuple[list[dict[str, Any]], str]]()
    called = found(names, "id")[:_CALLED]
    for name, there in names.items():
        several = [(record, record[name]) for record in there]
        if not several or not all(
            isinstance(ones, list) and all(isinstance(one, dict) for one in ones) for _, ones in several
        ):
            continue
        outer = [
            {key: record[key] for key in called if not isinstance(record.get(key, []), list | dict)}
            for record, ones in several
            for _ in ones
        ]
        inner = [
            more | one for more, one in zip(outer, _flat([one for _, ones in several for one in ones]), strict=True)
        ]
        keys = {key for one in inner for key in one}
        if is_header({key.rpartition(".")[2] for key in keys}):
            every.append((inner, name))
        if is_header(keys) and found(keys, "time"):
            likely.append((inner, name))
        elif deeper := _inner(inner, depth - 1):
            likely.append((deeper[0], f"{name}, {deeper[1]}"))
    numbers = asked and any(
        map(_is_number, (cell for one in records for key, cell in one.items() if key not in called))
    )
    if asked and not likely and not numbers:
        likely = every
    return likely[0] if len(likely) == 1 else None


def _flat(records: list[dict[str, Any]], depth: int = 4) -> list[dict[str, Any]]:
    """Records in which the values of what is an object wherever it is there have both names: ``coords.latitude``.

    What an object says of its type, as data bases write ``{"$numberLong": "7"}``, is no name.
    """
    objects = {name for record in records for name, value in record.items() if isinstance(value, dict)}
    others = {
        name
        for record in records
        for name, value in record.items()
        if value is not None and not isinstance(value, dict)
    }
    names = objects - others
    # An object that should name the target stays one, and is refused: without it all targets would be one.
    names -= {name for name in names if found([name], "id") and not _has_id(name, records)}
    if not names or not depth:
        return records
    flat = list[dict[str, Any]]()
    for record in records:
        own = {name: value for name, value in record.items() if name not in names}
        for name, value in record.items():
            inner = (value or {}).items() if name in names else ()
            own |= {name if key.startswith("$") else f"{name}.{key}": cell for key, cell in inner}
        flat.append(own)
    return _flat(flat, depth - 1)


def _parted(record: dict[str, Any]) -> dict[str, Any]:
    """A record with two to four numbers in a list under names of their own: ``translation.1`` and so on."""
    parted = dict[str, Any]()
    for name, value in record.items():
        few = isinstance(value, list) and 2 <= len(value) <= 4 and all(map(_is_number, value))
        parted |= {f"{name}.{i + 1}": cell for i, cell in enumerate(value)} if few else {name: value}
    return parted


def _has_id(name: str, records: list[dict[str, Any]]) -> bool:
    """Whether objects of this name hold one that names a target, or a value of a data base."""
    keys = {key for record in records for key in record.get(name) or ()}
    return any(key.startswith("$") or found([key], "id") for key in keys)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON, in which each key comes once."""
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError(f"several keys named {repeated(key for key, _ in pairs)}")
    return found


# ---------------------------------------------------------------- GeoJSON


def _geojson_sheet(parsed: dict[str, Any]) -> Sheet:
    """Every place of the features, with their properties."""
    features = parsed["features"] if isinstance(parsed.get("features"), list) else [parsed]
    records, said = list[dict[str, Any]](), "GeoJSON: longitude, latitude[, altitude in metres]"
    for number, feature in enumerate(features):
        feature = feature if isinstance(feature, dict) else {}
        geometry, properties = feature.get("geometry"), feature.get("properties") or {}
        geometry = geometry if isinstance(geometry, dict) else {}
        depth = _POINTS.get(str(geometry.get("type")))
        if depth is None or not isinstance(properties, dict):
            raise ValueError(f"expected points and lines, received another geometry in feature {number + 1}")
        records += _places(geometry.get("coordinates", []), properties, depth, number)
    columns = list(dict.fromkeys(name for record in records for name in record))
    return points_sheet({name: [record.get(name) for record in records] for name in columns}, (said,))


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


# ---------------------------------------------------------------- where a phone has been


def _timeline_sheet(parsed: Any) -> Sheet | None:
    """The places along the ways in ``Timeline.json``, as Google Maps exports it on a phone; None of other content.

    With Android segments stand under ``semanticSegments`` and places have times; with iOS they are the list itself, and
    places have minutes since their segment began. Of the last weeks Android has all fixes besides, under
    ``rawSignals``, which are taken where they are more.
    """
    segments = parsed.get("semanticSegments") if isinstance(parsed, dict) else parsed
    if not isinstance(segments, list) or not all(isinstance(one, dict) for one in segments):
        return None
    ways = [(one, one["timelinePath"]) for one in segments if isinstance(one.get("timelinePath"), list)]
    raw = parsed.get("rawSignals") if isinstance(parsed, dict) else None
    fixes = [one["position"] for one in raw or () if isinstance(one, dict) and isinstance(one.get("position"), dict)]
    count = sum(len(places) for _, places in ways)
    if len(fixes) > count:
        whole = {name: [fix.get(key) for fix in fixes] for name, key in _RAW.items()}
        pairs = [_pair(fix.get("LatLng"), "rawSignals") for fix in fixes]
        whole |= {axis: [pair[i] for pair in pairs] for i, axis in enumerate(_AXES)}
        rest = f"; {count} places along its ways left out" if count else ""
        return points_sheet(whole, (f"Timeline of a phone: positions of rawSignals{rest}",))
    if not ways:
        return None
    columns: dict[str, list[Any]] = {"time": [], "latitude": [], "longitude": []}
    for segment, places in ways:
        for place in places:
            parts = _pair(place.get("point") if isinstance(place, dict) else place, "timelinePath")
            time = place["time"] if "time" in place else _after(segment.get("startTime"), place.get(_MINUTES))
            for name, cell in zip(columns, (time, *parts), strict=True):
                columns[name].append(cell)
    rest = f"; {len(fixes)} positions of rawSignals left out" if fixes else ""
    return points_sheet(columns, (f"Timeline of a phone: places along its ways{rest}",))


def _pair(point: Any, where: str) -> list[str]:
    """A latitude and a longitude out of text such as "geo:47.1,8.2" or "47.1\u00b0, 8.2\u00b0"."""
    parts = str(point).removeprefix("geo:").replace("\u00b0", "").split(",")
    if len(parts) != len(_AXES):
        raise ValueError(f"expected a point such as 47.1, 8.2 in {where}, received {short(point)}")
    return [part.strip() for part in parts]


def _after(start: Any, minutes: Any) -> int:
    """Ms since 1970, some minutes after a time."""
    try:
        return round(1000 * (seconds_of(str(start), "iso") + 60 * float(minutes)))
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"expected startTime and {_MINUTES}, received {short(start)} and {short(minutes)}") from None


# ---------------------------------------------------------------- receivers of aircraft


def _readsb_sheet(parsed: Any) -> Sheet | None:
    """The fixes of parsed JSON; None where it is something else.

    A trace (``trace_full_HEX.json``) is ``icao``, ``timestamp`` and ``trace``; a list (``aircraft.json``) is ``now``
    and ``aircraft``, of which several moments may be in a file.  Aircraft on the ground have no altitude.

    Source: wiedehopf/readsb, README-json.md.
    """
    several = parsed if isinstance(parsed, list) else [parsed]
    if not several or not all(isinstance(one, dict) for one in several):
        return None
    if all(isinstance(one.get("trace"), list) and "timestamp" in one for one in several):
        return _fixes_sheet([fix for one in several for fix in _traced(one)], "a trace of readsb")
    if all(isinstance(one.get("aircraft"), list) and "now" in one for one in several):
        return _fixes_sheet([fix for one in several for fix in _listed(one)], "lists of aircraft of readsb or dump1090")
    return None


def _traced(trace: dict[str, Any]) -> list[dict[str, Any]]:
    """The fixes of a trace."""
    fixes, call = [], ""
    for row in trace["trace"]:
        if not isinstance(row, list) or len(row) < len(_TRACE) or not _is_number(row[0]):
            raise ValueError(f"expected rows of seconds, latitude, longitude, altitude in trace, received {short(row)}")
        more = row[8] if len(row) > 8 and isinstance(row[8], dict) else {}
        call = call or more.get("flight", "")
        fix = dict(zip(_TRACE, row, strict=False)) | {"hex": trace.get("icao"), "callsign": call}
        fixes.append(fix | {"time": _sum(trace["timestamp"], row[0])})
    return fixes


def _listed(moment: dict[str, Any]) -> list[dict[str, Any]]:
    """The fixes of all aircraft of a list, each when its position was received."""
    fixes = [one for one in moment["aircraft"] if isinstance(one, dict) and "lat" in one]
    return [
        {"time": _sum(moment["now"], -seen), "hex": one.get("hex"), "callsign": one.get("flight", ""),
         "lat": one["lat"], "lon": one.get("lon"), "alt_baro": one.get("alt_baro")}
        for one in fixes if _is_number(seen := one.get("seen_pos", 0))
    ]  # fmt: skip


def _fixes_sheet(fixes: list[dict[str, Any]], said: str) -> Sheet:
    columns = {name: [fix[name] for fix in fixes] for name in ("time", "hex", "callsign", "lat", "lon", "alt_baro")}
    columns["alt_baro"] = [None if height == "ground" else height for height in columns["alt_baro"]]
    return points_sheet(columns, (said,))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _sum(start: Any, seconds: float) -> Any:
    """A moment some seconds after another; that itself where it is no number, which is then refused."""
    return round(start + seconds, 3) if _is_number(start) else start
