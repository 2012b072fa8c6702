"""What one would pick instead, on the job of scripts/benchmark.py: each is a function from tracks to final means.

Needs ``pip install 'torchfra[bench]'``.  The hand-written SRCKF in JAX is the array form that torchfra uses, with the
QR decomposition that JAX has; the C++ one is limit.cpp, and needs g++.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from torchfra.scenarios import Scenario, Tracks

Run = Callable[[], np.ndarray]
SCALING = (1.0, 2.0, -3.0)
"""Of the unscented transform: alpha, beta, kappa with n + kappa = 3."""


def _arrays(scenario: Scenario, tracks: Tracks) -> tuple[np.ndarray, ...]:
    import torch

    dt = torch.tensor(scenario.dt, dtype=torch.float64)
    matrix, noise = scenario.motion.transition(dt), scenario.motion.process_noise(dt)
    std = scenario.sensor.std()
    return tuple(x.detach().numpy() for x in (matrix, noise, std, *tracks.prior, tracks.z, tracks.u))


def jax_srckf(scenario: Scenario, tracks: Tracks) -> Run:
    """Hand-written for this job: jit, vmap over tracks, scan over time."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jax.numpy as jnp
    from jax import lax

    matrix, noise, std, means, root, z, u = map(jnp.asarray, _arrays(scenario, tracks))
    n, turn = len(matrix), 2 * math.pi
    unit = jnp.concatenate([jnp.eye(n), -jnp.eye(n)], 1)

    def tria(a):
        return jnp.linalg.qr(a.T, mode="r").T

    def wrap(angle):
        return angle - turn * jnp.round(angle / turn)

    def step(carry, given):
        (mean, root), (z, u) = carry, given
        mean, root = matrix @ mean, tria(jnp.concatenate([matrix @ root, noise], 1))
        points = mean[:, None] + math.sqrt(n) * root @ unit
        offset = points[None, :2] - u.reshape(2, 2)[:, :, None]
        bearing = jnp.arctan2(offset[:, 0], offset[:, 1])
        away = wrap(bearing - bearing[:, :1])
        centre = away.mean(1, keepdims=True)
        top = jnp.concatenate([(away - centre) / math.sqrt(2 * n), std * jnp.eye(2)], 1)
        joint = tria(jnp.concatenate([top, jnp.concatenate([root @ unit / math.sqrt(2), jnp.zeros((n, 2))], 1)], 0))
        residual = wrap(z - (bearing[:, :1] + centre)[:, 0])
        scaled = lax.linalg.triangular_solve(joint[:2, :2], residual[:, None], left_side=True, lower=True)[:, 0]
        return (mean + joint[2:, :2] @ scaled, joint[2:, 2 : 2 + n]), None

    def track(mean, z):
        return lax.scan(step, (mean, root), (z, u))[0][0]

    compiled = jax.jit(jax.vmap(track))
    return lambda: np.asarray(compiled(means, z).block_until_ready())


def dynamax_ukf(scenario: Scenario, tracks: Tracks) -> Run:
    """Its unscented Kalman filter, under jit and vmap."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jax.numpy as jnp
    from dynamax.nonlinear_gaussian_ssm import ParamsNLGSSM, UKFHyperParams, unscented_kalman_filter

    matrix, noise, std, means, root, z, u = map(jnp.asarray, _arrays(scenario, tracks))
    q, r = noise @ noise.T, std**2 * jnp.eye(2)

    def measure(x, u):
        offset = x[:2] - u.reshape(2, 2)
        return jnp.arctan2(offset[:, 0], offset[:, 1])

    def track(mean, z):
        covariance = matrix @ root @ root.T @ matrix.T + q  # it begins at the first measurement
        model = ParamsNLGSSM(matrix @ mean, covariance, lambda x, u: matrix @ x, q, measure, r)
        return unscented_kalman_filter(model, z, UKFHyperParams(*SCALING), inputs=u).filtered_means[-1]

    compiled = jax.jit(jax.vmap(track))
    return lambda: np.asarray(compiled(means, z).block_until_ready())


def filterpy_ukf(scenario: Scenario, tracks: Tracks) -> Run:
    """Its unscented Kalman filter, one track after the other."""
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    matrix, noise, std, means, root, z, u = _arrays(scenario, tracks)

    def measure(x, u):
        offset = x[:2] - u.reshape(2, 2)
        return np.arctan2(offset[:, 0], offset[:, 1])

    def run():
        ends = []
        for mean, track in zip(means, z, strict=True):
            points = MerweScaledSigmaPoints(len(matrix), *SCALING)
            f = UnscentedKalmanFilter(len(matrix), 2, scenario.dt, measure, lambda x, dt: matrix @ x, points)
            f.x, f.P, f.Q, f.R = mean.copy(), root @ root.T, noise @ noise.T, std**2 * np.eye(2)
            for z_k, u_k in zip(track, u, strict=True):
                f.predict()
                f.update(z_k, u=u_k)
            ends.append(f.x)
        return np.array(ends)

    return run


PEERS = {"JAX, hand-written SRCKF": jax_srckf, "dynamax UKF": dynamax_ukf, "FilterPy UKF": filterpy_ukf}
"""By name; the last is for a few tracks only."""


def limit(batch: int) -> float | None:
    """Microseconds per track and step of hand-written SIMD C++; None without g++."""
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "limit"
        command = [os.environ.get("CXX", "g++"), "-O3", "-march=native", "-ffast-math", "-fopenmp"]
        try:
            source = Path(__file__).with_name("limit.cpp")
            subprocess.run([*command, str(source), "-o", str(program)], check=True, capture_output=True)
        except (OSError, subprocess.CalledProcessError):
            return None
        done = subprocess.run([str(program), str(batch)], check=True, capture_output=True, text=True)
        return float(json.loads(done.stdout)["us_per_track_step"])
