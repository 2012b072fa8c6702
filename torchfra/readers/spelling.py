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
    "deg": "deg", "degree": "deg", "degrees": "deg", "dd": "deg", "semicircles": "semicircles",
}  # fmt: skip
"""Words at the end of a name that say its unit."""
RARER_UNITS = {
    "km": "km", "kilometre": "km", "kilometres": "km", "kilometer": "km", "kilometers": "km", "cm": "cm", "mm": "mm",
    "mi": "mi", "mile": "mi", "miles": "mi", "nmi": "nmi", "yd": "yd", "yard": "yd", "yards": "yd", "dm": "dm",
    "min": "minutes", "mins": "minutes", "minute": "minutes", "minutes": "minutes",
    "h": "hours", "hr": "hours", "hrs": "hours", "hour": "hours", "hours": "hours", "d": "days", "days": "days",
}  # fmt: skip
"""Words that do so behind a length or a time only: "alt_min" is no time."""
APPLE = ("timeintervalsincereferencedate", "timeintervalsincereference", "cfabsolutetime", "ztimestamp")
"""Names of seconds since 2001, as Apple counts them."""
NAMES = {
    "time": ("t", "time", "timestamp", "datetime", "dateandtime", "basedatetime", "utc", "timeutc", "datetimeutc",
             "utctime", "dateutc", "timestamputc", "receivedtime", "unixtime", "unix", "epoch", "unixtimestamp",
             "gpstime", "itow", "stamp", "elapsed", "elapsedtime", "timeelapsed", "timeboot", "timesinceboot", "bootms",
             "timeunix", "zeitstempel", "datumuhrzeit", "datumzeit", "zeit", "uhrzeit", "horodatage", "datetheure",
             "dateheure", "temps", "heure", "fechahora", "fechayhora", "tiempo", "hora", "dataiczas", "czas", "dataora",
             "datahora", "время", "датаивремя", "дата", "seconds", "sec", "secs", "ms",
             "timegmt", "isotime", "tst", "gpst", "gmttime", "gmt", "lmttime", "localtime", "timelocal",
             "timeofday", "secondsofday", "tod", "sod", "timestampexternal", "sitime", "lcltime", "fixtime",
             "devicetime", "utctimein", "collectingtime", *APPLE,
             "date", "datum", "fecha", "ts", "tow", "timeofweek", "sow", "secondsofweek", "minutes", "hours", "days"),
    "week": ("week", "gpsweek", "weekno", "weeknumber", "wn", "gpswn"),
    "date": ("date", "day", "dateutc", "utcdate", "dategmt", "gmtdate", "lmtdate", "localdate", "datelocal", "lcldate",
             "datum", "tag", "jour", "fecha", "dia", "sidate"),
    "x": ("x", "east", "easting", "posx", "px", "tx", "prsrx", "e", "rechtswert", "ostwert", "ost", "este", "ebaseline",
          "xecef", "ecefx"),
    "y": ("y", "north", "northing", "posy", "py", "ty", "prsry", "n", "hochwert", "nordwert", "nord", "norte",
          "nbaseline", "yecef", "ecefy"),
    "z": ("z", "up", "posz", "pz", "tz", "prsrz", "altitude", "alt", "height", "u", "hohe", "hoehe", "altitud",
          "ubaseline", "zecef", "ecefz"),
    "latitude": ("latitude", "lat", "latitud", "breitengrad", "breite", "latitudee7", "late7", "latituden", "silati",
                 "zlatitude", "latitudine", "szerokosc", "szerokoscgeogr", "szerokoscgeograficzna", "широта"),
    "longitude": ("longitude", "lon", "lng", "long", "longitud", "langengrad", "laengengrad", "lange", "laenge",
                  "longitudee7", "lnge7", "longitudee", "silong", "zlongitude", "longitudine", "dlugosc",
                  "dlugoscgeogr", "dlugoscgeograficzna", "долгота"),
    "altitude": ("altitude", "alt", "baroaltitude", "geoaltitude", "altbaro", "altgeom", "height", "elevation", "ele",
                 "elev", "altitudemsl", "altmsl", "hae", "altitudeabovesealevel", "heightabovetakeoff", "z",
                 "flightlevel", "fl", "hohe", "hoehe", "altitud", "altura", "hauteur", "heightabovemsl",
                 "heightaboveellipsoid",
                 "mslaltitude", "enhancedaltitude", "zaltitude", "wysokosc", "altitudine", "высота"),
    "id": ("icao24", "icao", "hex", "mmsi", "trackid", "tracknumber", "trackno", "tracknum", "targetno", "targetid",
           "objectid", "tn",
           "vesselid", "shipid", "flightid", "deviceid", "vehicleid", "individuallocalidentifier", "taglocalidentifier",
           "tagid", "uavid", "droneid", "target", "object", "vessel", "ship", "vehicle", "device", "individual", "trip",
           "tripid", "imo", "trajid", "trajectoryid", "trajectory", "playerid", "player", "animalid", "animal",
           "deployid", "platformidno", "platformid",
           "birdid", "bird", "collarid", "busid", "bus", "boatid", "boat", "imei", "userid", "user", "entityid",
           "entity", "agentid", "agent", "riderid", "rider",
           "vehiclevehicleid",
           "runnerid", "runner", "bib", "uuid", "pojazd", "объект",
           "id", "sid", "stormid", "veref", "name"),
    "call": ("callsign", "vesselname", "shipname", "name"),
    "update": ("lastposition", "lastposupdate"),
    "sigma": ("sigma", "std", "stddev", "sd", "sigmaxy", "accuracy", "horizontalaccuracy", "accuracyhorizontal",
              "zhorizontalaccuracy", "hacc", "eobshorizontalaccuracyestimate", "eph", "3derror",
              "precision", "genauigkeit", "horizontalegenauigkeit", "dokladnosc",
              "точность", "hdop", "horizontaldilutionofprecision"),
    "sigma_x": ("sigmax", "stdx", "sigmaeast", "sde"), "sigma_y": ("sigmay", "stdy", "sigmanorth", "sdn"),
    "sigma_z": ("sigmaz", "stdz", "sigmaup", "sdu"),
    "argos_class": ("argoslc", "lc", "locationclass", "locquality"),
    "semi_major": ("argossemimajor", "errorsemimajoraxis", "smaj"),
    "semi_minor": ("argossemiminor", "errorsemiminoraxis", "smin"),
    "orientation": ("argosorientation", "errorellipseorientation", "eor"),
    "visible": ("visible",), "by_hand": ("manuallymarkedoutlier",), "by_import": ("importmarkedoutlier",),
    "by_rule": ("algorithmmarkedoutlier",), "valid": ("valid", "isvalid", "fixvalid", "validfix", "locationvalid"),
}  # fmt: skip
"""By what they hold, the best first; in small letters without marks, signs, units and such words as "gps" in front."""
_IN_FRONT = {
    "geographische", "gps", "gnss", "pos", "position", "location", "field", "coord", "coords", "coordinate", "utm",
    "enu", "pose", "point", "transform", "translation", "header", "record", "sys", "str",
}  # fmt: skip
_BEHIND = {"utm", "enu", "wgs84"}
OTHER_ZONES = {
    "local", "lt", "mez", "mesz", "cet", "cest", "eet", "eest", "bst", "est", "edt",
    "cst", "cdt", "mst", "mdt", "pst", "pdt", "akst", "akdt", "jst", "ist", "msk", "aest", "aedt", "nzst", "nzdt",
}  # fmt: skip
"""Zones behind the name of a time, whose offset from UTC changes or is not known."""
_ZONES_BEHIND = {"utc", "gmt", "zulu", *OTHER_ZONES}
ANGLE = re.compile(r"deg(?:ree)?s?|m?rad(?:ian)?s?|gon")
"""A unit of angles, which no length has."""
OTHER_UNIT = re.compile(
    r"m?rad(?:ian)?s?|gon|in(?:ch(?:es)?)?|[nu]m|[\u00b5\u03bc]m|microns?|micromet(?:er|re)s?|px|pixels?", re.IGNORECASE
)
"""A unit of positions that has no conversion here."""
_TINY = re.compile(r"[nu]m|[\u00b5\u03bc]m|mic.*|px|pixels?", re.IGNORECASE)
"""Those of what is seen through a lens."""


def instead_of(unit: str) -> str:
    """What to say of positions in one of ``OTHER_UNIT``.

    What moves under a microscope moves as people and players do if its micrometres are read as millimetres: it is too
    fast for targets of metres, and below what their cleaning can tell if it is converted to them.
    """
    length = ("mm", "mm") if _TINY.fullmatch(unit) else ("m", "metres")
    return f"say --units {length[0]}, and read {length[1]} in the results as these"


ZONES = {"zone", "utmzone", "zonenumber", "utmzonenumber", "gridzone"}
"""Names of columns with the zone of a grid, in which eastings and northings are."""
_ELAPSED = {"t", "time", "elapsed", "elapsedtime", "timeelapsed", "timesinceboot", "zeit", "temps", "tiempo"}
"""Names of times whose unit may be one of ``RARER_UNITS``; "utc_hour" is a part of a time."""
PARTS = {"year", "month", "day", "hour", "hours", "minute", "minutes", "min", "second", "seconds", "sec"}
"""Names of columns that may be parts of one time."""
SINCE_1970 = {"timestamp", "utc", "timeutc", "utctime", "unixtime", "unix", "epoch", "unixtimestamp", "timestamputc"}
"""Names of times that are a date too."""
DEPTHS = {"down", "posd", "pd", "depth"}
"""Names of columns that grow downwards, as a drone's third of north, east and down does."""
UNITS_BESIDE = (
    ({"vehicleid", "frameid", "globaltime", "localx", "localy"}, "ft"),  # NGSIM, vehicles from video
    ({"bank", "pitch", "gload"}, "ft"),  # ForeFlight
    ({"altitudechange", "updatetype"}, "flight levels"),  # FlightAware
    ({"gameid", "playid", "nflid"}, "yd"),  # the National Football League
    ({"tagid", "success", "version"}, "mm"),  # Pozyx
)
"""Names of columns, and the unit of lengths that state none beside all of them."""
FLIGHT_LEVELS = {"flightlevel", "fl", "modec", "modecaltitude"}
"""Names of altitudes in hundreds of feet."""
TARGETS = {
    "ship": {"mmsi", "imo", "shiptype", "vesseltype", "typeofmobile", "vesselname", "shipname"},
    "aircraft": {"icao24", "icao", "hex", "callsign", "squawk", "lastposition", "lastposupdate", "baroaltitude",
                 "altbaro"},
    "drone": {"heightabovetakeoff", "homelatitude", "homelat", "uavid", "droneid"},
    "bird": {"birdid", "bird", "solarima"},
    "animal": {"individuallocalidentifier", "individualtaxoncanonicalname", "taglocalidentifier", "argoslc", "animalid",
               "animal", "collarid", "argossemimajor", "errorsemimajoraxis", "locquality"},
}  # fmt: skip
"""What targets are, and names of columns that only files of them have; ships, which are first, have a callsign too."""
ANIMALS = ("animal", "bird", "marine animal")
"""What targets are that are animals."""
MARKS = ("visible", "by_hand", "by_import", "by_rule")
"""Columns of Movebank that say whether a fix is right, and whether it is an outlier."""
WORDS_OF_MARKS = {"true": 1.0, "false": 0.0, "1": 1.0, "0": 0.0, "t": 1.0, "f": 0.0, "yes": 1.0, "no": 0.0}
"""What they say, in small letters."""
COUNTERS = {"id", "name", "objectid", "target", "object", "trip", "tripid", "uuid", "entityid", "user", "userid", "tn"}
"""Names that may number the rows instead of the targets."""


def plain(name: str) -> str:
    """A name in small letters without signs, its unit and such words as "gps" in front."""
    words = name_words(name)
    while len(words) > 1 and (words[-1] in UNITS or _is_rarer(words)):
        words.pop()
        if len(words) > 1 and words[-1] == "in":  # as in "x in m"
            words.pop()
    if len(words) > 1 and words[-1] in _BEHIND and "".join(_bare(words[:-1])) in _KNOWN:
        words.pop()
    bare = "".join(_bare(words))
    if len(words) > 1 and words[-1] in _ZONES_BEHIND and bare not in _KNOWN and "".join(words[:-1]) in _TIMES:
        return "".join(words[:-1])
    return bare


def _bare(words: list[str]) -> list[str]:
    """Without words that stand in front of what is known."""
    front = next((i for i, word in enumerate(words) if word not in _IN_FRONT), len(words) - 1)
    return next((words[i:] for i in range(front, 0, -1) if "".join(words[i:]) in _KNOWN), words)


def _is_rarer(words: list[str]) -> bool:
    """Whether the last of these words is the unit of those before it."""
    rest = "".join(_bare([word for word in words[:-1] if word not in _BEHIND] or words[:-1]))
    return RARER_UNITS.get(words[-1], "") in (_COARSE if rest in _ELAPSED else _LENGTHS if rest in _LONG else ())


def unit(name: str, *, asked: bool = False) -> str | None:
    """What the end of a name says of its unit: one of ``UNITS`` or ``RARER_UNITS``.

    Args:
        name: of a column.
        asked: whether it is known from elsewhere that it is a length or a time, whatever it is called.
    """
    words = name_words(name)
    if "".join(words) == "itow":  # the time of the GPS week, as receivers of u-blox give it
        return "ms"
    if len(words) > 1:
        rarer = asked or _is_rarer(words)
        return UNITS.get(words[-1]) or (RARER_UNITS.get(words[-1]) if rarer else None)
    return _ALONE.get(words[0] if words else "")


def found(names: Iterable[str], role: str) -> list[str]:
    """The names that may hold something, the best first."""
    rank, names = {spelt: i for i, spelt in enumerate(NAMES[role])}, list(names)
    spelt = {name: plain(name) for name in set(names)}

    def place(i: int) -> tuple[int, int, int]:
        """The name alone first, that of a computer's own clock last."""
        name = names[i]
        return rank[spelt[name]], 2 if "sys" in name_words(name) else int(name != spelt[name]), i

    return [names[i] for i in sorted((i for i, name in enumerate(names) if spelt[name] in rank), key=place)]


def places_in(names: Iterable[str]) -> list[str]:
    """Names of columns that say where something was: latitudes and longitudes, or else x and y; empty without them."""
    every = list(names)
    pairs = (("latitude", "longitude"), ("x", "y"))
    several = ([found(every, role)[:1] for role in pair] for pair in pairs)
    return next(([*first, *second] for first, second in several if first and second), [])


def is_known(name: str) -> bool:
    """Whether a column of this name is understood, whatever it holds."""
    return plain(name) in _KNOWN


def is_header(names: Iterable[str]) -> bool:
    """Whether names of columns say where something was."""
    return bool(places_in(names))


def name_words(name: str) -> list[str]:
    """The words of a name, which signs or capitals part: "TimeUS" and "time [us]" are both "time" and "us".

    Letters stand without their marks.
    """
    bare = unicodedata.normalize("NFKD", name.strip())
    bare = "".join(letter for letter in bare if not unicodedata.combining(letter)).translate(_PLAIN_LETTERS)
    parted = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", bare).lower()
    return re.findall(r"[^\W_]+", re.sub(r"(?<=time|tamp|boot)(?=(?:ms|us|ns)\b)", " ", parted))


_PLAIN_LETTERS = str.maketrans({"°": " deg ", "\u03bc": "u", "ł": "l", "Ł": "L", "ø": "o", "Ø": "O"})
_KNOWN = {name for names in NAMES.values() for name in names}
_TIMES = {*NAMES["time"], *NAMES["date"]}
_COARSE, _LENGTHS = {"minutes", "hours", "days"}, {"km", "dm", "cm", "mm", "mi", "nmi", "yd"}
_LONG = {
    name for role, names in NAMES.items() if role in ("x", "y", "z", "altitude") or "sigma" in role for name in names
}  # fmt: skip
_ALONE = {"ms": "ms", "minutes": "minutes", "hours": "hours", "days": "days"}
"""Names that are a unit and nothing else."""
