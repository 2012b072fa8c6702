"""From a file to columns of numbers and words."""

from __future__ import annotations

import csv
import gzip
import io
import json
import math
import zlib
from collections import Counter
from collections.abc import Callable
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]


_Table: TypeAlias = dict[str, list[Any]]


_EPOCH = datetime.fromisoformat("1970-01-01T00:00:00+00:00")


# time, place, place, what a held position leaves unchanged, up, up where that is missing
_TRAFFIC = ("timestamp", "latitude", "longitude", "last_position", "altitude", "")


_OPENSKY = ("time", "lat", "lon", "lastposupdate", "baroaltitude", "geoaltitude")


_PLAIN = ("t", "x", "y", "z", "z", "")


_NEEDED = {_TRAFFIC: _TRAFFIC[:3], _OPENSKY: ("time", "icao24", "lat", "lon"), _PLAIN: _PLAIN[:3]}


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
