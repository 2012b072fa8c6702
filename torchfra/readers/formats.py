"""The formats that are known: a row for each, which says what the general rules of ``torchfra.readers`` do not.

Whoever adds a format adds a row, and a file of ten rows to ``tests/readers/test_formats.py``.  Names of columns are
those of ``names.plain``: small letters without signs and units.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from torchfra.readers.names import plain

_ECEF = (
    "coordinates from the centre of the earth: convert them to degrees, such as by "
    "pyproj.Transformer.from_crs(4978, 4979).transform(x, y, z)"
)


class Format(NamedTuple):
    """How a format is recognised, and what its columns are."""

    name: str
    needs: str = ""
    """Names of columns, all of which it has; ``a|b`` where either is enough."""
    begins: str = ""
    """Or a pattern (regular expression) that its text begins with, where ``^`` begins a line."""
    columns: Mapping[str, str] = {}
    """Column of a role where the rules would take another, or none (""); two that are joined, with a blank between."""
    word: str = ""
    """What its targets are."""
    time: str = ""
    """How times are written, as ``time_format`` says it; ``a|b`` where it may be either."""
    units: Mapping[str, str] = {}
    """Of lengths that state none, by column; "FL" are flight levels."""
    degrees: tuple[float, float] = (1.0, 1.0)
    """Degrees in one of its units of latitude and of longitude."""
    missing: Mapping[str, float] = {}
    """By column the number that stands for none."""
    header: str = ""
    """Of text: a pattern behind which the names stand, up to the end of the line; or the names, with commas between."""
    rows: str = ""
    """Of text: a pattern behind which the rows begin, where they do not follow the names."""
    lines: str = ""
    """Of text: how lines of rows begin, where there are others."""
    sign: str = ""
    """Of text: what separates cells."""
    twice: str = ""
    """Of text: a name that stands above two columns, ``date`` and ``time``."""
    refused: str = ""
    """What to do instead, where it is not read."""

    @property
    def says_degrees(self) -> bool:
        """Whether latitudes are surely no radians, as of a text that begins as no other does."""
        return bool(self.begins) or self.degrees != (1.0, 1.0)


_FEET = {"altitude": "ft", "alt": "ft", "altbaro": "ft", "altgeom": "ft"}
_E7, _SEMICIRCLES, _RADIANS = (1e-7, 1e-7), (180 / 2**31,) * 2, (180 / math.pi,) * 2
_NO_POSITION = {"latitude": 91.0, "lat": 91.0, "longitude": 181.0, "lon": 181.0}
"""What receivers of ships say where they have none."""
_JAVA = "%a %b %d %H:%M:%S GMT%z %Y|%a %b %d %H:%M:%S UTC %Y|%d-%b-%Y %H:%M:%S"

FORMATS = (
    # ---------------------------------------------------------------- aircraft
    Format("state vectors of OpenSky", "icao24 lastposupdate baroaltitude|geoaltitude", word="aircraft",
           columns={"altitude": "baroaltitude|geoaltitude", "update": "lastposupdate"}),
    Format("traffic", "timestamp lastposition", word="aircraft", columns={"update": "lastposition"}, units=_FEET),
    Format("traffic", "timestamp altitude groundspeed track verticalrate", word="aircraft", units=_FEET,
           columns={"id": "icao24|flightid|callsign"}),
    Format("BaseStation, of dump1090 on port 30003", begins="MSG,[1-8],", word="aircraft",
           header="message,transmission,session,aircraft,hex,flight,date,time,date_logged,time_logged,callsign,"
                  "altitude,speed,course,lat,lon,climb,squawk,alert,emergency,spi,on_ground",
           columns={"time": "date time", "id": "hex"}, time="%Y/%m/%d %H:%M:%S", units=_FEET),
    Format("Flightradar24", "utc callsign position", refused="Position has latitudes and longitudes in one cell: write "
           "a column of each, lat and lon, instead"),
    Format("AeroAPI of FlightAware", "altitudechange updatetype", word="aircraft", units={"altitude": "FL"}),
    Format("ForeFlight", "bank pitch gload", word="aircraft", units=_FEET),
    Format("G1000", "lcldate lcltime utcofst", word="aircraft", time="%Y-%m-%d %H:%M:%S %z",
           columns={"time": "lcldate lcltime utcofst"}),
    Format("ADS-B", "icao24|hex|icao altbaro|altgeom|altitude|alt", word="aircraft", units=_FEET,
           columns={"altitude": "altbaro|altitude|alt|altgeom"}),
    Format("ADS-B", "icao24", word="aircraft", columns={"altitude": "baroaltitude|geoaltitude"}),
    Format("DJI", "flytime|osdflytime height|heightabovetakeoff", word="drone"),
    # ---------------------------------------------------------------- ships and animals
    Format("AIS of the Danish Maritime Authority", "typeofmobile mmsi", word="ship", time="%d/%m/%Y %H:%M:%S",
           missing=_NO_POSITION),
    Format("AIS", "mmsi", word="ship", missing=_NO_POSITION),
    Format("AIS", "sourcemmsi|vesselid|shipid", word="ship", columns={"id": "sourcemmsi|vesselid|shipid"},
           missing=_NO_POSITION),
    Format("flights", "callsign altitude|alt|altbaro", word="aircraft", units=_FEET,
           columns={"altitude": "altbaro|altitude|alt"}),
    Format("Wildlife Computers", "deployid ptt date", word="animal", time="%H:%M:%S %d-%b-%Y",
           columns={"time": "date", "id": "deployid", "argos_class": "quality"}),
    Format("Movebank", "individuallocalidentifier|individualtaxoncanonicalname", word="animal",
           columns={"id": "individuallocalidentifier", "time": "timestamp"}),
    Format("Argos", "argoslc|lc|locclass|locationclass|locationquality|locquality|argosclass", word="animal"),
    Format("Argos", "argossemimajor|errorsemimajoraxis|smaj", word="animal"),
    Format("IBTrACS", "sid isotime", columns={"id": "sid", "time": "isotime"}),
    # ---------------------------------------------------------------- receivers and autopilots
    Format("NovAtel", begins=r"(?:[#%].*\n)*#BESTPOSA,", lines="#BESTPOSA,", time="gps",
           header="#BESTPOSA,port,sequence,idle,status,week,tow,receiver,reserved,solution,kind,latitude,longitude,"
                  "altitude,undulation,datum,sdn,sde,sdu",
           columns={"time": "week tow"}),
    Format("NovAtel without BESTPOSA", begins="[#%][A-Z0-9]+A,", refused="log BESTPOSA, or convert it to NMEA 0183"),
    Format("RTKLIB", begins=r"(?:%.*\n)*%\s+(?:GPST|UTC|JST)\b", header=r"^%\s+(?=GPST|UTC|JST)", sign=" ",
           twice="GPST|UTC|JST", time="%Y/%m/%d %H:%M:%S|gps",
           columns={"time": "date time", "x": "ebaseline", "y": "nbaseline", "z": "ubaseline"}),
    Format("GnssLogger", begins=r"(?:#.*\n)*# Fix,Provider,", header=r"^# (?=Fix,)", lines="Fix,",
           columns={"id": "provider", "time": "unixtimemillis|utctimeinms|unixtime",
                    "latitude": "latitudedegrees|latitude",
                    "longitude": "longitudedegrees|longitude", "altitude": "altitudemeters|altitude",
                    "sigma": "accuracymeters|accuracy"}),
    Format("ArduPilot", begins=r"FMT, ?[0-9]+,", header=r"^FMT, *\d+, *\d+, *(?=GPS,)(?:GPS, *\w+, *)", lines="GPS,",
           columns={"time": "gwk gms", "id": "i"}, time="gps_ms"),
    Format("NAV-PVT of u-blox", "itow hacc", units={"hmsl": "mm", "height": "mm", "hacc": "mm"}),
    Format("OpenLog Artemis of SparkFun", "gpssiv lat long", units={"alt": "mm", "altmsl": "mm"}, degrees=_E7),
    Format("GPS_RAW_INT of MAVLink", "fixtype eph hacc", refused="its altitudes and accuracies are mm, and eph has no "
           "unit: write metres, and leave eph out"),
    Format("PX4, vehicle_gps_position", "timeutc lat lon alt fixtype|altellipsoid", columns={"time": "timeutc"},
           degrees=_E7, units={"alt": "mm"}),
    Format("PX4, vehicle_local_position", "timestamp xyvalid zvalid", columns={"x": "y", "y": "x", "z": ""}, time="us"),
    Format("PX4", "timestamp timestampsample", time="us"),
    Format("Google Smartphone Decimeter Challenge", "wlspositionxecefmeters", refused=_ECEF),
    Format("degrees beside ECEF", "xecef|ecefx latitude|lat longitude|lon"),
    Format("ECEF", "xecef|ecefx", refused=_ECEF),
    Format("VBOX", begins=r"(?s).{0,9999}^\[column names\]", header=r"^\[column names\]\s*\n", rows=r"^\[data\]\s*\n",
           sign=" ", columns={"altitude": "height", "longitude": "long"}, time="%H%M%S", degrees=(1 / 60, -1 / 60)),
    Format("PLT of OziExplorer", begins="OziExplorer Track|Geolife trajectory", rows=r"(?:.*\n){6}",
           header="latitude,longitude,begins,altitude,days,date,clock", columns={"time": "days"}, time="excel",
           units={"altitude": "ft"}, missing={"altitude": -777.0}),
    # ---------------------------------------------------------------- watches, phones and cars
    Format("FIT as FitCSVTool writes its records", "recordtimestamp recordpositionlat", time="fit|seconds",
           degrees=_SEMICIRCLES,
           columns={"time": "recordtimestamp", "latitude": "recordpositionlat", "longitude": "recordpositionlong",
                    "altitude": "recordenhancedaltitude|recordaltitude", "sigma": "recordgpsaccuracy"}),
    Format("Suunto", "ehpe latitude longitude gpsaltitude",
           columns={"time": "utc", "sigma": "ehpe", "altitude": "gpsaltitude"},
           degrees=_RADIANS),
    Format("OwnTracks", "tst tid", columns={"time": "tst", "id": "tid", "sigma": "acc"}),
    Format("CoreLocation of Apple", "timeintervalsincereferencedate", time="apple",
           columns={"time": "timeintervalsincereferencedate"}),
    Format("CoreLocation of Apple", "ztimestamp zlatitude zlongitude", time="apple",
           columns={"time": "ztimestamp", "latitude": "zlatitude", "longitude": "zlongitude", "altitude": "zaltitude",
                    "sigma": "zhorizontalaccuracy"}),
    Format("CoreLocation of Apple", "timestamp horizontalaccuracy verticalaccuracy", time="apple|seconds|iso"),
    Format("Torque", "gpstime longitude latitude devicetime|speed|horizontaldilutionofprecision",
           columns={"time": "gpstime"}, time=f"{_JAVA}|iso"),
    Format("Traccar", "fixtime devicetime valid", columns={"time": "fixtime", "id": "deviceid"}),
    # ---------------------------------------------------------------- robots, players and traffic on video
    Format("days of the year", "doy|dayofyear sod|secondsofday", refused="write whole times instead of days of the "
           "year and seconds of the day, such as 2024-06-03 08:15:00"),
    Format("Imaris", "x y unit category collection time", refused="Time is the number of an image: name columns by the "
           "options x, y, z and time, and say time_format, such as 0.1fps, and units mm, which are um in the results"),
    Format("OptiTrack", begins="Format Version,", columns={"x": "x", "y": "z", "z": "y"}),
    Format("TUM", "tx ty", columns={"x": "tx", "y": "ty", "z": "tz"}),
    Format("EuRoC", "prsrx prsry", columns={"x": "prsrx", "y": "prsry", "z": "prsrz"}),
    Format("NGSIM", "globaltime localx localy vehicleid", time="ms", units={"localx": "ft", "localy": "ft"},
           columns={"time": "globaltime", "x": "localx", "y": "localy", "id": "vehicleid"}),
    Format("SUMO", "timesteptime vehicleid vehiclex vehicley", time="seconds",
           columns={"time": "timesteptime", "id": "vehicleid", "x": "vehiclex", "y": "vehicley"}),
    Format("NFL", "gameid playid nflid", units={"x": "yd", "y": "yd"}, columns={"id": "nflid"}),
    Format("Pozyx", "tagid success version", units={"x": "mm", "y": "mm", "z": "mm"}),
)  # fmt: skip
"""The first that fits is taken."""


def format_of(names: Iterable[str]) -> Format | None:
    """The format of a table with columns of these names."""
    plains = {plain(name) for name in names}
    return next(
        (one for one in FORMATS if one.needs and all({*need.split("|")} & plains for need in one.needs.split())), None
    )


def format_of_text(text: str) -> Format | None:
    """The format of a text that begins so."""
    return next((one for one in FORMATS if one.begins and re.match(one.begins, text, re.MULTILINE)), None)
