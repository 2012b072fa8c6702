"""Columns with a latitude and a longitude in one cell, such as "47.1,8.2"."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchfra.readers.columns import Cells, Head
from torchfra.readers.spelling import found, plain

_NAMES = {"position", "latlon", "latlng", "latlong", "latitudelongitude", "coordinates", "location"}
_PAIR = re.compile(r"\s*\(?\s*([+-]?[0-9]+\.?[0-9]*)\s*[,; ]\s*([+-]?[0-9]+\.?[0-9]*)\s*\)?\s*")
_AXES = ("latitude", "longitude")


def pair_of(head: Head) -> str | None:
    """The column that holds both; None where there is none, or they have columns of their own."""
    if any(found(head.names, axis) for axis in (*_AXES, "x")):
        return None
    for name in head.names:
        cells = [cell for cell in head.cells(name) if isinstance(cell, str) and cell.strip()]
        if plain(name) in _NAMES and any(map(_PAIR.fullmatch, cells)):
            return name
    return None


def parted(cells: Cells, pair: str) -> Cells:
    """The cells of columns, with two more: ``latitude`` and ``longitude``."""

    def of(name: str) -> Sequence[Any] | NDArray[np.generic]:
        if name not in _AXES:
            return cells(name)
        return [_part(cell, _AXES.index(name)) for cell in cells(pair)]

    return of


def _part(cell: Any, i: int) -> Any:
    """A coordinate of a cell; the cell itself where it holds something else, which is then refused."""
    match = _PAIR.fullmatch(cell) if isinstance(cell, str) else None
    return match[i + 1] if match else cell
