"""Reads recordings of ranges from files and folders."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from torchfra.readers.bounded import MAX_BYTES
from torchfra.readers.columns import Array, Head
from torchfra.readers.range_tables import (
    HEADERS,
    AnchorRows,
    anchors_in,
    columns_wanted,
    kind_of,
    path_in,
    places_in,
)
from torchfra.readers.ranges import RangeRecording
from torchfra.readers.recording import Recording
from torchfra.readers.tables import Wanted, naming, read_table

_PATTERNS = ("*.csv", "*.csv.gz", "*.json", "*.json.gz")


@dataclass
class _Found:
    """What the files of a recording hold."""

    anchors: list[AnchorRows] = field(default_factory=list)
    places: dict[str, Array] = field(default_factory=dict)
    paths: list[Recording] = field(default_factory=list)
    repairs: Counter[str] = field(default_factory=Counter)


def read_ranges(
    source: str | Path | Sequence[str | Path],
    *,
    anchors: str | Path | None = None,
    reference: str | Path | None = None,
    max_bytes: int = MAX_BYTES,
) -> RangeRecording:
    """Reads a recording of ranges from anchors that stand still.

    The columns decide what a file is: CSV with a header, or JSON, gzipped or not.

    - ``t, range``: of one anchor, which is called as the file; with ``x, y[, z]`` also where it is.
    - ``t, anchor, range``: of several; the same.
    - ``anchor, x, y[, z]``: where the anchors are.
    - ``t, x, y[, z]``: the reference path.

    Columns may have other common names (``stamp``, ``timestamp``; ``id``; ``distance``, ``field.distanceFromTag``);
    further ones do not matter.  Metres, and seconds, or ms, us or ns since 1970.

    These are repaired and counted: rows with too many or too few fields, without time or without range, ranges that are
    not above 0, rows out of time order, all but the first of the rows of an anchor with the same time, anchors without
    any range, and in a folder files of another kind.

    Args:
        source: a folder, a file, or several files of the same recording.
        anchors: a file that says where the anchors are; it goes before what ``source`` says.
        reference: a file with the reference path, instead of one in ``source``.
        max_bytes: of text that each file may hold, unpacked: a row counts for 64 or more, a name for 4096,
            a byte of JSON for 24.

    Raises:
        ValueError: a file is broken, too large or of another kind, no range is left, an anchor has no place, two places
            or two files, or there are two reference paths.
    """
    single = isinstance(source, str | Path)
    paths = [Path(source)] if isinstance(source, str | Path) else [Path(path) for path in source]
    if not paths:
        raise ValueError("source: expected a folder or files, received none")
    name = (paths[0] if single else paths[0].parent).as_posix()
    folder = single and paths[0].is_dir()
    found = _Found()
    for path in _tables_in(paths[0]) if folder else paths:
        _add(path, found, max_bytes, any_kind=folder)
    if anchors is not None:
        found.places.update(_only("places", anchors, max_bytes).places)
    if reference is not None:
        found.paths = _only("paths", reference, max_bytes).paths
    return _recording(name, found)


def range_folders(folder: str | Path) -> list[Path]:
    """The folders, this one or below it, that hold a recording each: those with CSV or JSON files, sorted.

    Raises:
        ValueError: there is none.
    """
    found = sorted({path.parent for pattern in _PATTERNS for path in Path(folder).rglob(pattern)})
    if not found:
        raise ValueError(f"{folder}: expected CSV or JSON files there or below, received none")
    return found


def _tables_in(folder: Path) -> list[Path]:
    """Files, sorted by name.

    Raises:
        ValueError: there is none.
    """
    files = sorted(path for pattern in _PATTERNS for path in folder.glob(pattern))
    if not files:
        raise ValueError(f"{folder}: expected CSV or JSON files, received none")
    return files


class _OtherKindError(Exception):
    """A file holds neither ranges nor places nor a path."""


def _add(path: Path, found: _Found, max_bytes: int, *, any_kind: bool = False) -> None:
    """Adds what a file holds; a file of another kind is counted if ``any_kind`` may come."""

    def choose(head: Head) -> Wanted:
        try:
            kind_of(head.names)
        except ValueError as error:
            if any_kind:
                raise _OtherKindError from error
            raise
        return columns_wanted(head.names)

    stem = Path(path.name.removesuffix(".gz")).stem
    with naming(path):
        try:
            table = read_table(path, choose, headers=HEADERS, repairs=found.repairs, max_bytes=max_bytes)
            kind = kind_of(table.names)
        except _OtherKindError:
            found.repairs["files of another kind left out"] += 1
            return
        if kind == "ranges":
            found.anchors += anchors_in(table, stem, found.repairs)
        elif kind == "path":
            found.paths.append(path_in(table, stem))
        else:
            found.places.update(places_in(table))


def _only(kind: str, path: str | Path, max_bytes: int) -> _Found:
    """What a file holds that must hold ``"places"`` or ``"paths"``."""
    found = _Found()
    _add(Path(path), found, max_bytes)
    if not getattr(found, kind):
        columns = {"places": "anchor,x,y[,z]", "paths": "t,x,y[,z]"}[kind]
        raise ValueError(f"{path}: expected rows with the columns {columns}, received a file of another kind")
    return found


def _recording(name: str, found: _Found) -> RangeRecording:
    """A recording of all that was found.

    Raises:
        ValueError: see ``read_ranges``.
    """
    heard = [anchor for anchor in found.anchors if len(anchor.time)]
    found.repairs["anchors without ranges dropped"] += len(found.anchors) - len(heard)
    names = [anchor.names[0] for anchor in heard]
    if not heard:
        raise ValueError(f"{name}: expected ranges above 0 with their times, received none")
    if repeated := sorted(one for one, count in Counter(names).items() if count > 1):
        raise ValueError(f"{name}: expected every anchor in one file, received several with {', '.join(repeated)}")
    if len(found.paths) > 1:
        received = ", ".join(path.name for path in found.paths)
        raise ValueError(f"{name}: expected one reference path, received {received}")
    places = np.stack([_place_of(anchor, found.places) for anchor in heard])
    for one, place in zip(names, places, strict=True):
        if not np.isfinite(place[:2]).all():
            raise ValueError(f"{name}: expected x and y of every anchor, received none for {one}")
    high = np.isfinite(places[:, 2])
    if high.any() and not high.all():
        raise ValueError(f"{name}: expected z of every anchor or of none, received none for {names[high.argmin()]}")
    times, ranges = (tuple(column) for column in zip(*(anchor[1:3] for anchor in heard), strict=True))
    anchors = places if high.all() else places[:, :2]
    path = found.paths[0] if found.paths else None
    return RangeRecording(name, tuple(names), anchors, times, ranges, path, dict(+found.repairs))


def _place_of(anchor: AnchorRows, places: dict[str, Array]) -> Array:
    return next((places[name] for name in anchor.names if name in places), anchor.place)
