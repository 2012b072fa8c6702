"""Estimates of other libraries on the jobs of scripts/field.py: a process that times one for each line it reads.

    python scripts/peers_field.py FilterPy job.npz --means all.npy

Without torch, but for torch-kf.  A library joins with a function from a job to a call that gives all means.
"""

from __future__ import annotations

import runpy
import sys
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from peers import Run, serve

GATE = 0.999
"""Probability of a gate by which a user keeps outliers away."""


class Job(NamedTuple):
    """Targets in a plane, of which positions are measured, or what ``MODELS`` has in place of either."""

    matrices: np.ndarray
    """``(K, T, n, n)`` transition to each step by each of the models."""
    noises: np.ndarray
    """``(K, T, n, n)`` covariances of the process noise."""
    chain: np.ndarray
    """``(K, K)`` probabilities of the models from step to step."""
    sensor: np.ndarray
    """``(m, n)``."""
    r: np.ndarray
    """``(m, m)`` covariance of the measurement noise."""
    means: np.ndarray
    """``(B, n)`` priors, one step before the first measurement."""
    p: np.ndarray
    """``(n, n)`` their covariance."""
    z: np.ndarray
    """``(B, T, m)``; NaN is missing."""
    model: np.ndarray
    """No dimensions: ``""`` for linear models, or a name of ``MODELS``."""


def in_turn(track: Callable[[np.ndarray, np.ndarray], np.ndarray], job: Job) -> Run:
    """One track after the other, from mean ``(n,)`` and ``z (T, m)`` to all means ``(T, n)``."""
    return lambda: np.array([track(mean, z) for mean, z in zip(job.means, job.z, strict=True)])


def seen(job: Job, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The elements that are measured, with their rows of the sensor and of its covariance."""
    there = ~np.isnan(z)
    return z[there], job.sensor[there], job.r[np.ix_(there, there)]


def filterpy_kf(job: Job, gate: float = 1.0, smooth: bool = False) -> Run:
    """The Kalman filter of FilterPy; measurements out of a gate are left out, as its users do."""
    from filterpy.kalman import KalmanFilter
    from scipy.stats import chi2

    m, n = job.sensor.shape

    def track(mean: np.ndarray, z: np.ndarray) -> np.ndarray:
        f = KalmanFilter(n, m)
        f.x, f.P = mean[:, None].copy(), job.p
        kept = []
        for z_k, matrix, q in zip(z, job.matrices[0], job.noises[0], strict=True):
            f.predict(F=matrix, Q=q)
            there, rows, r = seen(job, z_k)
            if len(there):
                away = there - (rows @ f.x)[:, 0]
                far = away @ np.linalg.solve(rows @ f.P @ rows.T + r, away)
                if gate == 1.0 or far <= chi2.ppf(gate, len(there)):
                    f.update(there[:, None], R=r, H=rows)
            kept.append((f.x.copy(), f.P.copy()))
        means, covariances = map(np.array, zip(*kept, strict=True))
        if smooth:
            means = f.rts_smoother(means, covariances, [*job.matrices[0]], [*job.noises[0]])[0]
        return means[..., 0]

    return in_turn(track, job)


def filterpy_imm(job: Job, gate: float = 1.0) -> Run:
    """The interacting models of FilterPy."""
    from filterpy.kalman import IMMEstimator, KalmanFilter
    from scipy.stats import chi2

    m, n = job.sensor.shape
    limit = chi2.ppf(gate, m)

    def track(mean: np.ndarray, z: np.ndarray) -> np.ndarray:
        filters = []
        for matrices, noises in zip(job.matrices, job.noises, strict=True):
            f = KalmanFilter(n, m)
            f.x, f.P, f.F, f.Q, f.H, f.R = mean[:, None].copy(), job.p, matrices[0], noises[0], job.sensor, job.r
            filters.append(f)
        bank, kept = IMMEstimator(filters, [1 / len(filters)] * len(filters), job.chain), []
        for z_k in z:
            bank.predict()
            away = z_k - (job.sensor @ bank.x)[:, 0]
            if gate == 1.0 or away @ np.linalg.solve(job.sensor @ bank.P @ job.sensor.T + job.r, away) <= limit:
                bank.update(z_k[:, None])
                kept.append(bank.x[:, 0].copy())
            else:
                kept.append(bank.x_prior[:, 0].copy())
        return np.array(kept)

    return in_turn(track, job)


class Model(NamedTuple):
    """What is not linear in a job."""

    move: Callable[[np.ndarray, np.ndarray], np.ndarray] | None
    """From a state and the matrix of a step, here ``dt`` times one, to the next state; None for the matrix."""
    measure: Callable[[np.ndarray], np.ndarray] | None
    """From a state to a measurement; None for the matrix."""
    difference: Callable[[np.ndarray, np.ndarray], np.ndarray] = np.subtract
    """Of two measurements."""
    mean: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    """From measurements ``(points, m)`` and weights to their mean; None for the plain one."""


def lorenz(x: np.ndarray, dt: np.ndarray) -> np.ndarray:
    """Lorenz's attractor after ``dt``, by a Taylor series of five terms."""
    flow = np.array([[-10.0, 10.0, 0.0], [28.0, -1.0, -x[0]], [0.0, x[0], -8.0 / 3.0]]) * dt[0, 0]
    term, after = x, x
    for j in range(1, 6):
        term = flow @ term / j
        after = after + term
    return after


def turned(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The difference of ranges and bearings from +y clockwise, of bearings the short way round."""
    away = one - other
    away[1] = (away[1] + np.pi) % (2 * np.pi) - np.pi
    return away


def mean_direction(points: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The mean of ranges and bearings, of bearings that of their directions."""
    return np.array(
        [weights @ points[:, 0], np.arctan2(weights @ np.sin(points[:, 1]), weights @ np.cos(points[:, 1]))]
    )


MODELS = {
    "radar": Model(None, lambda x: np.array([np.hypot(x[0], x[1]), np.arctan2(x[0], x[1])]), turned, mean_direction),
    "lorenz": Model(lorenz, None),
}


def jacobian(function: Callable[[np.ndarray], np.ndarray], x: np.ndarray) -> np.ndarray:
    """Central differences, whose error is that of rounding."""
    steps = 1e-5 * np.maximum(1.0, np.abs(x))
    columns = [(function(x + step) - function(x - step)) / (2 * step.sum()) for step in np.diag(steps)]
    return np.array(columns).T


def filterpy_nonlinear(job: Job, kind: str) -> Run:
    """The unscented filter of FilterPy, with points as van der Merwe's or Julier's, or its extended filter."""
    from filterpy.kalman import ExtendedKalmanFilter, JulierSigmaPoints, MerweScaledSigmaPoints, UnscentedKalmanFilter

    m, n = job.sensor.shape
    model = MODELS[str(job.model)]

    def measure(x: np.ndarray) -> np.ndarray:
        return model.measure(x) if model.measure else job.sensor @ x

    def move(x: np.ndarray, dt: np.ndarray) -> np.ndarray:
        return model.move(x, dt) if model.move else dt @ x

    def extended(mean: np.ndarray, z: np.ndarray) -> np.ndarray:
        f, kept = ExtendedKalmanFilter(n, m), []
        f.x, f.P, f.R = mean.copy(), job.p, job.r
        for z_k, matrix, q in zip(z, job.matrices[0], job.noises[0], strict=True):
            slope = jacobian(partial(move, dt=matrix), f.x)
            f.x, f.P = move(f.x, matrix), slope @ f.P @ slope.T + q
            f.update(z_k, lambda x: jacobian(measure, x), measure, residual=model.difference)
            kept.append(f.x.copy())
        return np.array(kept)

    def unscented(mean: np.ndarray, z: np.ndarray) -> np.ndarray:
        points = JulierSigmaPoints(n, 3.0 - n) if kind == "Julier" else MerweScaledSigmaPoints(n, 0.1, 2.0, 3.0 - n)
        f = UnscentedKalmanFilter(n, m, 1.0, measure, None, points, z_mean_fn=model.mean, residual_z=model.difference)
        f.x, f.P, f.R, kept = mean.copy(), job.p.copy(), job.r, []
        for z_k, matrix, q in zip(z, job.matrices[0], job.noises[0], strict=True):
            f.Q = q
            f.predict(fx=lambda x, dt, matrix=matrix: move(x, matrix))
            f.update(z_k)
            kept.append(f.x.copy())
        return np.array(kept)

    return in_turn(extended if kind == "extended" else unscented, job)


def pykalman_kf(job: Job, smooth: bool = False) -> Run:
    """The Kalman filter of pykalman, for which a measurement is there or not."""
    from pykalman import KalmanFilter

    first, q = job.matrices[0, 0], job.noises[0]
    start = first @ job.p @ first.T + q[0]

    def track(mean: np.ndarray, z: np.ndarray) -> np.ndarray:
        f = KalmanFilter(job.matrices[0, 1:], job.sensor, q[1:], job.r, None, None, first @ mean, start)
        data = np.ma.masked_invalid(z)
        return np.asarray((f.smooth if smooth else f.filter)(data)[0])

    return in_turn(track, job)


def statsmodels_kf(job: Job, smooth: bool = False) -> Run:
    """The Kalman filter and smoother of statsmodels; an element may be missing."""
    from statsmodels.tsa.statespace.kalman_smoother import KalmanSmoother

    m, n = job.sensor.shape
    matrices, q = np.roll(job.matrices[0], -1, 0), np.roll(job.noises[0], -1, 0)  # theirs lead to the next step
    first = job.matrices[0, 0]

    def track(mean: np.ndarray, z: np.ndarray) -> np.ndarray:
        f = KalmanSmoother(m, n, n)
        f.bind(z.copy())
        f["design"], f["obs_cov"], f["selection"] = job.sensor, job.r, np.eye(n)
        f["transition"], f["state_cov"] = np.moveaxis(matrices, 0, -1).copy(), np.moveaxis(q, 0, -1).copy()
        f.initialize_known(first @ mean, first @ job.p @ first.T + job.noises[0, 0])
        return f.smooth().smoothed_state.T if smooth else f.filter().filtered_state.T

    return in_turn(track, job)


def simdkalman_kf(job: Job, smooth: bool = False) -> Run:
    """The Kalman filter and smoother of simdkalman, all tracks at once; times must be regular."""
    from simdkalman import KalmanFilter

    first, q = job.matrices[0, 0], job.noises[0, 0]
    f = KalmanFilter(first, q, job.sensor, job.r)
    start = (job.means @ first.T)[:, :, None], first @ job.p @ first.T + q

    def call() -> np.ndarray:
        done = f.compute(job.z, 0, *start, smoothed=smooth, filtered=not smooth, observations=False)
        return (done.smoothed if smooth else done.filtered).states.mean

    return call


def dynamax_smoother(job: Job) -> Run:
    """The smoother of dynamax, under jit and vmap."""
    import jax
    import jax.numpy as jnp
    from dynamax.linear_gaussian_ssm.inference import lgssm_smoother, make_lgssm_params

    matrix, q = job.matrices[0, 0], job.noises[0, 0]
    start = matrix @ job.p @ matrix.T + q

    def track(mean: Any, z: Any) -> Any:
        return lgssm_smoother(make_lgssm_params(matrix @ mean, start, matrix, q, job.sensor, job.r), z).smoothed_means

    means, z, compiled = jnp.asarray(job.means), jnp.asarray(job.z), jax.jit(jax.vmap(track))
    return lambda: np.asarray(compiled(means, z).block_until_ready())


def torch_kf_smoother(job: Job) -> Run:
    """The smoother of torch-kf, all tracks at once."""
    import torch
    from torch_kf import GaussianState, KalmanFilter

    tensor = torch.from_numpy
    f = KalmanFilter(tensor(job.matrices[0, 0]), tensor(job.sensor), tensor(job.noises[0, 0]), tensor(job.r))
    z = tensor(job.z).transpose(0, 1)[..., None].contiguous()
    start = GaussianState(tensor(job.means)[..., None], tensor(job.p).expand(len(job.z), -1, -1))

    def call() -> np.ndarray:
        filtered = f.filter(start, z, update_first=False, return_all=True)
        return f.rts_smooth(filtered).mean[..., 0].transpose(0, 1).numpy()

    return call


def statsmodels_level(job: Job) -> Run:
    """The local level of statsmodels: the largest log-likelihood of each series, after an exact diffuse start."""
    from statsmodels.tsa.statespace.structural import UnobservedComponents

    return lambda: np.array([UnobservedComponents(z[:, 0], "local level").fit(disp=0).llf for z in job.z])


def kalbee(job: Job, kind: str) -> Run:
    """A filter of kalbee; by ``"gate"`` its Kalman filter behind its detector of outliers."""
    import kalbee
    from scipy.stats import chi2

    limit = chi2.ppf(GATE, len(job.sensor))

    def made(mean: np.ndarray, k: int = 0) -> Any:
        kinds = {"vb": kalbee.VariationalBayesKalmanFilter, "adaptive": kalbee.AdaptiveKalmanFilter}
        model = job.matrices[k, 0], job.noises[k, 0], job.sensor, job.r
        return kinds.get(kind, kalbee.KalmanFilter)(mean[:, None].copy(), job.p.copy(), *model)

    def track(mean: np.ndarray, z: np.ndarray) -> np.ndarray:
        f, count, kept = made(mean), len(job.matrices), []
        if kind == "imm":
            filters = [made(mean, k) for k in range(count)]
            f = kalbee.InteractingMultipleModel(filters, job.chain, np.full(count, 1 / count))
        for z_k in z:
            f.predict()
            away = z_k - (job.sensor @ np.asarray(f.x).reshape(-1))
            spread = job.sensor @ np.asarray(f.P) @ job.sensor.T + job.r
            if kind != "gate" or away @ np.linalg.solve(spread, away) <= limit:
                f.update(z_k[:, None])
            kept.append(np.asarray(f.x).reshape(-1).copy())
        return np.array(kept)

    return in_turn(track, job)


PEERS: dict[str, Callable[[Job], Run]] = {
    "FilterPy": filterpy_kf,
    "FilterPy, gated": lambda job: filterpy_kf(job, GATE),
    "FilterPy, extended": lambda job: filterpy_nonlinear(job, "extended"),
    "FilterPy, unscented": lambda job: filterpy_nonlinear(job, "van der Merwe"),
    "FilterPy, unscented, Julier's points": lambda job: filterpy_nonlinear(job, "Julier"),
    "FilterPy, smoother": lambda job: filterpy_kf(job, smooth=True),
    "FilterPy, IMM": filterpy_imm,
    "FilterPy, IMM, gated": lambda job: filterpy_imm(job, GATE),
    "pykalman": pykalman_kf,
    "pykalman, smoother": lambda job: pykalman_kf(job, smooth=True),
    "statsmodels": statsmodels_kf,
    "statsmodels, smoother": lambda job: statsmodels_kf(job, smooth=True),
    "statsmodels, local level": statsmodels_level,
    "simdkalman": simdkalman_kf,
    "simdkalman, smoother": lambda job: simdkalman_kf(job, smooth=True),
    "dynamax, smoother": dynamax_smoother,
    "torch-kf, smoother": torch_kf_smoother,
    "kalbee, variational Bayes": lambda job: kalbee(job, "vb"),
    "kalbee, adaptive": lambda job: kalbee(job, "adaptive"),
    "kalbee, gated": lambda job: kalbee(job, "gate"),
    "kalbee, IMM": lambda job: kalbee(job, "imm"),
}


def peer(name: str, arrays: dict[str, np.ndarray]) -> Run:
    """The call of a library, or of ``peer`` in a file of this name, on the job that the arrays are of."""
    made = PEERS[name] if name in PEERS else runpy.run_path(name)["peer"]
    run: Run = made(Job(**arrays))
    return run


if __name__ == "__main__":
    sys.exit(serve(__doc__, [*PEERS, *(word for word in sys.argv[1:2] if word.endswith(".py"))], peer))
