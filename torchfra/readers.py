"""Reads tracks from files into local metres, and counts what it had to repair on the way.

The columns decide what a file is.  It is CSV with a header or JSON (records or columns), gzipped or not:

- ``timestamp, latitude, longitude`` [``altitude, icao24, callsign, last_position``]: ms since 1970 or ISO text (UTC
  where it names no zone), degrees, feet.
- ``time, icao24, lat, lon`` [``baroaltitude, geoaltitude, callsign, lastposupdate``]: the state vectors of OpenSky, in
  seconds since 1970, degrees, metres.  A missing baroaltitude gives way to geoaltitude.
- ``t, x, y`` [``z``]: seconds and metres.
"""

from __future__ import annotations

import csv
import gzip
import io
import json
import math
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
Origin: TypeAlias = tuple[float, float, float]
_Table: TypeAlias = dict[str, list[Any]]
_EPOCH = datetime.fromisoformat("1970-01-01T00:00:00+00:00")
# time, place, place, what a held position leaves unchanged, up, up where that is missing
_TRAFFIC = ("timestamp", "latitude", "longitude", "last_position", "altitude", "")
_OPENSKY = ("time", "lat", "lon", "lastposupdate", "baroaltitude", "geoaltitude")
_PLAIN = ("t", "x", "y", "z", "z", "")
_NEEDED = {_TRAFFIC: _TRAFFIC[:3], _OPENSKY: ("time", "icao24", "lat", "lon"), _PLAIN: _PLAIN[:3]}


@dataclass(frozen=True, eq=False)
class Recording:
    """The track of one target."""

    name: str
    """icao24 and first callsign, as far as they are there, else the stem of the file."""
    time: Array
    """``(k,)`` seconds, strictly increasing; since 1970 if the file says so."""
    position: Array
    """``(k, 3)`` metres east, north, up of the origin; ``(k, 2)`` for a target that never told its altitude."""
    origin: Origin | None
    """Latitude and longitude in degrees, altitude in metres; None for a file of x and y."""
    repairs: dict[str, int]
    """What was done to rows, and to how many; empty if nothing was."""


class _Target(NamedTuple):
    name: str
    fixes: Array
    """``(k, 5 or 4)``: time in s, place, mark, and up in m if there is any."""
    repairs: Counter[str]


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


def _table(path: Path) -> _Table:
    """The columns of a file."""
    data = path.read_bytes()
    try:
        text = (gzip.decompress(data) if data.startswith(b"\x1f\x8b") else data).decode("utf-8-sig")
    except (EOFError, OSError, zlib.error, UnicodeDecodeError) as error:
        raise ValueError(f"expected UTF-8 text or all of its gzip, received something else ({error})") from error
    if not text.strip():
        raise ValueError("expected a track, received an empty file")
    suffix = Path(path.name.removesuffix(".gz")).suffix
    is_json = suffix == ".json" or (suffix != ".csv" and text.lstrip()[0] in "[{")
    table = _from_json(text) if is_json else _from_csv(text)
    if not any(table.values()):
        raise ValueError(f"expected rows, received none under the columns {_listed(table)}")
    return table


def _listed(names: _Table | list[str]) -> str:
    return ", ".join(names)[:200] or "(none)"


def _from_json(text: str) -> _Table:
    try:
        data = json.loads(text)
    except ValueError as error:
        raise ValueError(f"expected JSON, received text that is not ({error})") from error
    if isinstance(data, dict):
        columns = {name: column for name, column in data.items() if isinstance(column, dict)}
        keys = dict.fromkeys(key for column in columns.values() for key in column)
        return {name: [column.get(key) for key in keys] for name, column in columns.items()}
    if not isinstance(data, list) or not all(isinstance(record, dict) for record in data):
        raise ValueError(f"expected a list of records or a table of columns, received {data!s:.60}")
    return {name: [record.get(name) for record in data] for name in dict.fromkeys(k for record in data for k in record)}


def _from_csv(text: str) -> _Table:
    try:
        head, *rows = [row for row in csv.reader(io.StringIO(text, newline=""), strict=True) if row]
    except csv.Error as error:
        raise ValueError(f"expected CSV, received text that is not ({error})") from error
    header = [name.strip() for name in head]
    if twice := [name for name, count in Counter(header).items() if count > 1 and name]:
        raise ValueError(f"expected each column once, received more of {_listed(twice)}")
    for number, row in enumerate(rows, 1):
        if len(row) != len(header):
            raise ValueError(f"expected {len(header)} fields in row {number}, received {len(row)}")
    return {name: [row[i] for row in rows] for i, name in enumerate(header)}


def _layout(table: _Table) -> tuple[str, ...]:
    """The format that the columns fit best."""
    best = max(_NEEDED, key=lambda layout: sum(name in table for name in _NEEDED[layout]) / len(_NEEDED[layout]))
    if missing := [name for name in _NEEDED[best] if name not in table]:
        formats = "; or ".join(", ".join(names) for names in _NEEDED.values())
        raise ValueError(f"expected the columns {formats}; missing {_listed(missing)}, received {_listed(table)}")
    return best


def _number(value: Any, limit: float = 1e15, unit: float = 1.0) -> float:
    """A cell as a number, NaN if empty; nothing that moves is over the limit, where arithmetic would overflow."""
    if value is None or (isinstance(value, str) and not value.strip()):
        return math.nan
    number = math.inf if isinstance(value, bool) else float(value)
    if abs(number) > limit:
        raise ValueError
    return number * unit


def _instant(value: Any) -> float:
    """Ms since 1970, or ISO text, as s since 1970."""
    try:
        number = _number(value)
    except ValueError:
        moment = datetime.fromisoformat(str(value).strip().replace("Z", "+00:00"))
        return ((moment if moment.tzinfo else moment.replace(tzinfo=_EPOCH.tzinfo)) - _EPOCH).total_seconds()
    if 1e9 < number < 1e10:  # these would be seconds of this century, or ms of a few weeks of 1970
        raise ValueError
    return number / 1e3


_CELLS: dict[str, tuple[str, Callable[[Any], float]]] = {
    "timestamp": ("ms since 1970 or ISO text", _instant),
    "altitude": ("a number", partial(_number, unit=0.3048)),
    **dict.fromkeys(("latitude", "lat"), ("degrees within +-90", partial(_number, limit=90.0))),
    **dict.fromkeys(("longitude", "lon"), ("degrees within +-180", partial(_number, limit=180.0))),
}


def _column(table: _Table, name: str) -> Array:
    """A column ``(rows,)`` in s, degrees or m; NaN where empty or absent."""
    kind, convert = _CELLS.get(name, ("a number", _number))
    numbers = np.full(len(next(iter(table.values()))), math.nan)
    for i, value in enumerate(table.get(name, ())):
        try:
            numbers[i] = convert(value)
        except (TypeError, ValueError, OverflowError):
            raise ValueError(f"expected {kind} in row {i + 1}, column {name}, received {value!r:.60}") from None
    return numbers


def _words(table: _Table, name: str) -> list[str]:
    """A column as text; "" where empty or absent."""
    values = table.get(name, [None] * len(next(iter(table.values()))))
    return ["" if value is None or value != value else str(value).strip() for value in values]


def _targets(table: _Table, layout: tuple[str, ...], stem: str) -> list[_Target]:
    """The targets of a file that keep 2 fixes, in the order of the file."""
    data = np.stack([_column(table, name) for name in layout], 1)
    icao24s, calls = ([""] * len(data) if layout is _PLAIN else _words(table, name) for name in ("icao24", "callsign"))
    members: dict[str, list[int]] = {}
    for i, icao24 in enumerate(icao24s):
        members.setdefault(icao24, []).append(i)
    targets = []
    for icao24, rows in members.items():
        index, repairs = _kept(data[rows])
        call = next((calls[rows[i]] for i in index if calls[rows[i]]), "")
        name = f"{icao24} {call}".strip()
        targets.append(_Target(name or stem, _raised(data[rows][index], repairs), repairs))
    good = [target for target in targets if len(target.fixes) >= 2]
    if not good:
        done = dict(sum((target.repairs for target in targets), Counter[str]()))
        raise ValueError(f"expected a target with 2 fixes, received none in {len(data)} rows after repairs: {done}")
    for target in good:
        target.repairs["aircraft with under 2 fixes dropped"] = len(targets) - len(good)
    return good


def _kept(data: Array) -> tuple[NDArray[np.intp], Counter[str]]:
    """Which rows ``(rows, 6)`` of a target to keep, in order of time, and the count of the repairs."""
    repairs: Counter[str] = Counter()

    def keep(index: NDArray[np.intp], mask: Any, what: str) -> NDArray[np.intp]:
        repairs[what] = len(index) - int(mask.sum())
        return np.asarray(index[mask])

    index = keep(np.arange(len(data)), np.isfinite(data[:, 0]), "rows without time dropped")
    index = keep(index, np.isfinite(data[index, 1:3]).all(1), "rows without position dropped")
    time = data[index, 0]
    repairs["rows put in time order"] = int((time < np.maximum.accumulate(time)).sum())
    index = index[np.argsort(time, kind="stable")]
    index = keep(index, np.diff(data[index, 0], prepend=-math.inf) > 0, "duplicate times dropped")
    step = np.diff(np.nan_to_num(data[index, 1:4], nan=1e16), axis=0, prepend=2e16)
    return keep(index, step.any(1), "held positions dropped"), repairs


def _raised(fixes: Array, repairs: Counter[str]) -> Array:
    """Fixes ``(k, 6)`` as ``(k, 5)``, no up missing, or as ``(k, 4)`` if every up is."""
    known = np.isfinite(fixes[:, 4:])
    some = known.any(1)
    if not some.any():
        return fixes[:, :4]
    before = np.maximum.accumulate(np.where(some, np.arange(len(fixes)), -1))
    row = np.where(before < 0, some.argmax(), before)
    repairs["altitudes taken from geoaltitude"] = int((some & ~known[:, 0]).sum())
    repairs["altitudes filled from the fix before"] = int((~some & (before >= 0)).sum())
    repairs["altitudes filled from the fix after"] = int((before < 0).sum())
    return np.column_stack([fixes[:, :4], fixes[row, 4 + known[row].argmax(1)]])


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


def resample(recording: Recording, dt: float, *, max_gap: float) -> list[tuple[Array, Array]]:
    """Puts a recording on a regular grid by cubic Hermite interpolation, which goes through the fixes.

    Args:
        recording: the track.
        dt: step of the grid in seconds; it starts at the first fix of every piece.
        max_gap: seconds; a longer gap between fixes splits the track.

    Returns:
        ``(time (k,), position (k, d))`` of every piece that lasts for a step, so ``k >= 2``, in order of time.

    Raises:
        ValueError: ``dt`` or ``max_gap`` is not above 0.
    """
    if not (0 < dt < math.inf and max_gap > 0):
        raise ValueError(f"expected dt and max_gap above 0 s, received {dt} and {max_gap}")
    breaks = np.flatnonzero(np.diff(recording.time) > max_gap) + 1
    pieces = []
    for time, position in zip(np.split(recording.time, breaks), np.split(recording.position, breaks), strict=True):
        steps = math.floor((time[-1] - time[0]) / dt + 1e-5)  # times since 1970 are good to 1e-6 s
        if steps >= 1:
            grid = time[0] + dt * np.arange(steps + 1)
            pieces.append((grid, _hermite(time, position, grid)))
    return pieces


def _hermite(time: Array, position: Array, grid: Array) -> Array:
    """``(k, d)`` on the grid ``(k,)``; the slope at a fix is that of the parabola through it and its neighbours."""
    slope = np.gradient(position, time, axis=0, edge_order=2 if len(time) > 2 else 1)
    i = (np.searchsorted(time, grid, "right") - 1).clip(0, len(time) - 2)
    h, rise = (time[i + 1] - time[i])[:, None], position[i + 1] - position[i]
    s = (grid - time[i])[:, None] / h
    bend = (1 - s) * (slope[i] * h - rise) - s * (slope[i + 1] * h - rise)
    return np.asarray(position[i] + s * rise + s * (1 - s) * bend)


def samples(*groups: str) -> list[Path]:
    """The recorded tracks that come with the package ``traffic``.

    Args:
        groups: names of its folders of samples, such as "calibration", "gliders", "noisy".

    Returns:
        The files, sorted.

    Raises:
        ImportError: the package is not installed.
        ValueError: no group, or an unknown one.
    """
    spec = find_spec("traffic")
    roots = [Path(place) / "data" / "samples" for place in (spec and spec.submodule_search_locations) or ()]
    there = {file.parent.name for root in roots for file in root.glob("*/*.json.gz")}
    if not there:
        raise ImportError("the sample tracks need their package: pip install --no-deps traffic==2.13")
    if not groups or not there.issuperset(groups):
        raise ValueError(f"expected groups among {', '.join(sorted(there))}, received {', '.join(groups) or 'none'}")
    return sorted(file for root in roots for group in set(groups) for file in root.glob(f"{group}/*.json.gz"))
