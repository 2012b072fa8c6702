"""JSON of receivers of aircraft (readsb, tar1090, dump1090): traces of one aircraft, and lists of all at a moment."""

from __future__ import annotations

from typing import Any

from torchfra.readers.columns import short
from torchfra.readers.sheets import Sheet, points_sheet

_TRACE = ("second", "lat", "lon", "alt_baro")
"""What a row of a trace begins with: seconds since the file's, degrees, and feet."""


def readsb_sheet(parsed: Any) -> Sheet | None:
    """The fixes of parsed JSON; None where it is something else.

    A trace (``trace_full_HEX.json``) is ``icao``, ``timestamp`` and ``trace``; a list (``aircraft.json``) is ``now``
    and ``aircraft``, of which several moments may be in a file.  Aircraft on the ground have no altitude.

    Source: wiedehopf/readsb, README-json.md.

    Raises:
        ValueError: a row of a trace is none.
    """
    several = parsed if isinstance(parsed, list) else [parsed]
    if not several or not all(isinstance(one, dict) for one in several):
        return None
    if all(isinstance(one.get("trace"), list) and "timestamp" in one for one in several):
        return _sheet([fix for one in several for fix in _traced(one)], "a trace of readsb")
    if all(isinstance(one.get("aircraft"), list) and "now" in one for one in several):
        return _sheet([fix for one in several for fix in _listed(one)], "lists of aircraft of readsb or dump1090")
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


def _sheet(fixes: list[dict[str, Any]], said: str) -> Sheet:
    columns = {name: [fix[name] for fix in fixes] for name in ("time", "hex", "callsign", "lat", "lon", "alt_baro")}
    columns["alt_baro"] = [None if height == "ground" else height for height in columns["alt_baro"]]
    return points_sheet(columns, (said,))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _sum(start: Any, seconds: float) -> Any:
    """A moment some seconds after another; that itself where it is no number, which is then refused."""
    return round(start + seconds, 3) if _is_number(start) else start
