"""Numbers that stand for a missing one, such as -999."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchfra.readers.columns import Array

PLACEHOLDERS = (-999.0, -9999.0, -99999.0, 999.0, 9999.0, 99999.0, -32768.0)
"""As loggers and data bases write them; no degrees are as large."""
_ISOLATED = 0.5
"""Share of a placeholder that all measured numbers stay below."""
_ENOUGH = 25
"""Numbers beside a placeholder from which on it differs from them for sure; among fewer any may have been measured."""
_NULL_ISLAND = 1.0
"""Degrees around 0, 0 within which nothing else is found, where that is no place."""


def stand_for_none(values: Array) -> NDArray[np.bool_]:
    """Which of ``(rows,)`` are a placeholder that is far from all others."""
    gone = np.zeros(len(values), dtype=bool)
    for placeholder in PLACEHOLDERS:
        at = np.isclose(values, placeholder, rtol=0, atol=1e-6)
        rest = np.sign(placeholder) * values[~at & np.isfinite(values)]
        if at.any() and len(rest) >= _ENOUGH and rest.max() < _ISOLATED * abs(placeholder):
            gone |= at
    return gone


def no_altitudes(values: Array) -> NDArray[np.bool_]:
    """Which altitudes ``(rows,)`` are a placeholder, or 0 as all others, which KML has where there are none."""
    zero: NDArray[np.bool_] = values == 0
    return zero if (zero | np.isnan(values)).all() else stand_for_none(values)


def nowhere(first: Array, second: Array, degrees: bool) -> NDArray[np.bool_]:
    """Which positions ``(rows,)`` are placeholders: the same one in both coordinates, or 0 degrees in both.

    Args:
        first: one coordinate.
        second: the other.
        degrees: whether they are latitudes and longitudes, of which placeholders are missing already.
    """
    if not degrees:
        return stand_for_none(first) & stand_for_none(second) & np.isclose(first, second)
    null = (first == 0) & (second == 0)
    near = (np.abs(first) < _NULL_ISLAND) & (np.abs(second) < _NULL_ISLAND) & ~null
    return null if not near.any() and not null.all() else np.zeros(len(null), dtype=bool)
