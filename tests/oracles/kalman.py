"""The Kalman filter and its extension by linearisation; Wang et al. (2021), eqs. (8)-(13), (22)-(24), (35)."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from oracles.basics import Array, Model, Result, at, collect, difference, measurement_noise, present

Jacobian = Callable[[Array, int], Array]


def predict(mean: Array, P: Array, model: Model, k: int) -> tuple[Array, Array]:
    """Mean and covariance after the transition to step k, eqs. (8)-(13), which are exact for a linear model."""
    F, SQ = at(model.F, k), at(model.SQ, k)
    return F @ mean, F @ P @ F.T + SQ @ SQ.T


def update(mean: Array, P: Array, Pzz: Array, Pxz: Array, e: Array) -> tuple[Array, Array]:
    """Posterior mean and covariance P - W Pzz W^T, eqs. (22)-(24)."""
    W = Pxz @ np.linalg.inv(Pzz)
    P = P - W @ Pzz @ W.T
    return mean + W @ e, (P + P.T) / 2


def fit(e: Array, Pzz: Array) -> tuple[float, float]:
    """Normalised innovation squared, eq. (35), and Gaussian log density of an innovation."""
    if not np.isfinite(Pzz).all():
        return math.nan, math.nan
    nis = float(e @ np.linalg.inv(Pzz) @ e)
    return nis, -0.5 * (nis + float(np.linalg.slogdet(Pzz)[1]) + len(e) * math.log(2 * math.pi))


def numerical_jacobian(model: Model) -> Jacobian:
    """Central differences of h: a function of (x (n,), k) -> (m,n)."""

    def jacobian(x: Array, k: int) -> Array:
        columns = []
        for j in range(len(x)):
            d = np.zeros(len(x))
            d[j] = 6e-6 * max(1.0, abs(x[j]))
            columns.append(difference(model.h(x + d, k), model.h(x - d, k), model.angles) / (2 * d[j]))
        return np.array(columns).T

    return jacobian


def ekf(z: Array, mean0: Array, P0: Array, model: Model, jacobian: Jacobian | None = None) -> Result:
    """Extended Kalman filter, Jazwinski (1970); the Jacobian (m,n) of h is numerical unless there is one."""
    jacobian = jacobian or numerical_jacobian(model)
    mean, P, steps = np.array(mean0, dtype=float), np.array(P0, dtype=float), []
    for k in range(len(z)):
        mean, P = predict(mean, P, model, k)
        seen = present(z[k])
        H = jacobian(mean, k)[seen]
        e = difference(z[k][seen], model.h(mean, k)[seen], np.asarray(model.angles, dtype=bool)[seen])
        Pzz = H @ P @ H.T + measurement_noise(model, k, seen)
        mean, P = update(mean, P, Pzz, P @ H.T, e)
        nis, ll = fit(e, Pzz)
        ones = np.ones(len(z[k]))
        steps.append({"mean": mean, "P": P, "nis": nis, "log_likelihood": ll, "weights": ones, "fading": 1.0})
    return collect(steps)


def kalman(z: Array, mean0: Array, P0: Array, model: Model, H: Array | Callable[[int], Array]) -> Result:
    """Kalman filter with z = H x (m,n), or H(k); model.h is not used."""
    linear = model._replace(h=lambda x, k: at(H, k) @ x)
    return ekf(z, mean0, P0, linear, jacobian=lambda x, k: at(H, k))
