"""Reads recordings of ranges from files and folders."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from torchfra.readers.bounded import MAX_BYTES
from torchfra.readers.clocks import YEAR_1980, clock_of
from torchfra.readers.columns import DECIMAL, Array, Head, Kind, grouped
from torchfra.readers.options import ReadOptions, listed
from torchfra.readers.ranges import RangeRecording
from torchfra.readers.recording import Recording
from torchfra.readers.tables import Wanted, naming, read_table

_PATTERNS = ("*.csv", "*.csv.gz", "*.json", "*.json.gz")
_HEADERS = "expected a header with t,range[,anchor][,x,y[,z]]; or t,x,y[,z]; or anchor,x,y[,z], separated by commas"
_NAMES = {
    "time": ("stamp", "timestamp", "t", "time"),
    "anchor": ("anchor", "anchorid", "id"),
    "range": ("range", "distance", "distancefromtag", "dist", "r"),
    "x": ("x",), "y": ("y",), "z": ("z",),
}  # fmt: skip
"""Names of columns, best first, in small letters, without signs and without a leading "field"."""
_METRES = Kind("a number of metres")
_SAME_PLACE = 0.01
"""Metres by which the places of an anchor that stands still may differ."""


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
    further ones do not matter.  Metres, and times as in files of tracks, which may begin at 0 whatever their name.

    These are repaired and counted: rows without time or without range, ranges that are not above 0, rows out of time
    order, all but the first of the rows of an anchor with the same time, anchors without any range, and in a folder
    files of another kind.

    Args:
        source: a folder, a file, or several files of the same recording.
        anchors: a file that says where the anchors are; it goes before what ``source`` says.
        reference: a file with the reference path, instead of one in ``source``.
        max_bytes: that each file may hold, unpacked; a byte of JSON counts for 24.

    Raises:
        ValueError: a file is broken, too large or of another kind, no range is left, an anchor has no place, two places
            or two files, or there are two reference paths.
    """
    single = isinstance(source, str | Path)
    paths = [Path(source)] if isinstance(source, str | Path) else [Path(path) for path in source]
    if not paths:
        raise ValueError("source: expected a folder or files, received none")
    name = (paths[0] if single else paths[0].parent).as_posix()
    folder, found = single and paths[0].is_dir(), _Found()
    for path in _tables_in(paths[0]) if folder else paths:
        _add(path, found, max_bytes, any_kind=folder)
    for stated, what, columns in ((anchors, "places", "anchor,x,y[,z]"), (reference, "paths", "t,x,y[,z]")):
        if stated is not None:
            _add(Path(stated), other := _Found(), max_bytes)
            if not getattr(other, what):
                raise ValueError(f"{stated}: expected rows with the columns {columns}, received a file of another kind")
            found.places |= other.places
            found.paths = other.paths or found.paths
    return _recording(name, found)


def range_folders(folder: str | Path) -> list[Path]:
    """The folders, this one or below it, that hold a recording each: those with CSV or JSON files, sorted.

    Raises:
        ValueError: no folder with such files.
    """
    return sorted({path.parent for path in _tables_in(Path(folder), below=True)})


def _tables_in(folder: Path, *, below: bool = False) -> list[Path]:
    """The CSV and JSON files of a folder, and perhaps of those below it, sorted by name."""
    files = sorted(path for pattern in _PATTERNS for path in (folder.rglob if below else folder.glob)(pattern))
    if not files:
        raise ValueError(f"{folder}: expected CSV or JSON files{' there or below' * below}, received none")
    return files


@dataclass
class _Found:
    """What the files of a recording hold."""

    anchors: list[tuple[tuple[str, ...], Array, Array]] = field(default_factory=list)
    """Names of an anchor, the first its own; times and ranges ``(k, 2)``; its place ``(3,)``, NaN where not said."""
    places: dict[str, Array] = field(default_factory=dict)
    paths: list[Recording] = field(default_factory=list)
    repairs: Counter[str] = field(default_factory=Counter)


def _add(path: Path, found: _Found, max_bytes: int, *, any_kind: bool = False) -> None:
    """Adds what a file holds; a file of another kind is counted if ``any_kind`` may come."""
    stem, earliest = Path(path.name.removesuffix(".gz")).stem, -math.inf

    def choose(head: Head) -> Wanted:
        nonlocal earliest
        columns = _columns_of(head.names)
        if not _kind_of(columns):
            return {}
        kinds: dict[str, Kind | None] = {"anchor": None}
        if "time" in columns:
            clock, _ = clock_of(head, ReadOptions(time=columns["time"]), {"time": (columns["time"],)}, None)
            kinds["time"], earliest = clock.kind, YEAR_1980 if clock.dated else earliest
        return {name: kinds.get(what, _METRES) for what, name in columns.items()}

    with naming(path):
        table = read_table(path, choose, max_bytes=max_bytes)
        columns = _columns_of(table.names)
        kind = _kind_of(columns)
        if not kind and any_kind and not all(map(DECIMAL.fullmatch, table.names)):
            found.repairs["files of another kind left out"] += 1
            return
        if not kind:
            raise ValueError(f"{_HEADERS}; received {listed(table.names)}")
        position = np.stack([table.column(columns.get(axis, "")) for axis in "xyz"], 1)
        rows = grouped(table.texts.get(columns.get("anchor", ""), []))
        if kind == "places":
            found.places.update({name: _place(position[i], name) for name, i in rows.items() if name})
            return
        time = table.column(columns["time"])
        time = np.where(time < earliest, np.nan, time)  # of a clock that was not set yet
        if kind == "path":
            position = position[:, :2] if np.isnan(position[:, 2]).all() else position
            repairs = Counter[str]()
            data = _in_order(np.column_stack([time, position]), "position", repairs)
            if len(data) < 2:
                raise ValueError(f"expected 2 or more rows with time and position, received {len(data)}")
            found.paths.append(Recording(stem, data[:, 0], data[:, 1:], None, dict(+repairs)))
            return
        data, known = np.column_stack([time, table.column(columns["range"])]), [label for label in rows if label]
        several: dict[tuple[str, ...], Any] = {(label,): rows[label] for label in known}
        if len(known) <= 1:  # an anchor that is not named, or only by its id, has the name of its file
            own = (*known, stem) if "anchor" in columns.get("anchor", "").lower() else (stem, *known)
            several = {own: slice(None)}
        else:
            found.repairs["rows without anchor dropped"] += len(rows.get("", ()))
        for names, i in several.items():
            ranges = _in_order(data[i], "range", found.repairs)
            good = ranges[:, 1] > 0
            found.repairs["ranges that are not above 0 dropped"] += int((~good).sum())
            found.anchors.append((names, ranges[good], _place(position[i], names[0])))


def _recording(name: str, found: _Found) -> RangeRecording:
    """A recording of all that was found."""
    heard = [anchor for anchor in found.anchors if len(anchor[1])]
    found.repairs["anchors without ranges dropped"] += len(found.anchors) - len(heard)
    names = [known[0] for known, *_ in heard]
    if not heard:
        raise ValueError(f"{name}: expected ranges above 0 with their times, received none")
    if repeated := sorted(one for one, count in Counter(names).items() if count > 1):
        raise ValueError(f"{name}: expected every anchor in one file, received several with {', '.join(repeated)}")
    if len(found.paths) > 1:
        received = ", ".join(path.name for path in found.paths)
        raise ValueError(f"{name}: expected one reference path, received {received}")
    stated = found.places
    places = np.stack([next((stated[n] for n in known if n in stated), place) for known, _, place in heard])
    for one, place in zip(names, places, strict=True):
        if not np.isfinite(place[:2]).all():
            raise ValueError(f"{name}: expected x and y of every anchor, received none for {one}")
    high = np.isfinite(places[:, 2])
    if high.any() and not high.all():
        raise ValueError(f"{name}: expected z of every anchor or of none, received none for {names[high.argmin()]}")
    times, ranges = (tuple(data[:, i] for _, data, _ in heard) for i in range(2))
    anchors = places if high.all() else places[:, :2]
    path = found.paths[0] if found.paths else None
    return RangeRecording(name, tuple(names), anchors, times, ranges, path, dict(+found.repairs))


# ---------------------------------------------------------------- from tables of cells


def _columns_of(names: list[str]) -> dict[str, str]:
    """Which of the columns of these names holds what."""
    plain: dict[str, list[str]] = {}
    for name in names:
        plain.setdefault(re.sub(r"[^a-z0-9]", "", name.lower()).removeprefix("field"), []).append(name)
    found = {what: plain[name] for what, known in _NAMES.items() for name in reversed(known) if name in plain}
    for what, same in found.items():
        if len(same) > 1:
            raise ValueError(f"expected one column of {what}, received {listed(same)}")
    return {what: same[0] for what, same in found.items()}


def _kind_of(columns: dict[str, str]) -> str:
    """What a table with these columns holds: ``"ranges"``, a ``"path"`` or ``"places"``; "" where that is not known."""
    kinds = (("ranges", "time range"), ("path", "time x y"), ("places", "anchor x y"))
    return next((kind for kind, needed in kinds if {*needed.split()} <= columns.keys()), "")


def _in_order(data: Array, what: str, repairs: Counter[str]) -> Array:
    """The rows of times and values ``(rows, 1 + d)`` that have all, in order of time, one of each moment."""

    def keep(data: Array, mask: Any, why: str) -> Array:
        repairs[why] += len(data) - int(mask.sum())
        return np.asarray(data[mask])

    data = keep(data, np.isfinite(data[:, 0]), "rows without time dropped")
    data = keep(data, np.isfinite(data[:, 1:]).all(1), f"rows without {what} dropped")
    time = data[:, 0]
    repairs["rows put in time order"] += int((time < np.maximum.accumulate(time)).sum())
    data = data[np.argsort(time, kind="stable")]
    return keep(data, np.diff(data[:, 0], prepend=-math.inf) > 0, "duplicate times dropped")


def _place(places: Array, name: str) -> Array:
    """Where an anchor is, ``(3,)``, from rows ``(rows, 3)`` of which any may be NaN."""
    place = np.full(3, math.nan)
    for axis, values in enumerate(places.T):
        known = values[np.isfinite(values)]
        if len(known):
            place[axis] = np.median(known)
        if len(known) and np.ptp(known) > _SAME_PLACE:
            received = f"{'xyz'[axis]} from {known.min():g} to {known.max():g} m"
            raise ValueError(f"expected an anchor that stands still, received {name} with {received}")
    return place
