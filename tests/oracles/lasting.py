"""A target among time-correlated errors, by one large Gaussian: all states, errors and measurements of a track at once.

The covariance of errors at two times is std^2 exp(-|t - t'| / time), as Brown & Hwang (2012), section 3.6, have it; no
state holds them.  Rasmussen & Williams (2006), eqs. (2.23)-(2.24) and (2.30), for a Gaussian given measurements.
"""

from __future__ import annotations

import math

import numpy as np

from oracles.basics import Array, Result


def lasting_errors(
    z: Array, mean: Array, P: Array, F: list[Array], Q: list[Array], H: Array, R: Array, dt: Array, std: Array,
    time: Array,
) -> Result:  # fmt: skip
    """One track z (T,m), NaN missing; F and Q lead to each step, std and time (m,) are of the errors of each element.

    Keys: mean (T,n), P (T,n,n), by the measurements up to each step; smoothed_mean, smoothed_P by all of them;
    log_likelihood, of all of them; bias and smoothed_bias (T,n,m), how means follow a constant in each element.
    """
    steps, n = len(z), len(mean)
    means, within = [], []
    for k in range(steps):
        mean, P = F[k] @ mean, F[k] @ P @ F[k].T + Q[k]
        means.append(mean)
        within.append(P)
    states = np.zeros((steps, n, steps, n))
    for i in range(steps):
        across = within[i]
        for j in range(i, steps):
            across = across if j == i else across @ F[j].T
            states[i, :, j], states[j, :, i] = across, across.T
    when = np.cumsum(dt)
    readings, expected = [], []
    covariance = np.einsum("ai,kilj,bj->kalb", H, states, H)
    for k in range(steps):
        covariance[k, :, k] += R
        for j in range(steps):
            covariance[k, :, j] += np.diag(std**2 * np.exp(-np.abs(when[k] - when[j]) / time))
        for a in range(len(H)):
            if not math.isnan(z[k, a]):
                readings.append((k, a))
                expected.append(H[a] @ means[k])
    rows = tuple(np.array(readings).T)
    off = z[rows] - np.array(expected)
    V = np.array([[covariance[k, a, j, b] for j, b in readings] for k, a in readings])
    C = np.einsum("kilj,bj->kilb", states, H)[:, :, rows[0], rows[1]]  # (T,n,M): states and measurements
    result: Result = {"smoothed_mean": np.zeros((steps, n)), "smoothed_P": np.zeros((steps, n, n))}
    result |= {"bias": np.zeros((steps, n, len(H))), "smoothed_bias": np.zeros((steps, n, len(H)))}
    result |= {"mean": np.zeros((steps, n)), "P": np.zeros((steps, n, n))}
    for k in range(steps):
        for prefix, known in (("", rows[0] <= k), ("smoothed_", rows[0] >= 0)):
            gain = np.linalg.solve(V[np.ix_(known, known)], C[k][:, known].T).T
            result[prefix + "mean"][k] = means[k] + gain @ off[known]
            result[prefix + "bias"][k] = gain @ np.eye(len(H))[rows[1][known]]
            result[prefix + "P"][k] = within[k] - gain @ C[k][:, known].T
    _, size = np.linalg.slogdet(V)
    result["log_likelihood"] = np.array(
        -0.5 * (off @ np.linalg.solve(V, off) + size + len(off) * math.log(2 * math.pi))
    )
    return result
