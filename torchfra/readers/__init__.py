"""Reads tracks from files into local metres, and counts its repairs.

A file is one of these, gzipped or not (except for the last):

- rows of text under a header, separated by commas, semicolons, tabs, bars or spaces, with decimal points or commas, and
  comments (# or %); other lines before the header, units above or beneath it and the header again are left out;
- JSON: records, in a list or one a line (or a list of some a line), columns, GeoJSON with a time for each place, the
  timeline of a phone, what receivers of aircraft write (traces and ``aircraft.json`` of readsb, tar1090 and dump1090),
  state vectors of OpenSky, streams of Strava, samples of Suunto, or messages of OwnTracks;
- GPX (extra ``formats``), KML with times, TCX, VBOX, IGC, PLT, FIT as FitCSVTool writes it, logs of GnssLogger, NMEA
  0183 with RMC and GGA (extra) or with ships in AIS whose receiver adds times;
- Parquet and Feather (extra), and arrays of numpy (``.npy``), of rows and columns or of named fields.

Columns are found by their names, in any case and common spellings: a time; x, y[, z] or latitude, longitude[,
altitude]; which target a row is of (icao24, mmsi, id, ...); how good a fix is (sigma, accuracy, hdop, covariances of
ROS).  ``ReadOptions`` names others, by their numbers from 1 on where there is no header.  One column may hold points
(WKB in hexadecimal digits or WKT), or objects of JSON with all.
This covers the state vectors of OpenSky, the tracks of ``traffic``, logs of ships such as the Danish ones, and animals
of Movebank: classes and error ellipses of Argos say how good a fix is, and rows marked as outliers are dropped.
Times are ISO text, UTC where it names no zone, dates in other forms, or numbers: s, ms, us or ns since 1970 by their
size, weeks of GPS with what of them has passed, days of the year with seconds of the day, seconds since 2001 of phones
that count so and since 1989 of FIT, seconds with their parts in another column, or seconds (minutes, hours, days by
their names) since any start.  A local date and time may have their offset from UTC in a column of its own.
Lengths are metres unless the name of a column or ``units`` says another unit; altitudes that aircraft send
(``altitude`` beside icao24 or a callsign) are feet, flight levels hundreds of feet.  Degrees are decimal ones, or
degrees, minutes and seconds; letters of the sides stand in front, behind or in a column of their own.
A z that is the same everywhere is left out, unless it is named.  Of columns with moments the only one is the time,
whatever its name.
``Source.notes`` states which columns were read as what.

Placeholders (-999, 9999, 99999 and the like) are missing beside 25 numbers or more of which none is half as large: in
the altitude, or in both coordinates at once; so are 0, 0 degrees far from all else.

A number is a decimal one in ASCII digits, such as -1.5e3, or 1,234.5 where both signs show what they are.  Empty cells,
N/A, null, None, NaN in any letters and - are missing.  All else is refused, also "inf", 1_000 and 0x10; so are times in
two units or with the name of a zone, dates of which some have the day first and some the month, dates and clocks whose
digits stand in one number (a ``time_format`` reads them), clocks of 12 hours without AM and PM, those that are put back
at the end of summer time, columns or keys that come twice, XML with entities, tracks that no target of their kind can
follow, and files that hold more than ``max_bytes`` of text: they are read piece by piece, so that a few packed bytes do
not fill the memory.

``read_ranges`` reads ranges from anchors instead of positions.
"""

from torchfra.readers.bounded import MAX_BYTES
from torchfra.readers.flyable import flyable
from torchfra.readers.grid import resample
from torchfra.readers.options import ReadOptions
from torchfra.readers.range_files import range_folders, read_ranges
from torchfra.readers.ranges import RangeGrid, RangeRecording
from torchfra.readers.reading import read
from torchfra.readers.recording import Origin, Recording, Source
from torchfra.readers.sample_files import samples

__all__ = [
    "MAX_BYTES",
    "Origin",
    "RangeGrid",
    "RangeRecording",
    "ReadOptions",
    "Recording",
    "Source",
    "flyable",
    "range_folders",
    "read",
    "read_ranges",
    "resample",
    "samples",
]
