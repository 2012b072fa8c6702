"""What columns hold by their names, in any case and in common spellings."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable

UNITS = {
    "m": "m", "metre": "m", "metres": "m", "meter": "m", "meters": "m", "ft": "ft", "foot": "ft", "feet": "ft",
    "s": "seconds", "sec": "seconds", "secs": "seconds", "second": "seconds", "seconds": "seconds",
    "ms": "ms", "msec": "ms", "millis": "ms", "millisecond": "ms", "milliseconds": "ms",
    "us": "us", "usec": "us", "microseconds": "us", "ns": "ns", "nsec": "ns", "nanoseconds": "ns",
    "deg": "deg", "degree": "deg", "degrees": "deg", "dd": "deg",
}  # fmt: skip
"""Words at the end of a name that say its unit."""
NAMES = {
    "time": ("t", "time", "timestamp", "datetime", "dateandtime", "basedatetime", "utc", "timeutc", "datetimeutc",
             "utctime", "dateutc", "timestamputc", "receivedtime", "unixtime", "unix", "epoch", "unixtimestamp",
             "gpstime", "itow", "stamp", "elapsed", "elapsedtime", "timeelapsed", "timeboot", "timesinceboot", "bootms",
             "timeunix", "zeitstempel", "datumuhrzeit", "datumzeit", "zeit", "uhrzeit", "horodatage", "datetheure",
             "dateheure", "temps", "heure", "fechahora", "fechayhora", "tiempo", "hora", "seconds", "sec", "secs", "ms",
             "date", "datum", "fecha", "ts"),
    "date": ("date", "day", "dateutc", "datum", "tag", "jour", "fecha", "dia"),
    "x": ("x", "east", "easting", "posx", "px", "e", "rechtswert", "ostwert"),
    "y": ("y", "north", "northing", "posy", "py", "n", "hochwert", "nordwert"),
    "z": ("z", "up", "posz", "pz", "altitude", "alt", "height", "u", "hohe", "hoehe", "altitud"),
    "latitude": ("latitude", "lat", "latitud", "breitengrad", "breite"),
    "longitude": ("longitude", "lon", "lng", "long", "longitud", "langengrad", "laengengrad", "lange", "laenge"),
    "altitude": ("altitude", "alt", "baroaltitude", "geoaltitude", "altbaro", "altgeom", "height", "elevation", "ele",
                 "elev", "altitudemsl", "altmsl", "hae", "altitudeabovesealevel", "heightabovetakeoff", "z",
                 "flightlevel", "fl", "hohe", "hoehe", "altitud", "altura", "hauteur"),
    "id": ("icao24", "icao", "hex", "mmsi", "trackid", "tracknumber", "targetid", "objectid", "vesselid", "shipid",
           "flightid", "deviceid", "vehicleid", "individuallocalidentifier", "tagid", "uavid", "droneid", "target",
           "object", "vessel", "ship", "vehicle", "device", "individual", "trip", "tripid", "imo", "playerid", "player",
           "animalid", "animal", "birdid", "bird", "collarid", "busid", "bus", "boatid", "boat", "imei", "userid",
           "user", "entityid", "entity", "agentid", "agent", "riderid", "rider", "runnerid", "runner", "bib", "uuid",
           "id", "name"),
    "call": ("callsign", "vesselname", "shipname", "name"),
    "update": ("lastposition", "lastposupdate"),
    "sigma": ("sigma", "std", "stddev", "sd", "sigmaxy", "accuracy", "horizontalaccuracy", "accuracyhorizontal",
              "hacc", "eph", "hdop"),
    "sigma_x": ("sigmax", "stdx", "sigmaeast"), "sigma_y": ("sigmay", "stdy", "sigmanorth"),
    "sigma_z": ("sigmaz", "stdz", "sigmaup"),
}  # fmt: skip
"""By what they hold, the best first; in small letters without marks, signs, units and such words as "gps" in front."""
_IN_FRONT = {"geographische", "gps", "gnss", "pos", "position", "location", "field", "coord", "coordinate"}
SINCE_1970 = {"timestamp", "utc", "timeutc", "utctime", "unixtime", "unix", "epoch", "unixtimestamp", "timestamputc"}
"""Names of times that are a date too."""
AIRCRAFT = {"icao24", "icao", "hex", "callsign", "squawk", "lastposition", "lastposupdate", "baroaltitude", "altbaro"}
FLIGHT_LEVELS = {"flightlevel", "fl", "modec", "modecaltitude"}
"""Names of altitudes in hundreds of feet."""
SHIPS = {"mmsi", "imo", "shiptype", "vesseltype", "typeofmobile", "vesselname", "shipname"}
"""Names of columns that only these have; ships have a callsign too."""
COUNTERS = {"id", "name", "objectid", "target", "object", "trip", "tripid", "uuid", "entityid", "user", "userid"}
"""Names that may number the rows instead of the targets."""


def plain(name: str) -> str:
    """A name in small letters without signs, its unit and such words as "gps" in front."""
    words = _words(name)
    while len(words) > 1 and words[-1] in UNITS:
        words.pop()
    while len(words) > 1 and words[0] in _IN_FRONT and "".join(words[1:]) in _KNOWN:
        words.pop(0)
    return "".join(words)


def unit(name: str) -> str | None:
    """What the end of a name says of its unit: one of ``UNITS``."""
    words = _words(name)
    if "".join(words) == "itow":  # the time of the GPS week, as receivers of u-blox give it
        return "ms"
    return UNITS.get(words[-1]) if len(words) > 1 else {"ms": "ms"}.get(words[0] if words else "")


def found(names: Iterable[str], role: str) -> list[str]:
    """The names that may hold something, the best first."""
    rank, names = {spelt: i for i, spelt in enumerate(NAMES[role])}, list(names)
    spelt = {name: plain(name) for name in set(names)}
    ranked = [(rank[spelt[name]], name != spelt[name], i, name) for i, name in enumerate(names) if spelt[name] in rank]
    return [name for *_, name in sorted(ranked)]


def is_header(names: Iterable[str]) -> bool:
    """Whether names of columns say where something was."""
    names = list(names)
    pairs = (("x", "y"), ("latitude", "longitude"))
    return any(all(found(names, role) for role in pair) for pair in pairs)


def _words(name: str) -> list[str]:
    """The words of a name, which signs or capitals part: "TimeUS" and "time [us]" are both "time" and "us".

    Letters stand without their marks.
    """
    bare = unicodedata.normalize("NFKD", name.strip())
    bare = "".join(letter for letter in bare if not unicodedata.combining(letter))
    parted = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", bare).lower()
    return re.findall(r"[a-z0-9]+", re.sub(r"(?<=time|tamp|boot)(?=(?:ms|us|ns)\b)", " ", parted))


_KNOWN = {name for names in NAMES.values() for name in names}
