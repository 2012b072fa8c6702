"""Which column of a table may say which target a row is of, where its name does not: for messages only."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from torchfra.readers.columns import Array, Head, joined, texts_of

_SEVERAL = 5
"""Least rows of a target, in the mean."""
_HELPS, _CLASHES = 0.5, 0.02
"""Share of the clashes or of the way that is left at most of what a column parts; share of rows that may clash more."""


def likely_ids(
    head: Head, time: Array, place: Array, names: Sequence[str], known: Sequence[str] = ()
) -> tuple[str, ...]:
    """The columns of texts or whole numbers, few for the rows, that part them best: the likeliest first.

    Where rows of several targets are parted by the right column, each has a time once, and the ways between rows in
    order of time become much shorter.

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
    parted = np.array(joined(head.cells, tuple(known)) if known else [""] * len(head.cells(head.names[0])))[fixes]
    whole = np.unique(parted, return_inverse=True)[1]
    clashes, way = _disorder(time, place, whole)
    better = list[tuple[bool, float, str]]()
    for name in names:
        texts = [str(cell).strip().removesuffix(".0") for cell in head.cells(name)]
        if any("." in text for text in texts_of(texts)):
            continue  # measured, not counted
        labels, part = np.unique(np.char.add(np.char.add(parted, " "), np.array(texts)[fixes]), return_inverse=True)
        if not whole.max() + 1 < len(labels) < len(fixes) / _SEVERAL:
            continue
        clash, shorter = _disorder(time, place, part)
        if shorter < _HELPS * way or (_CLASHES * len(fixes) < clashes and clash < _HELPS * clashes):
            better.append((clash > _CLASHES * len(fixes), shorter, name))
    return tuple(",".join((*known, name)) for *_, name in sorted(better))


def _disorder(time: Array, place: Array, part: NDArray[np.intp]) -> tuple[int, float]:
    """How many rows have the time of another of their part, and how long the ways of all parts are."""
    order = np.lexsort((time, part))
    same = np.diff(part[order]) == 0
    legs = np.linalg.norm(np.diff(place[order], axis=0), axis=1)
    return int((np.diff(time[order])[same] == 0).sum()), float(legs[same].sum())
