"""From tables of cells to ranges, to places of anchors, and to a reference path."""

from __future__ import annotations

import math
import re
from collections import Counter
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from torchfra.readers.columns import Array, Kind, grouped
from torchfra.readers.recording import Recording
from torchfra.readers.sheets import listed
from torchfra.readers.tables import Table, Wanted

Columns: TypeAlias = dict[str, str]
"""Names of the columns of a table, by the key of ``_NAMES`` that says what they hold."""
HEADERS = "expected a header with t,range[,anchor][,x,y[,z]]; or t,x,y[,z]; or anchor,x,y[,z], separated by commas"
_NAMES = {
    "time": ("stamp", "timestamp", "t", "time"),
    "anchor": ("anchor", "anchorid", "id"),
    "range": ("range", "distance", "distancefromtag", "dist", "r"),
    "x": ("x",), "y": ("y",), "z": ("z",),
}  # fmt: skip
"""Names of columns, best first, in small letters, without signs and without a leading "field"."""
_UNITS = ((1e17, 1e9), (1e14, 1e6), (1e11, 1e3), (0.0, 1.0))
"""Least time, and how many of its unit are a second: ns, us, ms since 1970, and seconds."""
_TIME, _METRES = Kind("a time", limit=1e19), Kind("a number of metres")
_SAME_PLACE = 0.01
"""Metres by which the places of an anchor that stands still may differ."""


class AnchorRows(NamedTuple):
    """What a table holds of one anchor."""

    names: tuple[str, ...]
    """What it may be called elsewhere; the first is its name."""
    time: Array
    """``(k,)`` seconds, strictly increasing."""
    ranges: Array
    """``(k,)`` metres."""
    place: Array
    """``(3,)`` metres, NaN where the table does not say."""


def columns_of(names: list[str]) -> Columns:
    """Which of the columns of these names holds what.

    Raises:
        ValueError: several may be the same.
    """
    plain: dict[str, list[str]] = {}
    for name in names:
        plain.setdefault(re.sub(r"[^a-z0-9]", "", name.lower()).removeprefix("field"), []).append(name)
    found = {what: plain[name] for what, known in _NAMES.items() for name in reversed(known) if name in plain}
    longer = [name for name in plain if name.startswith(("range", "distance"))]
    if "range" not in found and len(longer) == 1:
        found["range"] = plain[longer[0]]
    for what, same in found.items():
        if len(same) > 1:
            raise ValueError(f"expected one column of {what}, received {listed(same)}")
    return {what: same[0] for what, same in found.items()}


def columns_wanted(names: list[str]) -> Wanted:
    """What is read of a file with these columns.

    Raises:
        ValueError: see ``columns_of``.
    """
    kinds = {"time": _TIME, "anchor": None}
    return {name: kinds.get(what, _METRES) for what, name in columns_of(names).items()}


def kind_of(names: list[str]) -> str:
    """What a table with columns of these names holds: ``"ranges"``, a ``"path"`` or ``"places"``.

    Raises:
        ValueError: none of them.
    """
    columns = columns_of(names)
    for kind, needed in (("ranges", "time range"), ("path", "time x y"), ("places", "anchor x y")):
        if all(name in columns for name in needed.split()):
            return kind
    raise ValueError(f"{HEADERS}; received {listed(names)}")


def anchors_in(table: Table, stem: str, repairs: Counter[str]) -> list[AnchorRows]:
    """The ranges of each anchor of a table, in the order of their first rows.

    Args:
        table: of ranges.
        stem: of the file's name, which an anchor has that the table does not name or only by its ``id``.
        repairs: where to count them.

    Raises:
        ValueError: times that differ in their unit, or an anchor that moves.
    """
    columns = columns_of(table.names)
    data = np.stack([_seconds(table, columns), _metres(table, columns, "range")], 1)
    places = np.stack([_metres(table, columns, axis) for axis in "xyz"], 1)
    rows = grouped(table.texts.get(columns.get("anchor", ""), []))
    known = [label for label in rows if label]
    if len(known) <= 1:
        named = "anchor" in columns.get("anchor", "").lower()
        names = (*known, stem) if named else (stem, *known)
        return [AnchorRows(names, *_ranges(data, repairs), _place(places, stem))]
    repairs["rows without anchor dropped"] += len(rows.pop("", ()))
    return [AnchorRows((label,), *_ranges(data[i], repairs), _place(places[i], label)) for label, i in rows.items()]


def places_in(table: Table) -> dict[str, Array]:
    """Where the anchors of a table are, ``(3,)`` each with NaN where it does not say, by their names.

    Raises:
        ValueError: an anchor in several places.
    """
    columns = columns_of(table.names)
    places = np.stack([_metres(table, columns, axis) for axis in "xyz"], 1)
    rows = grouped(table.texts[columns["anchor"]])
    return {name: _place(places[i], name) for name, i in rows.items() if name}


def path_in(table: Table, stem: str) -> Recording:
    """The reference path of a table.

    Raises:
        ValueError: times that differ in their unit, or fewer than 2 rows with time and position.
    """
    columns = columns_of(table.names)
    position = np.stack([_metres(table, columns, axis) for axis in "xyz"], 1)
    if np.isnan(position[:, 2]).all():
        position = position[:, :2]
    data, repairs = np.column_stack([_seconds(table, columns), position]), Counter[str]()
    data = data[_in_order(data, "position", repairs)]
    if len(data) < 2:
        raise ValueError(f"expected 2 or more rows with time and position, received {len(data)}")
    return Recording(stem, data[:, 0], data[:, 1:], None, dict(+repairs))


def _metres(table: Table, columns: Columns, what: str) -> Array:
    return table.column(columns.get(what, ""))


def _seconds(table: Table, columns: Columns) -> Array:
    """The times of a table, in whichever unit they are.

    Raises:
        ValueError: some are in another unit than the others.
    """
    time = table.column(columns["time"])
    known = np.abs(time[np.isfinite(time)])
    if not len(known):
        return time
    units = [next(unit for least, unit in _UNITS if t >= least) for t in (known.min(), known.max())]
    if units[0] != units[1]:
        raise ValueError(f"expected times in one unit, received {known.min():g} to {known.max():g}")
    return time / units[0]


def _ranges(data: Array, repairs: Counter[str]) -> tuple[Array, Array]:
    """Times and ranges ``(k,)`` that are left of rows ``(rows, 2)``."""
    kept = data[_in_order(data, "range", repairs)]
    good = kept[:, 1] > 0
    repairs["ranges that are not above 0 dropped"] += int((~good).sum())
    return kept[good, 0], kept[good, 1]


def _in_order(data: Array, what: str, repairs: Counter[str]) -> NDArray[np.intp]:
    """Which rows ``(rows, 1 + d)`` of times and values to keep, in order of time."""

    def keep(index: NDArray[np.intp], mask: Any, why: str) -> NDArray[np.intp]:
        repairs[why] += len(index) - int(mask.sum())
        return np.asarray(index[mask])

    index = keep(np.arange(len(data)), np.isfinite(data[:, 0]), "rows without time dropped")
    index = keep(index, np.isfinite(data[index, 1:]).all(1), f"rows without {what} dropped")
    time = data[index, 0]
    repairs["rows put in time order"] += int((time < np.maximum.accumulate(time)).sum())
    index = index[np.argsort(time, kind="stable")]
    return keep(index, np.diff(data[index, 0], prepend=-math.inf) > 0, "duplicate times dropped")


def _place(places: Array, name: str) -> Array:
    """Where an anchor is, ``(3,)``, from rows ``(rows, 3)`` of which any may be NaN.

    Raises:
        ValueError: it is in several places.
    """
    place = np.full(3, math.nan)
    for axis, values in enumerate(places.T):
        known = values[np.isfinite(values)]
        if len(known):
            place[axis] = np.median(known)
        if len(known) and np.ptp(known) > _SAME_PLACE:
            received = f"{'xyz'[axis]} from {known.min():g} to {known.max():g} m"
            raise ValueError(f"expected an anchor that stands still, received {name} with {received}")
    return place
