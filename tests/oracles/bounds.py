"""The posterior Cramer-Rao bound from the information of a whole trajectory; Van Trees (1968), Tichavsky (1998).

No recursion: the information matrix of all states, or of the start and all shocks, is written down and inverted whole.
"""

from __future__ import annotations

import numpy as np

from oracles.basics import Array


def whole_trajectory(P0: Array, F: Array, Q: Array, H: Array, R: Array) -> Array:
    """Bounds ``(T,n,n)`` of ``x_k = f(x_{k-1}) + w``, ``z_k = h(x_k) + v`` with Q that has an inverse.

    F ``(runs,T,n,n)`` and H ``(runs,T,m,n)`` are slopes at drawn truths, over which the information is averaged.
    """
    T, n = F.shape[1], F.shape[-1]
    Qi, Ri, bounds = np.linalg.inv(Q), np.linalg.inv(R), []
    for last in range(1, T + 1):
        J = np.zeros(((last + 1) * n, (last + 1) * n))
        J[:n, :n] = np.linalg.inv(P0)
        for k in range(last):
            old, new = slice(k * n, (k + 1) * n), slice((k + 1) * n, (k + 2) * n)
            J[old, old] += np.mean([f.T @ Qi @ f for f in F[:, k]], axis=0)
            J[old, new] -= np.mean(F[:, k], axis=0).T @ Qi
            J[new, old] -= Qi @ np.mean(F[:, k], axis=0)
            J[new, new] += Qi + np.mean([h.T @ Ri @ h for h in H[:, k]], axis=0)
        bounds.append(np.linalg.inv(J)[-n:, -n:])
    return np.array(bounds)


def from_shocks(P0: Array, F: Array, G: Array, H: Array, R: Array) -> Array:
    """Bounds ``(T,n,n)`` of a linear motion with noise ``G w`` of any rank: F (T,n,n), G (n,q), H (T,m,n)."""
    T, n, q, Ri, bounds = len(F), F.shape[-1], G.shape[1], np.linalg.inv(R), []
    root = np.linalg.cholesky(P0)
    for last in range(1, T + 1):
        J, D = np.eye(n + last * q), np.hstack([root, np.zeros((n, last * q))])
        for k in range(last):  # D is the slope of the state in (start, shocks)
            D = F[k] @ D
            D[:, n + k * q : n + (k + 1) * q] += G
            J += D.T @ H[k].T @ Ri @ H[k] @ D
        bounds.append(D @ np.linalg.inv(J) @ D.T)
    return np.array(bounds)


def mixture_information(weights: Array, factors: Array, size: int, draws: int, seed: int) -> float:
    """Mean squared score of a normal mixture by Monte Carlo: per element, relative to a normal of factor 1."""
    rng = np.random.default_rng(seed)
    c = rng.choice(factors, size=draws, p=weights)
    e = rng.standard_normal((draws, size)) * c[:, None]
    each = np.array(
        [w * s ** (-size) * np.exp(-0.5 * (e**2).sum(1) / s**2) for w, s in zip(weights, factors, strict=True)]
    )
    pull = (each / np.asarray(factors)[:, None] ** 2).sum(0) / each.sum(0)
    return float((pull**2 * (e**2).sum(1)).mean() / size)
