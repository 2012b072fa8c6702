"""Repairs the rows of every target, and counts the repairs."""

from __future__ import annotations

import math
from collections import Counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchfra.readers.columns import Array, grouped
from torchfra.readers.layouts import Layout
from torchfra.readers.tables import Table


class Target(NamedTuple):
    """A target and the fixes that are left of it."""

    name: str
    fixes: Array
    """``(k, 5)``: time in s, two coordinates, what marks a new position, altitude in m; ``(k, 4)`` without altitude."""
    repairs: Counter[str]


def repaired_targets(table: Table, layout: Layout, stem: str) -> list[Target]:
    """The targets of a file that have 2 fixes or more left, in the order of the file.

    Raises:
        ValueError: there is none.
    """
    columns = [table.column(name) for name in layout]
    calls, icao24s = table.texts.get("callsign"), table.texts.get("icao24")
    members = {"": np.arange(table.rows)} if icao24s is None else grouped(icao24s)
    targets = []
    for icao24, rows in members.items():
        index, repairs = _rows_to_keep(columns, rows)
        call = "" if calls is None else next((calls[i] for i in index if calls[i]), "")
        name = f"{icao24} {call}".strip()
        targets.append(Target(name or stem, _fixes(columns, index, repairs), repairs))
    good = [target for target in targets if len(target.fixes) >= 2]
    if not good:
        raise ValueError(_too_few(targets))
    for target in good:
        target.repairs["aircraft with under 2 fixes dropped"] = len(targets) - len(good)
    return good


def _too_few(targets: list[Target]) -> str:
    """An error message."""
    same = " of the same aircraft" if len(targets) > 1 else ""
    received = max(len(target.fixes) for target in targets)
    repairs = sum((target.repairs for target in targets), Counter[str]())
    after = " after repairs: " + ", ".join(f"{count} {what}" for what, count in repairs.items()) if repairs else ""
    return f"expected 2 or more rows with time and position{same}, received {received}{after}"


def _rows_to_keep(columns: list[Array], rows: NDArray[np.intp]) -> tuple[NDArray[np.intp], Counter[str]]:
    """Which of the rows of a target to keep, in order of time, and the count of the repairs; columns as in a layout."""
    repairs: Counter[str] = Counter()

    def keep(index: NDArray[np.intp], mask: NDArray[np.bool_], what: str) -> NDArray[np.intp]:
        repairs[what] = len(index) - int(mask.sum())
        return index if mask.all() else index[mask]

    times, first, second, update, *_ = columns
    index = keep(rows, np.isfinite(times[rows]), "rows without time dropped")
    index = keep(index, np.isfinite(first[index]) & np.isfinite(second[index]), "rows without position dropped")
    time = times[index]
    repairs["rows put in time order"] = int((time < np.maximum.accumulate(time)).sum())
    index = index[np.argsort(time, kind="stable")]
    index = keep(index, np.diff(times[index], prepend=-math.inf) > 0, "duplicate times dropped")
    moved = np.zeros(len(index), dtype=bool)
    for column in (first, second, update):
        moved |= np.diff(np.nan_to_num(column[index], nan=1e16), prepend=2e16) != 0
    return keep(index, moved, "held positions dropped"), repairs


def _fixes(columns: list[Array], index: NDArray[np.intp], repairs: Counter[str]) -> Array:
    """Fixes ``(k, 5)`` with missing altitudes filled, or ``(k, 4)`` if all altitudes are missing."""
    known = [np.isfinite(column[index]) for column in columns[4:]]
    some = known[0] | known[1]
    fixes = np.empty((len(index), 5 if some.any() else 4))
    for i, column in enumerate(columns[:4]):
        fixes[:, i] = column[index]
    if some.any():
        before = np.maximum.accumulate(np.where(some, np.arange(len(index)), -1))
        row = np.where(before < 0, some.argmax(), before)
        repairs["altitudes taken from geoaltitude"] = int((some & ~known[0]).sum())
        repairs["altitudes filled from the fix before"] = int((~some & (before >= 0)).sum())
        repairs["altitudes filled from the fix after"] = int((before < 0).sum())
        fixes[:, 4] = np.where(known[0], *(column[index] for column in columns[4:]))[row]
    return fixes
