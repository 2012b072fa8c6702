"""Smoothers: the least-squares solution of a whole track at once, and Rauch-Tung-Striebel in moment form.

Rauch, Tung & Striebel (1965), AIAA J. 3(8):1445-1450; Bell (1994), SIAM J. Optim. 4(3):626-636 for the iterated
solution; Arasaratnam & Haykin (2011), Automatica 47(10):2245-2250.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import pairwise, product

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


def every_history(z: Array, mean0: Array, P0: Array, models: list[Model], transition: Array, initial: Array) -> Result:
    """The exact smoothed mixture of linear models that switch: all histories, each as a track of its own.

    Rows of the transition say from which model; the first step's model is drawn by initial @ transition. Q singular or
    not; P0 not.
    """
    T, n, histories = len(z), len(mean0), list(product(range(len(models)), repeat=len(z)))
    logs, means, Ps = [], [], []
    for history in histories:
        log = np.log((initial @ transition)[history[0]]) + sum(np.log(transition[a, b]) for a, b in pairwise(history))
        middle, rows, A = np.array(mean0, dtype=float), np.linalg.cholesky(P0), []
        mean = []
        for k, model in enumerate(models[m] for m in history):
            middle, rows = at(model.F, k) @ middle, np.hstack([at(model.F, k) @ rows, at(model.SQ, k)])
            mean.append(middle)
            A.append(rows)
        A = np.vstack([np.hstack([a, np.zeros((n, A[-1].shape[1] - a.shape[1]))]) for a in A])
        seen = [k * n + i for k in range(T) for i in present(z[k])]
        R = block(at(models[m].SR, k)[np.ix_(present(z[k]), present(z[k]))] for k, m in enumerate(history))
        S, e = A[seen] @ A[seen].T + R @ R.T, z[~np.isnan(z)] - np.concatenate(mean)[seen]
        K = A @ A[seen].T @ np.linalg.inv(S)
        logs.append(log - 0.5 * e @ np.linalg.solve(S, e) - 0.5 * np.linalg.slogdet(S)[1])
        means.append((np.concatenate(mean) + K @ e).reshape(T, n))
        P = A @ A.T - K @ S @ K.T
        Ps.append([P[k * n : k * n + n, k * n : k * n + n] for k in range(T)])
    weights = np.exp(np.array(logs) - np.max(logs))
    weights /= weights.sum()
    mean = np.einsum("h,hti->ti", weights, means)
    gaps = np.array(means) - mean
    P = np.einsum("h,htij->tij", weights, np.array(Ps) + gaps[..., :, None] * gaps[..., None, :])
    which = np.array(histories)
    probabilities = np.array([[weights[which[:, k] == m].sum() for m in range(len(models))] for k in range(T)])
    return {"mean": mean, "P": P, "probabilities": probabilities}


def block(parts: Iterable[Array]) -> Array:
    """Matrices along a diagonal."""
    parts = list(parts)
    whole, at = np.zeros((sum(map(len, parts)),) * 2), 0
    for part in parts:
        whole[at : at + len(part), at : at + len(part)] = part
        at += len(part)
    return whole


def models_smoother(forth: Result, models: list[Model], transition: Array) -> Result:
    """Interacting models backwards, in information form, from the filter's means (T,K,n), Ps and weights (T,K).

    What later measurements say to model j after a step is the Gaussian quotient of its smoothed belief and its
    prediction, without the directions in which that is no density. It is multiplied with what every model i before
    predicts of the step by the motion of j, and weighs the models by the integral.
    """
    mean, P, weights = (np.array(forth[key][-1]) for key in ("means", "Ps", "weights"))
    K, out = len(models), [(mean, P, weights)]
    for k in range(len(forth["means"]) - 1, 0, -1):
        m, C, w = (forth[key][k - 1] for key in ("means", "Ps", "weights"))
        pair, each, spread = np.zeros((K, K)), np.zeros((K, K, len(m[0]))), np.zeros((K, K, *C[0].shape))
        for j in range(K):
            F, SQ = at(models[j].F, k), at(models[j].SQ, k)
            share = transition[:, j] * w
            share /= share.sum()
            middle = share @ m
            mixed = sum(share[i] * (C[i] + np.outer(m[i] - middle, m[i] - middle)) for i in range(K))
            L = np.linalg.cholesky(F @ mixed @ F.T + SQ @ SQ.T)
            inside = np.linalg.solve(L, np.linalg.solve(L, P[j]).T)
            value, basis = np.linalg.eigh((inside + inside.T) / 2)
            V = basis[:, value < 1 - 1e-8]
            value = value[value < 1 - 1e-8]
            rows = np.diag((1 / value - 1) ** 0.5) @ V.T @ np.linalg.inv(L)
            told = (1 / value - 1) ** -0.5 / value * (V.T @ np.linalg.solve(L, mean[j] - F @ middle))
            for i in range(K):
                H = rows @ F
                e, S = told - rows @ F @ (m[i] - middle), H @ C[i] @ H.T + rows @ SQ @ (rows @ SQ).T + np.eye(len(rows))
                G = C[i] @ H.T @ np.linalg.inv(S)
                each[i, j], spread[i, j] = m[i] + G @ e, C[i] - G @ S @ G.T
                pair[i, j] = share[i] * np.exp(-0.5 * e @ np.linalg.solve(S, e) - 0.5 * np.linalg.slogdet(S)[1])
            pair[:, j] *= weights[j] / pair[:, j].sum()
        weights = pair.sum(1)
        back = pair / weights[:, None]
        mean = np.einsum("ij,ijn->in", back, each)
        gaps = each - mean[:, None]
        P = np.einsum("ij,ijnm->inm", back, spread + gaps[..., :, None] * gaps[..., None, :])
        out.append((mean, P, weights))
    means, Ps, every = (np.array(x[::-1]) for x in zip(*out, strict=True))
    middle = np.einsum("tk,tkn->tn", every, means)
    gaps = means - middle[:, None]
    P = np.einsum("tk,tknm->tnm", every, Ps + gaps[..., :, None] * gaps[..., None, :])
    return {"mean": middle, "P": P, "probabilities": every}
