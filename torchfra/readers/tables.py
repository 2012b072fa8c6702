"""From a file to a table of cells, as they stand in the file."""

from __future__ import annotations

import csv
import gzip
import io
import json
import zlib
from collections import Counter
from pathlib import Path
from typing import Any, TypeAlias

Table: TypeAlias = dict[str, list[Any]]
"""The cells of each column, by its name."""
HEADERS = (
    "expected a header with t,x,y[,z]; or time,icao24,lat,lon; or timestamp,latitude,longitude, separated by commas"
)
"""The beginning of an error message."""


def read_table(path: Path, headers: str = HEADERS, repairs: Counter[str] | None = None) -> Table:
    """The columns of a CSV or JSON file, gzipped or not.

    Args:
        path: the file.
        headers: beginning of the error message where there is no header.
        repairs: where to count rows of CSV with more or fewer fields than the header, whose cells become empty; None
            refuses them, and tables without rows.

    Raises:
        ValueError: the file is empty, broken or neither.
    """
    data = path.read_bytes()
    try:
        text = (gzip.decompress(data) if data.startswith(b"\x1f\x8b") else data).decode("utf-8-sig")
    except (EOFError, OSError, zlib.error, UnicodeDecodeError) as error:
        raise ValueError(f"expected UTF-8 text or a complete gzip file of it, received neither ({error})") from error
    if not text.strip():
        raise ValueError("expected a track, received an empty file")
    suffix = Path(path.name.removesuffix(".gz")).suffix
    is_json = suffix == ".json" or (suffix != ".csv" and text.lstrip()[0] in "[{")
    table = _from_json(text) if is_json else _from_csv(text, headers, repairs)
    if repairs is None and not any(table.values()):
        raise ValueError(f"expected rows, received none under the columns {listed(table)}")
    return table


def listed(names: Table | list[str]) -> str:
    """Names for an error message, cut off where they are too many."""
    return ", ".join(names)[:200] or "(none)"


def _from_json(text: str) -> Table:
    try:
        data = json.loads(text)
    except ValueError as error:
        raise ValueError(f"expected JSON, received other text ({error})") from error
    if isinstance(data, dict):
        columns = {name: column for name, column in data.items() if isinstance(column, dict)}
        keys = dict.fromkeys(key for column in columns.values() for key in column)
        return {name: [column.get(key) for key in keys] for name, column in columns.items()}
    if not isinstance(data, list) or not all(isinstance(record, dict) for record in data):
        raise ValueError(f"expected a list of records or a table of columns, received {data!s:.60}")
    return {name: [record.get(name) for record in data] for name in dict.fromkeys(k for record in data for k in record)}


def _from_csv(text: str, headers: str, repairs: Counter[str] | None) -> Table:
    try:
        head, *rows = [row for row in csv.reader(io.StringIO(text, newline=""), strict=True) if row]
    except csv.Error as error:
        raise ValueError(f"expected CSV, received other text ({error})") from error
    header = [name.strip() for name in head]
    if len(header) == 1 or all(_is_number(name) for name in header):
        raise ValueError(f"{headers}; received {listed(header)}")
    if repeated := [name for name, count in Counter(header).items() if count > 1 and name]:
        raise ValueError(f"expected every column once, received several named {listed(repeated)}")
    if repairs is not None:
        repairs["rows with too many or too few fields emptied"] += sum(len(row) != len(header) for row in rows)
        rows = [row if len(row) == len(header) else [""] * len(header) for row in rows]
    for number, row in enumerate(rows, 1):
        if len(row) != len(header):
            raise ValueError(f"expected {len(header)} fields in data row {number}, received {len(row)}")
    return {name: [row[i] for row in rows] for i, name in enumerate(header)}


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
