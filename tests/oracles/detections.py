"""Detections of one scan that are linked, by plain loops: single linkage and the moments of a mixture."""

from __future__ import annotations

import math

import numpy as np

from oracles.basics import Array


def linked(z: Array, R: list[Array], metres: float) -> list[tuple[int, Array, Array]]:
    """Of positions z (J, 2) with covariances R: first member, mean and covariance of each chain of near ones."""
    left, found = list(range(len(z))), []
    while left:
        chain, edge = [], [left[0]]
        while edge:
            i = edge.pop()
            if i in left:
                left.remove(i)
                chain.append(i)
                edge += [j for j in left if math.dist(z[i], z[j]) <= metres]
        mean = sum(z[i] for i in chain) / len(chain)
        covariance = sum(R[i] + np.outer(z[i] - mean, z[i] - mean) for i in chain) / len(chain)
        found.append((min(chain), mean, covariance))
    return found
