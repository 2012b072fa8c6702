"""Columns of numbers from the files of recordings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from torchfra.readers.columns import Array, Head, Kind
from torchfra.readers.tables import naming, read_table

Columns = dict[str, Array]


def read_columns(path: Path, names: Sequence[str]) -> Columns:
    """Columns ``(T,)`` of a CSV file with a header, by name; NaN where a cell is empty.

    Raises:
        ValueError: a column is missing, or a cell is no number; the message begins with the name of the file.
    """

    def choose(head: Head) -> dict[str, Kind | None]:
        missing = [name for name in names if name not in head.names]
        if missing:
            raise ValueError(f"expected the columns {', '.join(names)}, received none called {', '.join(missing)}")
        return dict.fromkeys(names, Kind())

    with naming(path):
        table = read_table(path, choose)
        if not table.rows:
            raise ValueError(f"expected rows, received none under the columns {', '.join(table.names)}")
    return {name: table.column(name) for name in names}


def check_complete(path: Path, columns: Columns, names: Sequence[str]) -> None:
    """Checks that columns have a number in every row.

    Raises:
        ValueError: one has not; the message names file, column and row, of which the header is number 1.
    """
    for name in names:
        empty = np.flatnonzero(np.isnan(columns[name]))
        if len(empty):
            raise ValueError(f"{path}: {name}: expected a number in every row, received none in row {empty[0] + 2}")


def check_ascending(path: Path, name: str, time: Array) -> None:
    """Checks that times grow from row to row.

    Raises:
        ValueError: they do not; the message names file, column and row, of which the header is number 1.
    """
    back = np.flatnonzero(np.diff(time) <= 0)
    if len(back):
        before, after = time[back[0]], time[back[0] + 1]
        raise ValueError(f"{path}: {name}: expected times that grow, received {after:g} after {before:g}, "
                         f"in row {back[0] + 3}")  # fmt: skip


def steps_between(time: Array) -> Array:
    """Seconds ``(T,)`` that lead to each step; to the first one as many as to the second, or 1 where it is alone."""
    dt = np.diff(time)
    return np.concatenate([dt[:1] if len(dt) else np.ones(1), dt])
