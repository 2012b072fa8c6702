"""What each step was: usual, an outlier, a manoeuvre, or unclear."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchfra.filters.alarms import LIKELY
from torchfra.readers.columns import Array

_DOUBTFUL, _MANOEUVRE = 0.2, 0.5
"""Least probability of what may be an outlier, and of a manoeuvre."""


def flags(
    fix: NDArray[np.bool_], nis: Array, outlier: Array, manoeuvre: Array, listed: NDArray[np.bool_], gate: float
) -> NDArray[np.str_]:
    """What each step of a track was.

    A fix is an outlier if that is more probable than not, and unclear if it may well be one.  Where the filter does not
    say how probable that is, a fix beyond the gate is unclear.  All else is a manoeuvre where one is listed, and more
    probable than not if the filter says so, also between fixes.

    Args:
        fix: ``(T,)`` which steps have a fix.
        nis: ``(T,)`` normalised innovation squared.
        outlier: ``(T,)`` probability that the fix is an outlier; NaN where the filter does not say.
        manoeuvre: ``(T,)`` probability of a regime other than the calm one; NaN where unknown.
        listed: ``(T,)`` which steps are in a segment.
        gate: normalised innovation squared that a good fix hardly ever exceeds.

    Returns:
        ``(T,)`` of ``torchfra.cleaning.cleaned.FLAGS``.
    """
    wrong = np.nan_to_num(outlier, nan=0.0)
    doubtful = np.where(np.isnan(outlier), nis > gate, wrong > _DOUBTFUL)
    flag = np.where(listed & (np.nan_to_num(manoeuvre, nan=1.0) > _MANOEUVRE), "manoeuvre", "")
    flag = np.where(fix & doubtful, "unclear", flag)
    return np.where(fix & (wrong > LIKELY), "outlier", flag)
