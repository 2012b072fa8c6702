"""JSON as apps and services write it, whose fixes are not records: of Strava, OpenSky, Suunto and OwnTracks."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from torchfra.readers.columns import short
from torchfra.readers.sheets import Sheet, points_sheet

_STATE = {"icao24": 0, "callsign": 1, "time": 3, "longitude": 5, "latitude": 6, "baroaltitude": 7}
"""Where a state vector of OpenSky has what is read of it; altitudes are metres."""
_WAY = {"time": 0, "latitude": 1, "longitude": 2, "baroaltitude": 3}
"""The same of a place along a flight."""
_SUUNTO = {"altitude": "GPSAltitude", "accuracy": "EHPE"}
_SAMPLES = ("Attributes", "suunto/sml", "Sample")
"""Where its newer form has what a sample holds, one in another."""


def app_sheet(parsed: Any) -> Sheet | None:
    """The fixes of parsed JSON; None where it is of none of these.

    Source: Strava API v3, streams; OpenSky REST API, states and tracks; Suunto app and Movescount, samples in radians;
    OwnTracks, JSON.

    Raises:
        ValueError: a fix is something else.
    """
    return _streams(parsed) or _opensky(parsed) or _suunto(parsed) or _owntracks(parsed)


def _streams(parsed: Any) -> Sheet | None:
    """A list of streams, or streams by their types."""
    named = parsed if isinstance(parsed, dict) else {}
    if isinstance(parsed, list) and all(isinstance(one, dict) for one in parsed):
        named = {str(one.get("type")): one for one in parsed}
    data = {
        name: one["data"] for name, one in named.items() if isinstance(one, dict) and isinstance(one.get("data"), list)
    }
    if len(data) < len(named) or not data.keys() >= {"latlng", "time"}:
        return None
    places = data.pop("latlng")
    if any(len(column) != len(places) for column in data.values()) or not all(_is_row(place, 2) for place in places):
        raise ValueError(
            "expected streams as long as each other, with latitudes and longitudes in latlng, received other"
        )
    axes = {axis: [place[i] for place in places] for i, axis in enumerate(("latitude", "longitude"))}
    return points_sheet(data | axes, ("streams of Strava",))


def _opensky(parsed: Any) -> Sheet | None:
    """State vectors of one moment or more, null where there are none, or the way of a flight."""
    several = parsed if isinstance(parsed, list) else [parsed]
    if not several or not all(isinstance(one, dict) for one in several):
        return None
    if all("states" in one and isinstance(one["states"], list | None) and "time" in one for one in several):
        rows, of, said = [row for one in several for row in one["states"] or ()], _STATE, "state vectors"
        more: dict[str, list[Any]] = {}
    elif all(isinstance(one.get("path"), list) and "icao24" in one for one in several):
        rows, of, said = [row for one in several for row in one["path"]], _WAY, "ways of flights"
        more = {name: [one.get(name) for one in several for _ in one["path"]] for name in ("icao24", "callsign")}
    else:
        return None
    if not any(isinstance(row, list) for row in rows):  # but records, which say themselves what they hold
        return None
    if other := next((row for row in rows if not _is_row(row, 1 + max(of.values()))), None):
        raise ValueError(f"expected {said} of OpenSky, received {short(other)}")
    return points_sheet(more | {name: [row[i] for row in rows] for name, i in of.items()}, (f"{said} of OpenSky",))


def _suunto(parsed: Any) -> Sheet | None:
    """Samples of a watch, of which those with a place are read."""
    log = parsed.get("DeviceLog", parsed) if isinstance(parsed, dict) else parsed
    samples = log.get("Samples") if isinstance(log, dict) else log
    if isinstance(log, list) and not any(isinstance(one, dict) and one.keys() & {*_SAMPLES} for one in log):
        return None  # records of another device, whose degrees may be small near the equator
    fixes = [fix for fix in _samples(samples) if "Latitude" in fix and "Longitude" in fix]
    sizes = [abs(fix["Latitude"]) for fix in fixes if isinstance(fix["Latitude"], int | float)]
    if not any("EHPE" in fix for fix in fixes) or max(sizes, default=0) > math.pi / 2:
        return None
    columns: dict[str, list[Any]] = {"time": [fix.get("UTC") or fix.get("TimeISO8601") for fix in fixes]}
    columns |= {name: [fix.get(key) for fix in fixes] for name, key in _SUUNTO.items()}
    for axis in ("Latitude", "Longitude"):
        if other := next((fix for fix in fixes if not isinstance(fix[axis], int | float)), None):
            raise ValueError(f"expected {axis} in radians, received {short(other[axis])}")
        columns[axis] = [math.degrees(fix[axis]) for fix in fixes]
    return points_sheet(columns, ("samples of Suunto: latitudes and longitudes in radians",))


def _samples(samples: Any) -> Iterator[dict[str, Any]]:
    """What each sample holds, with its time, in the newer form or the older one."""
    for sample in samples if isinstance(samples, list) else ():
        inner = sample if isinstance(sample, dict) else {}
        for key in _SAMPLES:
            inner = value if isinstance(value := inner.get(key), dict) else inner
        if inner:
            yield {"TimeISO8601": sample.get("TimeISO8601")} | inner


def _owntracks(parsed: Any) -> Sheet | None:
    """Messages of a phone, of which those called location are read."""
    several = parsed.get("data") if isinstance(parsed, dict) else parsed
    if not isinstance(several, list) or not all(isinstance(one, dict) for one in several):
        return None
    fixes = [one for one in several if one.get("_type") == "location" and "tst" in one]
    if not fixes:
        return None
    names = dict.fromkeys(name for fix in fixes for name in fix)
    columns = {"accuracy" if name == "acc" else name: [fix.get(name) for fix in fixes] for name in names}
    columns["device"] = [fix.get("device") or fix.get("tid") for fix in fixes]
    return points_sheet(columns, ("messages of OwnTracks: location",))


def _is_row(row: Any, length: int) -> bool:
    return isinstance(row, list) and len(row) >= length
