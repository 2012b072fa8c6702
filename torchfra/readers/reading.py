"""Reads the tracks of a file; ``torchfra.readers`` says which files."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from torchfra.geodesy import cosine, to_enu
from torchfra.readers.bounded import MAX_BYTES
from torchfra.readers.columns import Head
from torchfra.readers.layouts import Layout, layout_of
from torchfra.readers.options import Words, listed, read_options
from torchfra.readers.recording import Origin, Recording
from torchfra.readers.repairs import Target, repaired_targets
from torchfra.readers.sanity import checked
from torchfra.readers.sheets import Sheet
from torchfra.readers.tables import Table, Wanted, naming, read_table, table_of


def read(
    path: str | Path, *, origin: Origin | None = None, max_bytes: int = MAX_BYTES, **words: Words
) -> list[Recording]:
    """Reads every target of a file.

    These are repaired and counted: rows without time or position, rows out of time order, all but the first of the rows
    with the same time, held positions of aircraft (the same as in the row before, without a newer position update
    where the file records updates), and missing altitudes.  Where more than half of the rows say when their position
    was sent, as state vectors of OpenSky do, that is its time, unless ``time`` names a column.

    Args:
        path: the file.
        origin: latitude, longitude in degrees and altitude in m that become (0, 0, 0); if None, the first fix of the
            first target in the file.
        max_bytes: that the file may hold, unpacked, 1 GiB by default; a byte of JSON and XML counts for 24.
        words: what the file does not say or says wrongly: see ``ReadOptions``.

    Returns:
        The recordings, sorted by name, all about the same origin; without altitudes, those more than 85 degrees
        from it are each about their own.

    Raises:
        ValueError: the file is empty, broken, too large or of another format, no target has 2 fixes left, or nothing
            can have moved so.
        ImportError: what reads the format is not installed.
    """
    path = Path(path)
    reader = SheetReader(path.name, words)
    with naming(path):
        table = read_table(path, reader, max_bytes=max_bytes, options=reader.options)
        return _recordings(table, reader, origin, Path(path.name.removesuffix(".gz")).stem)


def read_sheet(sheet: Sheet, name: str, **words: Words) -> list[Recording]:
    """Reads every target of columns that are in memory, as ``read`` does of a file.

    Raises:
        ValueError: see ``read``.
    """
    reader = SheetReader(name, words)
    with naming(name):
        return _recordings(table_of(sheet, reader, reader.options), reader, None, name)


class SheetReader:
    """Chooses the columns of a table, and reads others of the same columns, such as parts of a data set.

    Args:
        name: of the file or data set.
        words: see ``ReadOptions``.

    Raises:
        ValueError: (when it is called, too) the words, or the columns, are not understood.
    """

    def __init__(self, name: str, words: Mapping[str, Words]) -> None:
        self.name, self.options = name, read_options(words)
        self._layout: Layout | None = None

    def __call__(self, head: Head) -> Wanted:
        """The columns to read."""
        self._layout = layout_of(head, self.options, self.name)
        return self._layout.wanted

    @property
    def layout(self) -> Layout:
        """What the columns hold."""
        assert self._layout is not None
        return self._layout

    @property
    def columns(self) -> list[str]:
        """Those that it reads."""
        every = (name for one, kind in self.layout.wanted.items() for name in ((kind and kind.joined) or (one,)))
        return list(dict.fromkeys(every))

    def read(self, sheet: Sheet) -> list[Recording]:
        """As ``read_sheet``, but each recording is about its own first fix, however far apart targets are.

        Raises:
            ValueError: see ``read``.
        """
        return _recordings(table_of(sheet, lambda _: self.layout.wanted), self, None, self.name, apart=True)


def _recordings(
    table: Table, reader: SheetReader, origin: Origin | None, stem: str, *, apart: bool = False
) -> list[Recording]:
    """The recordings of a table, about one origin, or each about its own first fix where they are ``apart``."""
    if not table.rows:
        raise ValueError(f"expected rows, received none under the columns {listed(table.names)}")
    layout = reader.layout
    if not layout.degrees and origin is not None:
        raise ValueError(f"origin: expected degrees beside it, received the columns {listed(table.names)}")
    targets = repaired_targets(table, layout, stem)
    shared = _origin(targets[0], origin) if layout.degrees and not apart else None
    own = [layout.degrees and (shared is None or (origin is None and _hidden(target, shared))) for target in targets]
    origins = [_origin(target, None) if alone else shared for target, alone in zip(targets, own, strict=True)]
    recordings = [_recording(target, layout, about) for target, about in zip(targets, origins, strict=True)]
    places = np.concatenate([target.place for target in targets])
    return sorted(checked(recordings, layout, places), key=lambda recording: recording.name)


def _origin(first: Target, origin: Origin | None) -> Origin:
    """What becomes (0, 0, 0): by default the first fix."""
    if origin is None:
        return (
            float(first.place[0, 0]),
            float(first.place[0, 1]),
            0.0 if first.height is None else float(first.height[0]),
        )
    lat, lon, up = origin
    if not (abs(lat) <= 90 and abs(lon) <= 180 and math.isfinite(up)):
        raise ValueError(f"origin: expected latitude, longitude in degrees and altitude in m, received {origin}")
    return lat, lon, up


def _hidden(target: Target, origin: Origin) -> bool:
    """Whether a tenth of a target without altitudes is where no plane about the origin shows it: no few outliers."""
    near = cosine(target.place[:, 0], target.place[:, 1], origin) > math.cos(math.radians(85))
    return target.height is None and bool(near.mean() <= 0.9 and (~near).sum() > 1)


def _recording(target: Target, layout: Layout, origin: Origin | None) -> Recording:
    """A target in metres."""
    place, height = target.place, target.height
    if origin is not None:
        if _hidden(target, origin):
            raise ValueError(
                f"{target.name!r}: expected positions without altitudes within 85 degrees (9400 km) of the origin, "
                f"{origin[0]:.4g}, {origin[1]:.4g}, received a tenth or more beyond: split the track"
            )
        position = to_enu(place[:, 0], place[:, 1], origin[2] if height is None else height, origin)
        position = position if height is not None else position[:, :2]
    else:
        position = place if height is None else np.column_stack([place, height])
    return Recording(
        target.name,
        target.time,
        position,
        origin,
        dict(+target.repairs),
        target.row,
        target.sigma,
        layout.source,
        filled=target.filled,
    )
