"""Repairs the rows of every target, and counts the repairs."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchfra.readers.columns import PLAIN, Array, Layout, column, text_column
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
    data = np.stack([column(table, name) for name in layout], 1)
    icao24s, calls = (
        [""] * len(data) if layout is PLAIN else text_column(table, name) for name in ("icao24", "callsign")
    )
    members: dict[str, list[int]] = {}
    for i, icao24 in enumerate(icao24s):
        members.setdefault(icao24, []).append(i)
    targets = []
    for icao24, rows in members.items():
        index, repairs = _rows_to_keep(data[rows])
        call = next((calls[rows[i]] for i in index if calls[rows[i]]), "")
        name = f"{icao24} {call}".strip()
        targets.append(Target(name or stem, _with_altitude(data[rows][index], repairs), repairs))
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


def _rows_to_keep(data: Array) -> tuple[NDArray[np.intp], Counter[str]]:
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


def _with_altitude(fixes: Array, repairs: Counter[str]) -> Array:
    """Fixes ``(k, 6)`` as ``(k, 5)`` with missing altitudes filled, or as ``(k, 4)`` if all altitudes are missing."""
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
