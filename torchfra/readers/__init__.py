"""Reads tracks from files into local metres, and counts its repairs.

A file is rows of text under a header, JSON (records, columns, GeoJSON, what receivers of aircraft write), GPX, KML,
NMEA 0183, IGC, FIT, Parquet, Feather, or a workbook of a spreadsheet; gzipped or not.  The extra ``formats``
installs what reads some of them.

What columns hold is said by a row of the table ``formats.FORMATS``, which knows what devices and services write, or
else by these rules:

1. Cells are separated by commas, semicolons, tabs, bars or blanks, with decimal points or commas, in UTF-8, UTF-16 or
   Windows' text for western Europe; lines before the header, comments (# or %) and units beneath it are left out.
2. Columns have English names in any case, with a unit in brackets or behind a blank or a sign: a time; x, y[, z] or
   latitude, longitude[, altitude]; sigma, accuracy or hdop; lengths without a unit are metres, and degrees are decimal
   ones with a sign.  An elevation beside an azimuth is an angle, a height beside a width a size, and a track beside the
   speed of an aircraft its course.
3. Times are ISO text, UTC where it names no zone, dates that can be read in one order only, perhaps in a column beside
   that of the clock, or numbers: s, ms, us or ns since 1970 by their size, or seconds since any start; rows are in
   order of time, or have dates.
4. A column called id, name, mmsi, vehicle and the like says which target a row is of; each is a track.
5. Empty cells, N/A, null, None, NaN and - are missing, and 0, 0 degrees far from all else; -999 and the like are
   refused until ``missing`` says what they are.

What neither the table nor the rules say is refused, with the columns and the options that name them
(``ReadOptions``): nothing is guessed from values.  A column may be named by its number from 1 on, header or not.  So
are refused cells that are no numbers, columns or keys that come twice, tracks that no target of their kind can follow,
and files that hold more than ``max_bytes``, unpacked.  ``Source.notes`` states which columns were read as what.

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
