"""Moments of a Gaussian mixture."""

from __future__ import annotations

import numpy as np

from oracles.basics import Array


def matched(parts: list[tuple[float, Array, Array]]) -> tuple[Array, Array]:
    """Mean and covariance of a mixture of (weight, mean, covariance)."""
    mean = sum((w * x for w, x, _ in parts), np.zeros_like(parts[0][1]))
    P = sum((w * (P + np.outer(x - mean, x - mean)) for w, x, P in parts), np.zeros_like(parts[0][2]))
    return mean, P
