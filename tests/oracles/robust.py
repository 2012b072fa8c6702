"""Cubature filters that down-weight outlying innovations; Wang et al. (2021), eqs. (7)-(28); IGG-III: Wu et al. (2015).

The step of every cubature filter of Wang et al. is here: `compare` predicts and compares with the measurement,
`weighted` updates, `run` goes through the steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from oracles.basics import Array, Model, Result, at, collect, measurement_noise, present
from oracles.cubature import Measured, Rule, measure, third_degree, unscented
from oracles.kalman import fit, predict, update

Posterior = tuple[Array, Array, Array, float]  # mean, P, weights of the elements not missing, fading factor


class Prior(NamedTuple):
    """Unfaded prediction of one step, compared with its measurement."""

    mean: Array  # (n,)
    P: Array  # (n,n) = J + Q
    J: Array  # (n,n) = F P F^T
    Q: Array  # (n,n)
    seen: list[int]  # the s elements that are not missing
    SR: Array  # (s,s) root of the measurement noise of these
    at: Measured
    v: Array  # (s,) = SR^-1 e
    nis: float
    log_likelihood: float


def compare(mean: Array, P: Array, z: Array, model: Model, k: int, rule: Rule) -> Prior:
    """Predict to step k and compare with z (m,)."""
    F, SQ = at(model.F, k), at(model.SQ, k)
    J, Q, seen = F @ P @ F.T, SQ @ SQ.T, present(z)
    mean, P = predict(mean, P, model, k)
    measured = measure(mean, P, z, model, k, rule)
    SR = np.linalg.cholesky(measurement_noise(model, k, seen))
    return Prior(mean, P, J, Q, seen, SR, measured, np.linalg.inv(SR) @ measured.e, *fit(measured.e, measured.Pzz))


def inflated(Pzz: Array, SR: Array, weights: Array) -> Array:
    """Pzz with R = SR SR^T replaced by SR diag(1 / weights) SR^T, eqs. (27)-(28)."""
    return np.asarray(Pzz + SR @ np.diag(1 / weights - 1) @ SR.T)


def weighted(p: Prior, weights: Array) -> Posterior:
    """Update of the unfaded prediction with weights (s,)."""
    return *update(p.mean, p.P, inflated(p.at.Pzz, p.SR, weights), p.at.Pxz, p.at.e), weights, 1.0


def unweighted(p: Prior) -> Posterior:
    """The plain update."""
    return weighted(p, np.ones(len(p.seen)))


def step(p: Prior, posterior: Posterior, m: int) -> dict[str, Any]:
    """One step of a result."""
    mean, P, seen_weights, fading = posterior
    weights = np.ones(m)
    weights[p.seen] = seen_weights
    shared: dict[str, Any] = {"nis": p.nis, "log_likelihood": p.log_likelihood}
    return shared | {"mean": mean, "P": P, "weights": weights, "fading": fading}


def run(z: Array, mean0: Array, P0: Array, model: Model, rule: Rule, act: Callable[[Prior, int], Posterior]) -> Result:
    """Filter with one hypothesis; act(prior, k) is its update."""
    mean, P, steps = np.array(mean0, dtype=float), np.array(P0, dtype=float), []
    for k in range(len(z)):
        p = compare(mean, P, z[k], model, k, rule)
        posterior = act(p, k)
        mean, P = posterior[:2]
        steps.append(step(p, posterior, z.shape[1]))
    return collect(steps)


def srckf(z: Array, mean0: Array, P0: Array, model: Model) -> Result:
    """Cubature Kalman filter, eqs. (7)-(24)."""
    return run(z, mean0, P0, model, third_degree(len(mean0)), lambda p, k: unweighted(p))


def ukf(
    z: Array, mean0: Array, P0: Array, model: Model, alpha: float = 1.0, beta: float = 0.0, kappa: float = 1.0
) -> Result:
    """Unscented Kalman filter, fresh points for the measurement."""
    return run(z, mean0, P0, model, unscented(len(mean0), alpha, beta, kappa), lambda p, k: unweighted(p))


def huber(v: Array, threshold: float | Array) -> Array:
    """Weights min(1, threshold / |v|), eqs. (25)-(26); one threshold, or one for each of v."""
    pairs = zip(v, np.broadcast_to(threshold, v.shape), strict=True)
    return np.array([1.0 if abs(a) < c else c / abs(a) for a, c in pairs])


def rsrckf(z: Array, mean0: Array, P0: Array, model: Model, threshold: float = 1.345) -> Result:
    """Huber-weighted cubature filter, eqs. (25)-(26)."""
    return run(z, mean0, P0, model, third_degree(len(mean0)), lambda p, k: weighted(p, huber(p.v, threshold)))


def igg(tau: float, low: float, high: float, variant: str = "distance") -> float:
    """Three-segment weight on d = sqrt(tau), or on tau itself (variant "tau"); thresholds on d^2."""
    d, near, far = (tau, low, high) if variant == "tau" else (math.sqrt(tau), math.sqrt(low), math.sqrt(high))
    if d <= near:
        return 1.0
    return near / d * ((far - d) / (far - near)) ** 2 if d < far else 0.0


def mr_ckf(
    z: Array, mean0: Array, P0: Array, model: Model, low: float = 5.991, high: float = 1e4, variant: str = "distance"
) -> Result:
    """Cubature filter with one IGG-III weight per step, R / w; w = 0 skips the update."""

    def act(p: Prior, k: int) -> Posterior:
        weights = np.full(len(p.seen), igg(p.nis, low, high, variant))
        return weighted(p, weights) if weights.all() else (p.mean, p.P, weights, 1.0)

    return run(z, mean0, P0, model, third_degree(len(mean0)), act)
