"""What columns hold by their names: English words in any case, with a unit in brackets or behind a blank or a sign."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable
from functools import lru_cache

METRES = {
    "m": 1.0, "ft": 0.3048, "km": 1e3, "dm": 0.1, "cm": 1e-2, "mm": 1e-3, "mi": 1609.344, "nmi": 1852.0, "yd": 0.9144,
}  # fmt: skip
"""Units of length, by what ``units`` calls them."""
FLIGHT_LEVEL = 100 * METRES["ft"]
LENGTHS = {unit: unit for unit in METRES} | {
    "foot": "ft", "feet": "ft", "mile": "mi", "miles": "mi", "yard": "yd", "yards": "yd",
    **{f"{front}{word}": f"{sign}m" for front, sign in (("", ""), ("kilo", "k"), ("centi", "c"), ("milli", "m"))
       for word in ("metre", "metres", "meter", "meters")},
}  # fmt: skip
"""Words for them."""
TIMES = {
    "s": "seconds", "sec": "seconds", "secs": "seconds", "second": "seconds", "seconds": "seconds",
    "ms": "ms", "msec": "ms", "millis": "ms", "millisecond": "ms", "milliseconds": "ms",
    "us": "us", "usec": "us", "microseconds": "us", "ns": "ns", "nsec": "ns", "nanoseconds": "ns",
    "min": "minutes", "mins": "minutes", "minutes": "minutes", "h": "hours", "hr": "hours", "hrs": "hours",
    "hours": "hours", "d": "days", "days": "days",
}  # fmt: skip
DEGREES = {"deg", "degree", "degrees", "dd", "semicircles", "e7"}
OTHER_UNIT = re.compile(
    r"m?rad(?:ian)?s?|gon|(?:[mu\u00b5]|milli|micro)deg(?:ree)?s?|arc ?(?:min|sec)\w*|in(?:ch(?:es)?)?|[nu]m|"
    r"[\u00b5\u03bc]m|microns?|micromet(?:er|re)s?|px|pixels?",
    re.IGNORECASE,
)
"""A unit of positions that has no conversion here."""
NAMES = {
    "time": """t time timestamp timestamps datetime dateandtime utc timeutc utctime datetimeutc utcdatetime timestamputc
        unixtime unix epoch unixtimestamp gpstime stamp fixtime elapsed elapsedtime elapsedrealtime timeelapsed
        timesincestart timesinceboot timeboot millis ms seconds sec secs isotime ts tst tow itow timeofweek sow
        timeofday secondsofday sod tod gpst gmt localtime timelocal datelocal recordedat basedatetime devicetime
        date day""",
    "week": "week gpsweek weeknumber weekno wn wnc gwk",
    "date": "date day utcdate dateutc gpsdate localdate datelocal",
    "x": "x east easting e posx px", "y": "y north northing n posy py",
    "z": "z up u posz pz altitude alt height elevation",
    "latitude": "latitude lat", "longitude": "longitude lon lng long",
    "altitude": """altitude alt elevation ele elev height altitudemsl altmsl mslaltitude hmsl heightmsl
        heightabovemsl hae altitudehae heightaboveellipsoid altitudeabovesealevel enhancedaltitude gpsaltitude z""",
    "id": """icao24 icao hex mmsi imo id trackid track tracknumber trackno targetid target objectid object vesselid
        vessel shipid ship flightid vehicleid vehicle deviceid device droneid uavid animalid animal individualid
        individual tagid birdid bird collarid playerid player runnerid riderid personid pedestrianid agentid agent
        userid user tripid trip busid boatid robotid trajectoryid trajid entityid uuid imei platformidno platformid
        ptt transmitter transmitterid name""",
    "call": "callsign vesselname shipname name",
    "sigma": """sigma std stddev sd sigmaxy accuracy horizontalaccuracy accuracyhorizontal hacc haccuracy eph ehpe hdop
        horizontaldilutionofprecision""",
    "sigma_x": "sigmax stdx sigmaeast sde", "sigma_y": "sigmay stdy sigmanorth sdn",
    "sigma_z": "sigmaz stdz sigmaup sdu",
    "argos_class": "argoslc lc locclass locationclass locationquality locquality argosclass argoslocationclass",
    "semi_major": "argossemimajor errorsemimajoraxis semimajor smaj",
    "semi_minor": "argossemiminor errorsemiminoraxis semiminor smin",
    "orientation": "argosorientation errorellipseorientation ellipseorientation eor",
    "rate": "fps framerate",
    "visible": "visible", "by_hand": "manuallymarkedoutlier", "by_import": "importmarkedoutlier",
    "by_rule": "algorithmmarkedoutlier", "valid": "valid isvalid fixvalid validfix fixquality gpsquality fix fixtype",
}  # fmt: skip
"""By what they hold, the best first; in small letters without signs, units and such words as "gps" in front."""
_RANKS = {role: {name: i for i, name in enumerate(names.split())} for role, names in NAMES.items()}
_KNOWN = {name: role for role, ranks in reversed(_RANKS.items()) for name in ranks}
_LONG = ("x", "y", "z", "altitude", "sigma", "sigma_x", "sigma_y", "sigma_z", "semi_major", "semi_minor")
_IN_FRONT = {
    "gps", "gnss", "pos", "position", "location", "loc", "field", "coord", "coords", "coordinate", "coordinates",
    "utm", "enu", "pose", "point", "header", "geo", "transform", "translation", "str", "osd",
    "attributes", "suunto", "sml", "sample", "fix", "lmt",
}  # fmt: skip
"""Words that stand in front of a name and add nothing to it."""
_BEHIND = {"utc", "gmt", "zulu", "local", "utm", "enu", "wgs84"}
MARKS = ("visible", "by_hand", "by_import", "by_rule")
"""Columns that say whether a fix is right, and whether it is an outlier."""


def name_words(name: str) -> list[str]:
    """The words of a name, which signs or capitals part: "TimeUS" and "time [us]" are both "time" and "us"."""
    bare = "".join(letter for letter in unicodedata.normalize("NFKD", name) if not unicodedata.combining(letter))
    bare = bare.replace("°", " deg ").replace("\u03bc", "u")
    parted = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", bare).lower()
    return re.findall(r"[^\W_]+", re.sub(r"(?<=time|tamp|boot)(?=(?:ms|us|ns)\b)", " ", parted))


def in_brackets(name: str) -> str:
    """What stands in brackets at the end of a name, in small letters."""
    found = re.search(r"[\[(]\s*([^\[\]()]+?)\s*[\])]\s*$", name)
    return found[1].lower() if found else ""


@lru_cache(2**16)
def _parted(name: str) -> tuple[str, str]:
    """A name without what adds nothing to it, and its unit: a word of ``LENGTHS`` or ``TIMES``, or another; or ""."""
    words, unit = name_words(name), ""
    if len(words) > 1 and words[-1] in LENGTHS.keys() | TIMES.keys() | DEGREES:
        rest = _bare(words[:-2] if words[-2] == "in" and len(words) > 2 else words[:-1])
        role = _KNOWN.get(rest, "")
        fits = LENGTHS if role in _LONG else TIMES if role == "time" else DEGREES if "itude" in role else {}
        if words[-1] in fits or (role == "z" and words[-1] in LENGTHS):
            return rest, words[-1]
    bracketed = in_brackets(name)
    if bracketed and len(words) > 1:
        unit = bracketed.removesuffix(" msl")
        short = _bare(name_words(re.sub(r"[\[(][^\[\]()]*[\])]\s*$", "", name)))
        if short in _KNOWN or unit in {*LENGTHS, *TIMES, *DEGREES}:
            return short, unit
    return _bare(words), unit if OTHER_UNIT.fullmatch(unit) else ""


def _bare(words: list[str]) -> str:
    """Words in one, without those in front or behind that add nothing to what is known."""
    if len(words) > 1 and words[-1] in _BEHIND and "".join(words) not in _KNOWN and _bare(words[:-1]) in _KNOWN:
        return _bare(words[:-1])
    for i in range(len(words)):
        if "".join(words[i:]) in _KNOWN and all(word in _IN_FRONT for word in words[:i]):
            return "".join(words[i:])
    return "".join(words)


def plain(name: str) -> str:
    """A name in small letters without signs, its unit and such words as "gps" in front."""
    return _parted(name)[0]


def unit(name: str) -> str:
    """What the end of a name says of its unit: "ft", "ms", "px" or another; "" where it says nothing.

    What is known to be a length by its own may have its unit as the last word.
    """
    found = _parted(name)[1]
    last = (name_words(name) or [""])[-1]
    known = last in LENGTHS or (last != "in" and OTHER_UNIT.fullmatch(last))
    return found or (last if known and len(name_words(name)) > 1 else "")


def found(names: Iterable[str], role: str) -> list[str]:
    """The names that may hold something, the best first: the name alone before one with words in front."""
    ranked = []
    for i, name in enumerate(names):
        rank = _RANKS[role].get(plain(name))
        if rank is not None:
            ranked.append((rank, len(name_words(name)), i, name))
    return [name for *_, name in sorted(ranked)]


def places_in(names: Iterable[str]) -> list[str]:
    """Names of columns that say where something was: latitudes and longitudes, or else x and y; empty without them."""
    every = list(names)
    pairs = (("latitude", "longitude"), ("x", "y"))
    several = ([found(every, role)[:1] for role in pair] for pair in pairs)
    return next(([*first, *second] for first, second in several if first and second), [])
