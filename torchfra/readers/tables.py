"""From a file to a table: the columns that somebody wants, of numbers and of text."""

from __future__ import annotations

import csv
import gzip
import io
import json
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from torchfra.readers.bounded import (
    BYTES_OF_A_TEXT,
    MAX_BYTES,
    Rows,
    check_bound,
    open_bounded,
    too_large,
)
from torchfra.readers.columns import Array, Kind, number, numbers, text

Wanted: TypeAlias = dict[str, Kind | None]
"""The columns to read by their names, and the kind of their numbers; None for text."""
HEADERS = (
    "expected a header with t,x,y[,z]; or time,icao24,lat,lon; or timestamp,latitude,longitude, separated by commas"
)
"""The beginning of an error message."""
_JSON = 24
"""What a byte of JSON counts for: it is read as a whole, and takes up more memory."""


class Table(NamedTuple):
    """What is read of a file."""

    names: list[str]
    """Of all columns."""
    rows: int
    numbers: dict[str, Array]
    """``(rows,)`` each, NaN where empty."""
    texts: dict[str, list[str]]
    """As many, "" where empty."""

    def column(self, name: str) -> Array:
        """Numbers ``(rows,)``, read-only NaN where the column is absent."""
        return self.numbers.get(name, np.broadcast_to(np.float64(np.nan), self.rows))


def read_table(
    path: Path,
    choose: Callable[[list[str]], Wanted],
    *,
    headers: str = HEADERS,
    repairs: Counter[str] | None = None,
    max_bytes: int = MAX_BYTES,
) -> Table:
    """Columns of a CSV or JSON file, gzipped or not.

    Args:
        path: the file.
        choose: which columns to read of those of these names; it may raise a ``ValueError``.
        headers: beginning of the error message where there is no header.
        repairs: where to count rows of CSV with more or fewer fields than the header, whose cells become empty; None
            refuses them, and tables without rows.
        max_bytes: of text; a row counts for 64 bytes or more, a name for 4096 and a byte of JSON for 24.

    Raises:
        ValueError: the file is empty, broken, too large or neither.
    """
    check_bound(max_bytes)
    suffix = Path(path.name.removesuffix(".gz")).suffix
    with open_bounded(path, max_bytes) as file:
        try:
            start = file.peek(1).removeprefix(b"\xef\xbb\xbf").lstrip()[:1]
            if suffix == ".json" or (suffix != ".csv" and start in (b"[", b"{")):
                table = _from_json(file, choose, max_bytes)
            else:
                table = _from_csv(file, choose, headers, repairs, max_bytes)
        except (EOFError, gzip.BadGzipFile, zlib.error, UnicodeDecodeError) as error:
            raise ValueError(
                f"expected UTF-8 text or a complete gzip file of it, received neither ({error})"
            ) from error
    if repairs is None and not table.rows:
        raise ValueError(f"expected rows, received none under the columns {listed(table.names)}")
    return table


def listed(names: list[str]) -> str:
    """Names for an error message, cut off where they are too many."""
    return ", ".join(names)[:200] or "(none)"


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Puts the name of a file in front of the message of a ``ValueError``."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _from_json(file: io.BufferedReader, choose: Callable[[list[str]], Wanted], max_bytes: int) -> Table:
    data = file.read(max_bytes // _JSON + 1)
    if len(data) > max_bytes // _JSON:
        raise too_large(max_bytes, f"of text, of which one of JSON counts for {_JSON}")
    content = data.decode("utf-8-sig")
    if not content.strip():
        raise ValueError("expected a track, received an empty file")
    try:
        parsed = json.loads(content, object_pairs_hook=_object)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"expected JSON, every key of an object once, received other text ({error})") from error
    names, rows, cells = _json_columns(parsed)
    growing = _Growing(names, choose(names) if names else {}, max_bytes)
    if names:
        growing.add(rows, cells)
    return growing.table()


def _json_columns(parsed: Any) -> tuple[list[str], int, Callable[[str], list[Any]]]:
    """Names of the columns, the number of rows, and the cells of a column by its name.

    Raises:
        ValueError: neither records nor columns.
    """
    if isinstance(parsed, dict):
        columns = {name: column for name, column in parsed.items() if isinstance(column, dict)}
        keys = list(dict.fromkeys(key for column in columns.values() for key in column))
        return list(columns), len(keys), lambda name: [columns[name].get(key) for key in keys]
    records = parsed if isinstance(parsed, list) else [parsed]
    if other := next((type(one).__name__ for one in records if not isinstance(one, dict)), ""):
        raise ValueError(f"expected a list of records or a table of columns, received {other} instead of an object")
    names = list(dict.fromkeys(name for record in records for name in record))
    return names, len(records), lambda name: [record.get(name) for record in records]


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON.

    Raises:
        ValueError: a key comes twice.
    """
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError(f"several keys named {_repeated([key for key, _ in pairs])}")
    return found


def _from_csv(
    file: io.BufferedReader, choose: Callable[[list[str]], Wanted], headers: str, repairs: Counter[str] | None,
    max_bytes: int,
) -> Table:  # fmt: skip
    def mended(row: list[str], before: int) -> list[str]:
        if repairs is None:
            raise ValueError(f"expected {len(names)} fields in data row {before + 1}, received {len(row)}")
        repairs["rows with too many or too few fields emptied"] += 1
        return [""] * len(names)

    try:
        rows = Rows(io.TextIOWrapper(file, "utf-8-sig", newline=""), max_bytes)
        names = _header(rows.first(), headers)
        growing, place = _Growing(names, choose(names), max_bytes), {name: i for i, name in enumerate(names)}
        for cells in rows.parts(len(names), mended):
            growing.add(len(cells) // len(names), partial(_cells, cells, place))
    except csv.Error as error:
        raise ValueError(f"expected CSV, received other text ({error})") from error
    return growing.table()


def _header(row: list[str], headers: str) -> list[str]:
    """The names of columns.

    Raises:
        ValueError: they are none, or the same.
    """
    if not row:
        raise ValueError("expected a track, received an empty file")
    names = [name.strip() for name in row]
    if len(names) == 1 or all(_is_number(name) for name in names):
        raise ValueError(f"{headers}; received {listed(names)}")
    if repeated := _repeated(names):
        raise ValueError(f"expected every column once, received several named {repeated}")
    return names


def _cells(cells: list[str], place: dict[str, int], name: str) -> list[str]:
    """Of a column, out of those of rows one after the other."""
    return cells[place[name] :: len(place)]


class _Growing:
    """A table that grows part by part."""

    def __init__(self, names: list[str], wanted: Wanted, max_bytes: int) -> None:
        self.names, self.wanted, self.max_bytes, self.rows = names, wanted, max_bytes, 0
        self.numbers: dict[str, list[Array]] = {
            name: [np.empty(0)] for name, kind in wanted.items() if kind is not None
        }
        self.texts: dict[str, list[str]] = {name: [] for name, kind in wanted.items() if kind is None}
        self.known: dict[Any, str] = {}

    def add(self, rows: int, cells: Callable[[str], list[Any]]) -> None:
        """Adds rows by the cells of each column."""
        for name, kind in self.wanted.items():
            if kind is None:
                self.texts[name] += text(cells(name), name, self.known, self.rows)
            else:
                self.numbers[name].append(numbers(cells(name), kind, name, self.rows))
        self.rows += rows
        if len(self.known) * BYTES_OF_A_TEXT > self.max_bytes:
            raise too_large(self.max_bytes, f"of text, of which each name counts for {BYTES_OF_A_TEXT} or more")

    def table(self) -> Table:
        """All of it; what has grown is then gone."""
        joined = {name: np.concatenate(self.numbers.pop(name)) for name in list(self.numbers)}
        return Table(self.names, self.rows, joined, self.texts)


def _repeated(names: list[str]) -> str:
    """Those that come twice, for an error message; "" if none does."""
    return ", ".join(name for name, count in Counter(names).items() if count > 1 and name)[:200]


def _is_number(cell: str) -> bool:
    try:
        number(cell)
    except ValueError:
        return False
    return True
