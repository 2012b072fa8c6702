"""What one would use instead, on the job of scripts/benchmark.py: a process that times it for each line it reads.

    python scripts/peers.py jax job.npz --means last.npy

Prints a JSON line with the seconds of the first call, and one for each line on standard input.  Needs
``pip install 'torchfra[bench]'`` but neither torch nor torchfra.  The hand-written SRCKF in JAX is the array form that
torchfra uses, with the QR decomposition that JAX has.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from benchmarks.clock import once, one_pass

Run = Callable[[], np.ndarray]
SCALING = (1.0, 2.0, -3.0)
"""Of the unscented transform: alpha, beta, kappa with n + kappa = 3."""


class Job(NamedTuple):
    """Two bearings of a target from two moving stations, and a linear motion."""

    matrix: np.ndarray
    """``(n, n)`` transition of a step."""
    noise: np.ndarray
    """``(n, q)`` root of the process noise."""
    std: np.ndarray
    """``()`` of a bearing, rad."""
    means: np.ndarray
    """``(B, n)`` priors, one step before the first measurement."""
    root: np.ndarray
    """``(n, n)`` root of their covariance."""
    z: np.ndarray
    """``(B, T, 2)`` bearings, rad."""
    u: np.ndarray
    """``(T, 4)`` positions of the stations, m."""
    dt: np.ndarray
    """``()`` seconds per step."""


class Learning(NamedTuple):
    """A network in front of the filter, as that of ``benchmarks.layer``: it says standard deviations from features."""

    features: np.ndarray
    """``(B, T, k)``."""
    truth: np.ndarray
    """``(B, T, n)``."""
    rate: np.ndarray
    """``()`` of the descent."""
    weights: tuple[np.ndarray, ...]
    """Weight and bias of two layers."""


def jax_srckf(job: Job) -> Callable:
    """Hand-written for this job, to be under jit and vmap, a scan over time: from mean, ``z`` and std to all means."""
    import jax.numpy as jnp
    from jax import lax

    matrix, noise, _, _, root, _, u, _ = map(jnp.asarray, job)
    n, turn = len(matrix), 2 * math.pi
    unit = jnp.concatenate([jnp.eye(n), -jnp.eye(n)], 1)

    def tria(a):
        return jnp.linalg.qr(a.T, mode="r").T

    def wrap(angle):
        return angle - turn * jnp.round(angle / turn)

    def step(carry, at):
        (mean, root), (z, u, std) = carry, at
        mean, root = matrix @ mean, tria(jnp.concatenate([matrix @ root, noise], 1))
        points = mean[:, None] + math.sqrt(n) * root @ unit
        offset = points[None, :2] - u.reshape(2, 2)[:, :, None]
        bearing = jnp.arctan2(offset[:, 0], offset[:, 1])
        away = wrap(bearing - bearing[:, :1])
        centre = away.mean(1, keepdims=True)
        top = jnp.concatenate([(away - centre) / math.sqrt(2 * n), jnp.diag(std)], 1)
        joint = tria(jnp.concatenate([top, jnp.concatenate([root @ unit / math.sqrt(2), jnp.zeros((n, 2))], 1)], 0))
        residual = wrap(z - (bearing[:, :1] + centre)[:, 0])
        scaled = lax.linalg.triangular_solve(joint[:2, :2], residual[:, None], left_side=True, lower=True)[:, 0]
        mean = mean + joint[2:, :2] @ scaled
        return (mean, joint[2:, 2 : 2 + n]), mean

    return lambda mean, z, std: lax.scan(step, (mean, root), (z, u, std))[1]


def dynamax_ukf(job: Job) -> Callable:
    """The unscented Kalman filter of dynamax: from mean, ``z`` and std to all means."""
    import jax.numpy as jnp
    from dynamax.nonlinear_gaussian_ssm import ParamsNLGSSM, UKFHyperParams, unscented_kalman_filter

    matrix, noise, _, _, root, _, u, _ = map(jnp.asarray, job)
    q = noise @ noise.T

    def measure(x, u):
        offset = x[:2] - u.reshape(2, 2)
        return jnp.arctan2(offset[:, 0], offset[:, 1])

    def track(mean, z, std):
        covariance = matrix @ root @ root.T @ matrix.T + q  # it begins at the first measurement
        r = jnp.square(std)[:, :, None] * jnp.eye(2)
        model = ParamsNLGSSM(matrix @ mean, covariance, lambda x, u: matrix @ x, q, measure, r)
        return unscented_kalman_filter(model, z, UKFHyperParams(*SCALING), inputs=u).filtered_means

    return track


def last_means(track: Callable, job: Job) -> Run:
    """All tracks under jit and vmap: the last means ``(B, n)``."""
    import jax
    import jax.numpy as jnp

    means, z, std = jnp.asarray(job.means), jnp.asarray(job.z), jnp.full(job.z.shape[1:], job.std)
    compiled = jax.jit(jax.vmap(lambda mean, z: track(mean, z, std)[-1]))
    return lambda: np.asarray(compiled(means, z).block_until_ready())


def descent(track: Callable, job: Job, learning: Learning) -> Run:
    """A step of learning under jit: mean squared error of positions ``()``, gradient, descent of the weights."""
    import jax
    import jax.numpy as jnp

    means, z, std = jnp.asarray(job.means), jnp.asarray(job.z), job.std
    features, truth, rate = map(jnp.asarray, learning[:3])

    def error(weights):
        w1, b1, w2, b2 = weights
        said = std * jnp.exp(jnp.tanh(features @ w1.T + b1) @ w2.T + b2)
        return jnp.square((jax.vmap(track)(means, z, said) - truth)[..., :2]).mean()

    def learn(weights):
        value, slopes = jax.value_and_grad(error)(weights)
        return value, jax.tree.map(lambda w, slope: w - rate * slope, weights, slopes)

    weights, compiled = tuple(map(jnp.asarray, learning.weights)), jax.jit(learn)
    return lambda: np.asarray(jax.block_until_ready(compiled(weights))[0])


def in_jax(track: Callable[[Job], Callable], job: Job, learning: Learning | None) -> Run:
    """The job in double precision, or its learning."""
    import jax

    jax.config.update("jax_enable_x64", True)
    return last_means(track(job), job) if learning is None else descent(track(job), job, learning)


def filterpy_ukf(job: Job, learning: None) -> Run:
    """The unscented Kalman filter of FilterPy, one track after the other."""
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    matrix, noise, std, means, root, z, u, dt = job

    def measure(x, u):
        offset = x[:2] - u.reshape(2, 2)
        return np.arctan2(offset[:, 0], offset[:, 1])

    def run():
        ends = []
        for mean, track in zip(means, z, strict=True):
            points = MerweScaledSigmaPoints(len(matrix), *SCALING)
            f = UnscentedKalmanFilter(len(matrix), 2, float(dt), measure, lambda x, dt: matrix @ x, points)
            f.x, f.P, f.Q, f.R = mean.copy(), root @ root.T, noise @ noise.T, std**2 * np.eye(2)
            for z_k, u_k in zip(track, u, strict=True):
                f.predict()
                f.update(z_k, u=u_k)
            ends.append(f.x)
        return np.array(ends)

    return run


PEERS = {"jax": partial(in_jax, jax_srckf), "dynamax": partial(in_jax, dynamax_ukf), "filterpy": filterpy_ukf}


def main(arguments: list[str] | None = None) -> int:
    """Answers until standard input ends."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=PEERS)
    parser.add_argument("job", type=Path, metavar="JOB", help="arrays of the job (.npz), from scripts/benchmark.py")
    parser.add_argument("--means", type=Path, metavar="FILE", help="write the last means of the tracks (.npy)")
    options = parser.parse_args(arguments)
    with np.load(options.job) as arrays:
        given = dict(arrays)
    job, learning = Job(*(given.pop(name) for name in Job._fields)), None
    if given:
        first = Learning._fields[:-1]
        learning = Learning(*(given.pop(name) for name in first), tuple(given[key] for key in sorted(given)))
    try:
        run = PEERS[options.name](job, learning)
    except ImportError as missing:
        answer(missing=str(missing))
        return 0
    first = once(run)
    if options.means is not None:
        np.save(options.means, run())
    answer(first_call_s=first, **({} if learning is None else {"error": float(run())}))
    for _ in sys.stdin:
        answer(seconds=one_pass(run))
    return 0


def answer(**values: float | str) -> None:
    """One JSON line on standard output."""
    print(json.dumps(values), flush=True)


if __name__ == "__main__":
    sys.exit(main())
