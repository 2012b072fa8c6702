"""Huber filters on an innovation of a linear model; Qin et al. (2018), eqs. (53)-(59); Zhang et al. (2016)."""

from __future__ import annotations

import math

import numpy as np

from oracles.basics import Array
from oracles.robust import huber


def huber_score(
    P: Array, H: Array, R: Array, s: Array, threshold: float, eps: float, cov_mode: str
) -> tuple[Array, Array]:
    """Mean and covariance after an innovation s (m,), Qin et al. (2018), eqs. (53)-(59), from mean 0."""
    Pzz, Pxz = H @ P @ H.T + R, P @ H.T
    L = np.linalg.cholesky(Pzz)
    eta = np.linalg.inv(L) @ s
    theta = np.diag(huber(eta, threshold))
    W = Pxz @ np.linalg.inv(L).T
    if cov_mode == "indicator":
        lost = np.diag([1.0 if abs(e) < threshold else 0.0 for e in eta])
    else:
        lost = (1 - eps) * math.erf(threshold / math.sqrt(2)) * np.eye(len(s))
    return W @ theta @ eta, P - W @ lost @ W.T


def huber_regression(P: Array, H: Array, R: Array, s: Array, threshold: float, iterations: int) -> tuple[Array, Array]:
    """Mean and covariance by iteratively reweighted regression on measurement and prediction, from mean 0."""
    m, n = H.shape
    T = np.zeros((m + n, m + n))
    T[:m, :m], T[m:, m:] = np.linalg.cholesky(R), np.linalg.cholesky(P)
    y = np.linalg.inv(T) @ np.concatenate([s, np.zeros(n)])
    M = np.linalg.inv(T) @ np.concatenate([H, np.eye(n)])
    delta = P @ H.T @ np.linalg.inv(H @ P @ H.T + R) @ s
    for _ in range(iterations):
        psi = np.diag(huber(M @ delta - y, threshold))
        delta = np.linalg.inv(M.T @ psi @ M) @ M.T @ psi @ y
    return delta, np.linalg.inv(M.T @ np.diag(huber(M @ delta - y, threshold)) @ M)
