"""Flags of steps: usual, an outlier, a manoeuvre, or unclear."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchfra.readers.columns import Array

MATTERS = 3.0
"""Distance from the path, in standard deviations of a fix, that an outlier exceeds: the path may go through a fix that
contradicts those before it."""
GATE = {2: 13.816, 3: 16.266}
"""Normalised innovation squared that one good fix in 1000 exceeds, by dimensions of space (chi-square)."""
LIKELY = 0.5
"""Probability above which a fix is rather an outlier than not."""
_DOUBTFUL, _MANOEUVRE = 0.2, 0.5
"""Least probabilities of an unclear fix, and of a manoeuvre."""


def flags(
    fix: NDArray[np.bool_], nis: Array, outlier: Array, manoeuvre: Array, listed: NDArray[np.bool_], gate: float
) -> NDArray[np.str_]:
    """The flag of each step of a track.

    A fix is an outlier if its probability is above one half, and unclear if that is above a fifth.  If the filter has
    no such probability, a fix beyond the gate is unclear.  Other steps, also between fixes, are manoeuvres where one is
    listed, if the filter has no probability of it or one above one half.

    Args:
        fix: ``(T,)`` which steps have a fix.
        nis: ``(T,)`` normalised innovation squared.
        outlier: ``(T,)`` probability that the fix is an outlier; NaN if the filter has no such probability.
        manoeuvre: ``(T,)`` probability of a manoeuvre; NaN where unknown.
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
