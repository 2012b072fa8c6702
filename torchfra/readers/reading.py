"""Reads the tracks of a file; ``torchfra.readers`` says which files."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from torchfra.readers.bounded import MAX_BYTES
from torchfra.readers.layouts import PLAIN, columns_wanted, layout_of
from torchfra.readers.recording import Origin, Recording
from torchfra.readers.repairs import Target, repaired_targets
from torchfra.readers.tables import listed, naming, read_table


def read(path: str | Path, *, origin: Origin | None = None, max_bytes: int = MAX_BYTES) -> list[Recording]:
    """Reads every target of a file.

    These are repaired and counted: rows without time or position, rows out of time order, all but the first of the rows
    with the same time, held positions (the same as in the row before, without a newer position update where the file
    records updates), and missing altitudes.

    Args:
        path: the file.
        origin: latitude, longitude in degrees and altitude in m that become (0, 0, 0); if None, the first fix of the
            first target in the file.
        max_bytes: of text that the file may hold, unpacked: a row counts for 64 or more, a name for 4096, a byte of
            JSON for 24.  Ten million rows of CSV are within the default, 1 GiB, and need 1.6 GiB of memory.

    Returns:
        The recordings, sorted by name, all about the same origin.

    Raises:
        ValueError: the file is empty, broken, too large or of another format, or no target has 2 fixes left.
        ImportError: pymap3d is needed and not installed.
    """
    path = Path(path)
    with naming(path):
        table = read_table(path, columns_wanted, max_bytes=max_bytes)
        layout = layout_of(table.names)
        if layout is PLAIN and origin is not None:
            raise ValueError(f"origin: expected degrees to go with it, received the columns {listed(table.names)}")
        targets = repaired_targets(table, layout, Path(path.name.removesuffix(".gz")).stem)
        if layout is not PLAIN:
            return _located(targets, origin)
    return [Recording(n, f[:, 0].copy(), np.delete(f, (0, 3), 1), None, dict(+repairs)) for n, f, repairs in targets]


def _located(targets: list[Target], origin: Origin | None) -> list[Recording]:
    """Turns degrees into metres about the origin, by default the first fix of all."""
    try:
        from pymap3d import geodetic2enu
    except ImportError as error:
        raise ImportError('latitudes and longitudes need pymap3d: pip install "torchfra[data]"') from error
    first = (*targets[0].fixes[0].tolist(), 0.0)
    lat, lon, up = (first[1], first[2], first[4]) if origin is None else origin
    if not (abs(lat) <= 90 and abs(lon) <= 180 and math.isfinite(up)):
        raise ValueError(f"origin: expected latitude, longitude in degrees and altitude in m, received {origin}")
    recordings = []
    for name, fixes, repairs in targets:
        height = fixes[:, 4] if fixes.shape[1] == 5 else up
        enu = np.stack(geodetic2enu(fixes[:, 1], fixes[:, 2], height, lat, lon, up), 1)
        recordings.append(
            Recording(name, fixes[:, 0].copy(), enu[:, : fixes.shape[1] - 2], (lat, lon, up), dict(+repairs))
        )
    return sorted(recordings, key=lambda recording: recording.name)
