"""Reads tracks from files into local metres, and counts what it had to repair on the way.

The columns decide what a file is.  It is CSV with a header or JSON (records or columns), gzipped or not:

- ``timestamp, latitude, longitude`` [``altitude, icao24, callsign, last_position``]: ms since 1970 or ISO text (UTC
  where it names no zone), degrees, feet.
- ``time, icao24, lat, lon`` [``baroaltitude, geoaltitude, callsign, lastposupdate``]: the state vectors of OpenSky, in
  seconds since 1970, degrees, metres.  A missing baroaltitude gives way to geoaltitude.
- ``t, x, y`` [``z``]: seconds and metres.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from torchfra.readers.columns import _PLAIN, _layout, _listed, _table
from torchfra.readers.recording import Origin, Recording
from torchfra.readers.repairs import _Target, _targets


def read(path: str | Path, *, origin: Origin | None = None) -> list[Recording]:
    """Reads every target of a file.

    Rows without time or place, late rows, all but the first row of a time, held positions (as in the row before, and
    not of a newer position update where the file tells) and missing altitudes are repaired and counted.

    Args:
        path: the file.
        origin: latitude, longitude in degrees and altitude in m that become (0, 0, 0); the first fix of the target
            that the file names first, unless given.

    Returns:
        The recordings, sorted by name, all of one origin.

    Raises:
        ValueError: the file is empty, broken or of another format, or no target keeps 2 fixes.
        ImportError: pymap3d is needed and absent.
    """
    path = Path(path)
    try:
        table = _table(path)
        layout = _layout(table)
        targets = _targets(table, layout, Path(path.name.removesuffix(".gz")).stem)
        if layout is not _PLAIN:
            return _located(targets, origin)
        if origin is not None:
            raise ValueError(f"expected latitudes to go with the origin, received the columns {_listed(table)}")
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    except RecursionError as error:
        raise ValueError(f"{path}: expected flat rows, received some nested too deep") from error
    return [Recording(n, f[:, 0], np.delete(f, (0, 3), 1), None, dict(+repairs)) for n, f, repairs in targets]


def _located(targets: list[_Target], origin: Origin | None) -> list[Recording]:
    """Turns degrees into metres about the origin, by default the first fix of all."""
    try:
        from pymap3d import geodetic2enu
    except ImportError as error:
        raise ImportError('latitudes and longitudes need pymap3d: pip install "torchfra[data]"') from error
    first = (*targets[0].fixes[0].tolist(), 0.0)
    lat, lon, up = (first[1], first[2], first[4]) if origin is None else origin
    if not (abs(lat) <= 90 and abs(lon) <= 180 and math.isfinite(up)):
        raise ValueError(f"expected an origin of latitude, longitude in degrees, altitude in m, received {origin}")
    recordings = []
    for name, fixes, repairs in targets:
        height = fixes[:, 4] if fixes.shape[1] == 5 else up
        enu = np.stack(geodetic2enu(fixes[:, 1], fixes[:, 2], height, lat, lon, up), 1)
        recordings.append(Recording(name, fixes[:, 0], enu[:, : fixes.shape[1] - 2], (lat, lon, up), dict(+repairs)))
    return sorted(recordings, key=lambda recording: recording.name)
