"""Which column of a table may say which target a row is of, where its name does not."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchfra.readers.columns import Array, Head, is_missing
from torchfra.readers.spelling import COUNTERS, plain

_SEVERAL = 5
"""Least rows of a target, in the mean."""
_HELPS, _AS_GOOD, _CLASHES = 0.5, 1.5, 0.02
"""Share of the clashes or of the way that is left at most of what a column parts; how much longer the way may be than
with the best column, and the share of the rows that may clash more, for a column of fewer targets to be as good."""
_JUMPS = 0.95
"""Share of the ways between rows that are taken as they are: longer ones may lead to outliers."""


def likely_ids(
    head: Head, time: Array, place: Array, names: Sequence[str], known: Sequence[str] = ()
) -> tuple[str, ...]:
    """The columns that may name the target of a row: the likeliest first.

    They have texts or whole numbers, and few for the rows.  Where rows of several targets are parted by the right
    column, each has a time once, and the ways between rows in order of time become much shorter.

    Args:
        head: of the table.
        time: ``(rows,)`` numbers that grow with time, NaN where missing.
        place: ``(rows, 2)`` coordinates, NaN where missing.
        names: of the columns that may be it.
        known: columns that name the target already, though not it alone; the others part it further.
    """
    fixes = np.flatnonzero(np.isfinite(time) & np.isfinite(place).all(1))
    if len(fixes) <= 2 * _SEVERAL:
        return ()
    time, place = time[fixes], place[fixes]
    part: NDArray[np.intp] = np.zeros(len(fixes), np.intp)
    for name in known:
        part = _parted(part, _labels(head.cells(name), fixes))
    if not len(legs := _legs(time, place, part)[1]):  # each target has a row
        return ()
    longest = float(np.quantile(legs, _JUMPS))
    clashes, way = _disorder(time, place, part, longest)
    better = dict[str, tuple[float, float, int]]()
    for name in names:
        labels = _labels(head.cells(name), fixes)
        parts = _parted(part, labels)
        if (count := int(parts.max(initial=0)) + 1) <= part.max() + 1 or len(fixes) <= _SEVERAL * count:
            continue
        several = _disorder(time, place, parts, longest)
        shorter = several[1] < _HELPS * way
        if shorter or (not known and _CLASHES * len(fixes) < clashes and several[0] < _HELPS * clashes):
            better[name] = (*several, count)
    if not better:
        return ()
    fewest = min(clash for clash, *_ in better.values()) + _CLASHES * len(fixes)
    shortest = _AS_GOOD * min(way for clash, way, _ in better.values() if clash <= fewest)

    def rank(name: str) -> tuple[bool, bool, int, float]:
        clash, way, count = better[name]
        return clash > fewest, way > shortest, count, clash

    return tuple(sorted(better, key=rank))


def counts_rows(name: str, head: Head) -> bool:
    """Whether a column numbers the rows instead of naming targets."""
    if plain(name) not in COUNTERS:
        return False
    cells = [str(cell).strip() for cell in head.cells(name) if cell is not None and not isinstance(cell, list | dict)]
    return len({*cells}) == len(cells) > 2


def option(*names: str) -> str:
    """``--id`` with the name of a column, or of several, as a shell takes it."""
    return f"--id {shlex.quote(names[0]) if len(names) == 1 else repr(','.join(names))}"


def _disorder(time: Array, place: Array, part: NDArray[np.intp], longest: float) -> tuple[int, float]:
    """How many rows have the time of another of their part, and how long the ways of all parts are."""
    passed, legs = _legs(time, place, part)
    return int((passed == 0).sum()), float(legs.clip(max=longest).sum())


def _legs(time: Array, place: Array, part: NDArray[np.intp]) -> tuple[Array, Array]:
    """Seconds and ways from the rows of each part to the next ones, in order of time."""
    order = np.lexsort((time, part))
    same = np.diff(part[order]) == 0
    return np.diff(time[order])[same], np.linalg.norm(np.diff(place[order], axis=0), axis=1)[same]


def _parted(part: NDArray[np.intp], labels: NDArray[np.intp]) -> NDArray[np.intp]:
    """Numbers of parts, each of one label."""
    return np.asarray(np.unique(part * (labels.max(initial=0) + 1) + labels, return_inverse=True)[1])


def _labels(cells: Sequence[Any] | NDArray[Any], rows: NDArray[np.intp]) -> NDArray[np.intp]:
    """Numbers of the texts and whole numbers of a column; all 0 where it has others."""
    values, number = cells.tolist() if isinstance(cells, np.ndarray) else cells, dict[str, int]()
    labels = np.zeros(len(rows), np.intp)
    for i, row in enumerate(rows.tolist()):
        cell = values[row]
        whole = isinstance(cell, float) and cell.is_integer()  # as tables write whole numbers beside empty cells
        text = "" if cell is None or cell != cell else str(int(cell) if whole else cell).strip()
        text = "" if is_missing(text) else text
        if isinstance(cell, bool | list | dict) or _is_fraction(text):
            return np.zeros(len(rows), np.intp)
        labels[i] = number.setdefault(text, len(number))
    return labels


def _is_fraction(text: str) -> bool:
    """Whether it is a number with decimals other than 0, as what is measured has."""
    with suppress(ValueError):
        return not float(text.replace(",", ".")).is_integer()
    return False
