"""Smoothers: the least-squares solution of a whole track at once, and Rauch-Tung-Striebel in moment form.

Rauch, Tung & Striebel (1965), AIAA J. 3(8):1445-1450; Bell (1994), SIAM J. Optim. 4(3):626-636 for the iterated
solution; Arasaratnam & Haykin (2011), Automatica 47(10):2245-2250.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from oracles.basics import Array, Model, Result, at, difference, present
from oracles.cubature import Rule, draw
from oracles.kalman import numerical_jacobian


def whole_track(z: Array, mean0: Array, P0: Array, model: Model, iterations: int = 1) -> Result:
    """All states at once, as a function of the initial error and of every step's noise, of which all are N(0, I).

    Least squares in those: Gauss-Newton, of which one iteration is exact for a linear sensor. P0 and Q may be singular.
    """
    n, T = len(mean0), len(z)
    values, vectors = np.linalg.eigh(P0)
    unit = [vectors * np.sqrt(values.clip(0))] + [at(model.SQ, k) for k in range(T)]
    middle, rows, A = np.array(mean0, dtype=float), unit[0], []
    means = []
    for k in range(T):
        F = at(model.F, k)
        middle, rows = F @ middle, np.hstack([F @ rows, unit[k + 1]])
        means.append(middle)
        A.append(rows)
    size = A[-1].shape[1]
    A = [np.hstack([a, np.zeros((n, size - a.shape[1]))]) for a in A]
    jacobian, e = numerical_jacobian(model), np.zeros(size)
    for _ in range(iterations):
        blocks, gaps = [np.eye(size)], [-e]
        for k in range(T):
            x, seen = means[k] + A[k] @ e, present(z[k])
            root = np.linalg.inv(np.linalg.cholesky((at(model.SR, k) @ at(model.SR, k).T)[np.ix_(seen, seen)]))
            blocks.append(root @ jacobian(x, k)[seen] @ A[k])
            angles = np.asarray(model.angles, dtype=bool)[seen]
            gaps.append(root @ difference(z[k][seen], model.h(x, k)[seen], angles))
        J = np.vstack(blocks)
        e = e + np.linalg.lstsq(J, np.concatenate(gaps), rcond=None)[0]
    spread = np.linalg.inv(np.linalg.qr(J, mode="r"))
    mean = np.array([m + a @ e for m, a in zip(means, A, strict=True)])
    return {"mean": mean, "P": np.array([(a @ spread) @ (a @ spread).T for a in A])}


def smoother(mean: Array, P: Array, ahead: Callable[[Array, Array, int], tuple[Array, Array, Array]]) -> Result:
    """Rauch-Tung-Striebel from filtered mean (T,n) and P (T,n,n).

    ahead(mean, P, k) tells the predicted mean and covariance of step k from the belief before it, and the covariance
    (n,n) of the state before with the state after.
    """
    means, Ps = [mean[-1]], [P[-1]]
    for k in range(len(mean) - 1, 0, -1):
        predicted, Pp, C = ahead(mean[k - 1], P[k - 1], k)
        G = C @ np.linalg.pinv(Pp)
        means.append(mean[k - 1] + G @ (means[-1] - predicted))
        Ps.append(P[k - 1] + G @ (Ps[-1] - Pp) @ G.T)
    return {"mean": np.array(means[::-1]), "P": np.array(Ps[::-1])}


def through(f: Callable[[Array], Array], SQ: Array, rule: Rule, mean: Array, P: Array) -> tuple[Array, Array, Array]:
    """Predicted mean, covariance and cross-covariance of a motion that is not linear, by points."""
    points = draw(mean, P, rule)
    values = np.array([f(x) for x in points])
    predicted = rule[1] @ values
    gaps = values - predicted
    return predicted, gaps.T @ np.diag(rule[2]) @ gaps + SQ @ SQ.T, (points - mean).T @ np.diag(rule[2]) @ gaps
