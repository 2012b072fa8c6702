"""Second differences of fixes: mostly noise where a target goes straight on."""

from __future__ import annotations

import numpy as np

from torchfra.readers.columns import Array
from torchfra.readers.smoothing import differences

_STD = {0.25: 0.3186, 0.5: 0.6745, 0.8: 1.2816}
"""Quantiles of the absolute value of a standard normal variable, by their shares."""


def second_differences(time: Array, path: Array) -> Array:
    """Second differences ``(j, d)`` of a path ``(k, d)``, scaled so that white noise has its own standard deviation.

    Args:
        time: ``(k,)`` seconds, increasing.
        path: ``(k, d)`` m.
    """
    rows = differences(time, 2)
    rows = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(rows[:, :1] * path[:-2] + rows[:, 1:2] * path[1:-1] + rows[:, 2:] * path[2:])


def spread(values: Array, share: float = 0.8) -> float:
    """The standard deviation of a normal distribution about 0 with the values' quantile of this share."""
    return float(np.quantile(np.abs(values), share)) / _STD[share]
