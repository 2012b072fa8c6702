"""The probability that a mixture is farther from an estimate than a radius, from the density of lengths."""

from __future__ import annotations

import math

import numpy as np

from oracles.basics import Array


def beyond(radius: float, dims: int) -> float:
    """Probability that a standard normal vector is longer, from the density of its length by Gauss-Legendre's rule."""
    points, weights = np.polynomial.legendre.leggauss(200)
    r = radius + 20 * (points + 1)
    scale = {1: math.sqrt(2 / math.pi), 2: 1.0, 3: math.sqrt(2 / math.pi)}[dims]
    density = scale * r ** (dims - 1) * np.exp(-(r**2) / 2)
    return float(20 * weights @ density)


def of_mixture(
    radius: float, means: Array, covariances: Array, weights: Array, centre: Array, fault: tuple[float, float]
) -> float:
    """Bound on the probability that hypotheses (H,d), (H,d,d), (H,) are farther from an estimate (d,) than a radius."""
    total = 0.0
    for mean, covariance, weight in zip(means, covariances, weights, strict=True):
        for share, size in ((1 - fault[0], 0.0), (fault[0], fault[1])):
            std = math.sqrt(np.linalg.eigvalsh(covariance)[-1] + size**2)
            far = (radius - math.dist(mean, centre)) / std
            total += weight * share * (1.0 if far <= 0 else beyond(far, len(centre)))
    return total
