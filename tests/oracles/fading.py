"""Strong tracking by multiple fading factors; Wang et al. (2021), eqs. (29)-(34); Qiu et al. (2018)."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from oracles.basics import Array, Model, Result
from oracles.cubature import Rule, measure, third_degree
from oracles.kalman import update
from oracles.robust import Posterior, Prior, huber, inflated, run


class Fade(NamedTuple):
    """Options of the fading factors, eqs. (31)-(34)."""

    weakening: float = 2.0  # beta
    forgetting: float = 0.95  # rho
    rcond: float = 0.1  # singular values up to rcond times the largest are dropped in the pseudo-inverse
    fading_max: float = 1e3
    trace: str = "full"  # or "position"
    groups: tuple[tuple[int, int, float], ...] = ((0, 2, 1.0),)  # first state, one past the last, share of the excess


def no_memory(z: Array) -> Array:
    """The innovation memory (m,m) before the first step."""
    return np.full((z.shape[1], z.shape[1]), np.nan)


def remember(V: Array, v: Array, seen: list[int], forgetting: float) -> Array:
    """Innovation memory V (m,m) in units of the measurement noise, eq. (31), entry by entry; NaN = not met before."""
    V = V.copy()
    for a, i in enumerate(seen):
        for b, j in enumerate(seen):
            product = v[a] * v[b]
            V[i, j] = product if math.isnan(V[i, j]) else (forgetting * V[i, j] + product) / (1 + forgetting)
    return V


def fading_terms(p: Prior, V: Array, weights: Array, fade: Fade) -> tuple[float, float]:
    """tr N and tr J, eqs. (32)-(33), whitened by the measurement noise, diag(1 / weights) (s,) in units of itself."""
    H = np.linalg.inv(p.SR) @ p.at.H
    if not np.isfinite(H).all():
        return math.nan, math.nan
    G = np.linalg.pinv(H, rcond=fade.rcond)
    N = G @ (V[np.ix_(p.seen, p.seen)] - H @ p.Q @ H.T - fade.weakening * np.diag(1 / weights)) @ G.T
    size = 2 if fade.trace == "position" else len(p.J)
    return float(np.trace(N[:size, :size])), float(np.trace(p.J[:size, :size]))


def faded(p: Prior, V: Array, weights: Array, z: Array, model: Model, k: int, rule: Rule, fade: Fade) -> Posterior:
    """Fade the position covariance, eqs. (29) and (34), measure again and update with SR diag(1 / weights) SR^T."""
    trN, trJ = fading_terms(p, V, weights, fade)
    factor = min(max(1.0, trN / trJ), fade.fading_max) if math.isfinite(trN) else 1.0
    scales = np.ones(len(p.mean))
    for low, high, share in fade.groups:
        scales[low:high] = math.sqrt(1 + share * (factor - 1))
    L = np.diag(scales)
    P = L @ p.J @ L.T + p.Q
    at = measure(p.mean, P, z, model, k, rule)
    return *update(p.mean, P, inflated(at.Pzz, p.SR, weights), at.Pxz, at.e), weights, factor


def rmckf(z: Array, mean0: Array, P0: Array, model: Model, threshold: float = 1.345, **fade: Any) -> Result:
    """Huber weights, eqs. (25)-(26), then fading with the weighted noise, eqs. (29)-(34); options of `Fade`."""
    rule, options, V = third_degree(len(mean0)), Fade(**fade), no_memory(z)

    def act(p: Prior, k: int) -> Posterior:
        nonlocal V
        V = remember(V, p.v, p.seen, options.forgetting)
        return faded(p, V, huber(p.v, threshold), z[k], model, k, rule, options)

    return run(z, mean0, P0, model, rule, act)


def asrckf(z: Array, mean0: Array, P0: Array, model: Model, **fade: Any) -> Result:
    """Strong-tracking cubature filter, eqs. (29)-(34): weights 1 in `rmckf`; options of `Fade`."""
    return rmckf(z, mean0, P0, model, math.inf, **fade)
