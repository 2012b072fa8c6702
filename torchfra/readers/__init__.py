"""Reads tracks from files into local metres, and counts what it had to repair on the way.

The columns decide what a file is.  It is CSV with a header or JSON (records or columns), gzipped or not:

- ``timestamp, latitude, longitude`` [``altitude, icao24, callsign, last_position``]: ms since 1970 or ISO text (UTC
  where it names no zone), degrees, feet.
- ``time, icao24, lat, lon`` [``baroaltitude, geoaltitude, callsign, lastposupdate``]: the state vectors of OpenSky, in
  seconds since 1970, degrees, metres.  A missing baroaltitude gives way to geoaltitude.
- ``t, x, y`` [``z``]: seconds and metres.

A number is a decimal one in ASCII digits, such as -1.5e3.  Empty cells, null and NaN in any letters are missing.  All
else is refused, also "inf", 1_000 and 0x10; so are times that can only be in another unit, columns or keys that come
twice, and files that hold more than ``max_bytes`` of text: they are read piece by piece, so that a few packed bytes do
not fill the memory.

``read_ranges`` reads what was measured instead: ranges from anchors.
"""

from torchfra.readers.bounded import MAX_BYTES
from torchfra.readers.flyable import flyable
from torchfra.readers.grid import resample
from torchfra.readers.range_files import range_folders, read_ranges
from torchfra.readers.ranges import RangeGrid, RangeRecording
from torchfra.readers.reading import read
from torchfra.readers.recording import Origin, Recording
from torchfra.readers.sample_files import samples

__all__ = [
    "MAX_BYTES",
    "Origin",
    "RangeGrid",
    "RangeRecording",
    "Recording",
    "flyable",
    "range_folders",
    "read",
    "read_ranges",
    "resample",
    "samples",
]
