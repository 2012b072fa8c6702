"""Points and weights, and what they say of a measurement.

Arasaratnam & Haykin (2009), IEEE TAC 54(6):1254-1269; Julier & Uhlmann (2004); Wang et al. (2021), eqs. (14)-(21).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from oracles.basics import Array, Model, difference, measurement_noise, present

Rule = tuple[Array, Array, Array]  # points (n,k) of the standard normal, weights (k,) of the mean, of the covariance


class Measured(NamedTuple):
    """Predicted measurement of the s elements that are not missing."""

    Pzz: Array  # (s,s), nominal R included
    Pxz: Array  # (n,s)
    e: Array  # (s,) innovation, angles wrapped
    H: Array  # (s,n) statistical regression


def third_degree(n: int) -> Rule:
    """Cubature points (n,2n), weights of the mean, weights of the covariance (Arasaratnam & Haykin 2009)."""
    weights = np.full(2 * n, 1 / (2 * n))
    return math.sqrt(n) * np.hstack([np.eye(n), -np.eye(n)]), weights, weights.copy()


def unscented(n: int, alpha: float = 1.0, beta: float = 0.0, kappa: float = 1.0) -> Rule:
    """Scaled unscented points (n,2n+1), centre first, weights of the mean, weights of the covariance."""
    spread = alpha**2 * (n + kappa)
    points = math.sqrt(spread) * np.hstack([np.zeros((n, 1)), np.eye(n), -np.eye(n)])
    mean = np.full(2 * n + 1, 1 / (2 * spread))
    mean[0] = (spread - n) / spread
    cov = mean.copy()
    cov[0] += 1 - alpha**2 + beta
    return points, mean, cov


def draw(mean: Array, P: Array, rule: Rule) -> Array:
    """Points (k,n) of a Gaussian, NaN where the covariance has no root (a branch that broke down)."""
    try:
        S = np.linalg.cholesky(P)
    except np.linalg.LinAlgError:
        S = np.full_like(P, np.nan)
    return np.array([mean + S @ rule[0][:, j] for j in range(rule[0].shape[1])])


def moments(values: Array, centre: Array, angles: Array, weights: Array) -> tuple[Array, Array]:
    """Mean (m,) of values (k,m) and deviations (k,m) from it; angles are averaged as offsets from a centre (m,)."""
    offsets = np.array([difference(value, centre, angles) for value in values]).reshape(len(values), -1)
    shift = weights @ offsets
    return centre + shift, offsets - shift


def measure(mean: Array, P: Array, z: Array, model: Model, k: int, rule: Rule) -> Measured:
    """Predicted measurement from fresh points, eqs. (14)-(21); z (m,), only elements that are not missing are kept."""
    seen = present(z)
    angles = np.asarray(model.angles, dtype=bool)[seen]
    points, wc = draw(mean, P, rule), np.diag(rule[2])
    values = np.array([model.h(x, k)[seen] for x in points])
    zhat, gaps = moments(values, model.h(mean, k)[seen], angles, rule[1])
    Pxz = (points - mean).T @ wc @ gaps
    Pzz = measurement_noise(model, k, seen) + gaps.T @ wc @ gaps
    return Measured(Pzz, Pxz, difference(np.asarray(z)[seen], zhat, angles), Pxz.T @ np.linalg.inv(P))
