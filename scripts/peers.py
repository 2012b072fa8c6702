"""What one would use instead, on the jobs of scripts/benchmark.py: a process that times it for each line it reads.

    python scripts/peers.py jax job.npz --means last.npy

Prints a JSON line with the seconds of the first call, and one for each line on standard input.  Needs
``pip install 'torchfra[bench]'`` but not torchfra, and torch for torch-kf alone.  The hand-written SRCKF in JAX is the
array form that torchfra uses, with the QR decomposition that JAX has.
"""

from __future__ import annotations

import argparse
import datetime
import json
import math
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from benchmarks.clock import once, one_pass

Run = Callable[[], np.ndarray]
SCALING = (1.0, 0.0, 0.0)
"""Of the unscented transform: alpha, beta, kappa whose points and weights are those of the cubature rule."""
START = datetime.datetime(2000, 1, 1)


class Job(NamedTuple):
    """Targets of a linear motion; two moving stations measure their bearings, or a sensor elements of their state."""

    matrix: np.ndarray
    """``(n, n)`` transition of a step."""
    noise: np.ndarray
    """``(n, q)`` root of the process noise."""
    std: np.ndarray
    """``()`` of a bearing, rad, or ``(m,)`` of the elements."""
    means: np.ndarray
    """``(B, n)`` priors, one step before the first measurement."""
    root: np.ndarray
    """``(n, n)`` root of their covariance."""
    z: np.ndarray
    """``(B, T, m)`` bearings, rad, or elements."""
    dt: np.ndarray
    """``()`` seconds per step."""
    u: Any = None
    """``(T, 4)`` positions of the stations, m; None without them."""
    sensor: Any = None
    """``(m, n)`` which elements are measured; None for bearings."""


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


def covariances(job: Job) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the process noise of a step, of a measurement and of the prior."""
    r = np.square(job.std) * np.eye(job.z.shape[-1])
    return job.noise @ job.noise.T, r, job.root @ job.root.T


def predicted(job: Job) -> tuple[np.ndarray, np.ndarray]:
    """Means ``(B, n)`` and covariance before the first measurement, for those that begin with an update."""
    q, _, p = covariances(job)
    return job.means @ job.matrix.T, job.matrix @ p @ job.matrix.T + q


def bearings(x: Any, u: Any, numbers: Any = np) -> Any:
    """``(2,)`` of the state ``x (n,)`` from stations at ``u (4,)``, in numpy or ``jax.numpy``."""
    offset = x[:2] - u.reshape(2, 2)
    return numbers.arctan2(offset[:, 0], offset[:, 1])


def in_turn(track: Callable[[np.ndarray, np.ndarray], np.ndarray], job: Job) -> Run:
    """One track after the other, from mean ``(n,)`` and ``z (T, m)`` to the last mean."""
    return lambda: np.array([track(mean, z) for mean, z in zip(job.means, job.z, strict=True)])


def jax_srckf(job: Job) -> Callable:
    """Hand-written for this job, to be under jit and vmap, a scan over time: from mean, ``z`` and std to all means."""
    import jax.numpy as jnp
    from jax import lax

    matrix, noise, root, u = map(jnp.asarray, (job.matrix, job.noise, job.root, job.u))
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

    matrix, u, q = map(jnp.asarray, (job.matrix, job.u, covariances(job)[0]))
    start = jnp.asarray(predicted(job)[1])  # it begins at the first measurement

    def track(mean, z, std):
        r = jnp.square(std)[:, :, None] * jnp.eye(2)
        model = ParamsNLGSSM(matrix @ mean, start, lambda x, u: matrix @ x, q, lambda x, u: bearings(x, u, jnp), r)
        return unscented_kalman_filter(model, z, UKFHyperParams(*SCALING), inputs=u).filtered_means

    return track


def cuthbert_ckf(job: Job) -> Callable:
    """A cubature Kalman filter out of the parts of cuthbertlib: from mean, ``z`` and std to all means."""
    import jax.numpy as jnp
    from cuthbertlib.kalman.filtering import predict, update
    from cuthbertlib.quadrature.cubature import weights
    from cuthbertlib.quadrature.linearize import functional
    from jax import lax

    matrix, noise, root, u = map(jnp.asarray, (job.matrix, job.noise, job.root, job.u))
    n = len(matrix)
    rule = weights(n)

    def step(belief, at):
        z, u, std = at
        mean, root = predict(*belief, matrix, jnp.zeros(n), noise)
        linear = functional(lambda x: bearings(x, u, jnp), jnp.diag(std), mean, root, rule, mode="sqrt")
        belief = update(mean, root, *linear, z)[0]
        return belief, belief[0]

    return lambda mean, z, std: lax.scan(step, (mean, root), (z, u, std))[1]


def filterpy_ukf(job: Job) -> Run:
    """The unscented Kalman filter of FilterPy."""
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    n, (q, r, p) = len(job.matrix), covariances(job)

    def track(mean, z):
        points = MerweScaledSigmaPoints(n, *SCALING)
        f = UnscentedKalmanFilter(n, 2, float(job.dt), bearings, lambda x, dt: job.matrix @ x, points)
        f.x, f.P, f.Q, f.R = mean.copy(), p, q, r
        for z_k, u_k in zip(z, job.u, strict=True):
            f.predict()
            f.update(z_k, u=u_k)
        return f.x

    return in_turn(track, job)


def kalman_py_ukf(job: Job) -> Run:
    """The unscented Kalman filter of kalman-py on JAX.

    Its measurement function knows the state alone, so positions are those from the first station, and the other must
    stay where it is from there.
    """
    import jax.numpy as jnp
    from kalman_py import UnscentedKalmanFilter

    (q, r, p), n = covariances(job), len(job.matrix)
    first = np.pad(job.u[:, :2], ((1, 0), (0, n - 2)))
    first[0] = first[1]
    fixed, shifts, matrix = jnp.asarray(job.u[0] - np.tile(job.u[0, :2], 2)), jnp.diff(first, axis=0), job.matrix
    if not np.allclose(job.u - np.tile(job.u[:, :2], 2), fixed):
        raise ValueError("u: expected stations that stay at one distance from each other")

    def move(x, k):  # what is called the length of a step may be its number
        return matrix @ x - shifts[k.astype(int)]

    def measure(x):
        return bearings(x, fixed, jnp)

    alpha, beta, kappa = SCALING

    def track(mean, z):
        f = UnscentedKalmanFilter(move, measure, q, r, mean - first[0], p, alpha=alpha, beta=beta, kappa=kappa)
        return np.asarray(f.filter(z, np.arange(len(z)), backend="jax").means)[-1] + first[-1]

    return in_turn(track, job)


def pykalman_ukf(job: Job) -> Run:
    """The unscented Kalman filter of pykalman, whose n + kappa is always 3."""
    from pykalman import AdditiveUnscentedKalmanFilter

    (q, r, _), (means, p) = covariances(job), predicted(job)
    measure = np.array([[lambda x, u=u: bearings(x, u)] for u in job.u])  # a row for each step, else it takes the first

    def track(mean, z):
        f = AdditiveUnscentedKalmanFilter([lambda x: job.matrix @ x], measure, q, r, mean, p)
        return np.asarray(f.filter(z)[0])[-1]

    return in_turn(track, job._replace(means=means))


def stone_soup_ckf(job: Job) -> Run:
    """The cubature Kalman filter of Stone Soup."""
    from stonesoup.models.measurement.nonlinear import (
        Cartesian2DToBearing,
        CombinedReversibleGaussianMeasurementModel,
    )
    from stonesoup.predictor.kalman import CubatureKalmanPredictor
    from stonesoup.types.angle import Bearing
    from stonesoup.updater.kalman import CubatureKalmanUpdater

    def sensor(place):  # its bearings are from the first axis, ours from the second
        return Cartesian2DToBearing(
            len(job.matrix), (1, 0), noise_covar=np.array([[job.std**2]]), translation_offset=place[::-1, None]
        )

    sensors = [CombinedReversibleGaussianMeasurementModel([*map(sensor, u.reshape(2, 2))]) for u in job.u]
    return in_stone_soup(job, CubatureKalmanPredictor, CubatureKalmanUpdater(None), sensors, Bearing)


def in_stone_soup(job: Job, predictor: Any, updater: Any, sensors: Sequence[Any], number: Any) -> Run:
    """Predictions and updates of Stone Soup, with the sensor of each step and the kind of number that it measures."""
    from stonesoup.models.transition.linear import LinearGaussianTimeInvariantTransitionModel
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import GaussianState

    q, _, p = covariances(job)
    predict = predictor(
        LinearGaussianTimeInvariantTransitionModel(transition_matrix=job.matrix, covariance_matrix=q)
    ).predict
    times = [START + datetime.timedelta(seconds=k * float(job.dt)) for k in range(len(sensors) + 1)]

    def track(mean, z):
        state = GaussianState(mean[:, None], p, timestamp=START)
        for z_k, sensor, at in zip(z, sensors, times[1:], strict=True):
            vector = np.array([[number(x)] for x in z_k])
            seen = Detection(vector, timestamp=at, measurement_model=sensor)
            state = updater.update(SingleHypothesis(predict(state, timestamp=at), seen))
        return np.asarray(state.mean, dtype=float).ravel()

    return in_turn(track, job)


def dynamax_kf(job: Job) -> Callable:
    """The Kalman filter of dynamax: from mean, root and ``z`` to all means."""
    from dynamax.linear_gaussian_ssm.inference import lgssm_filter, make_lgssm_params

    (q, r, _), matrix = covariances(job), job.matrix

    def track(mean, root, z):  # it begins at the first measurement
        start = matrix @ mean, matrix @ root @ root.T @ matrix.T + q
        return lgssm_filter(make_lgssm_params(*start, matrix, q, job.sensor, r), z).filtered_means

    return track


def cuthbert_kf(job: Job) -> Callable:
    """The Kalman filter of cuthbert, one step after the other: from mean, root and ``z`` to all means."""
    import cuthbert
    import jax.numpy as jnp
    from cuthbert.gaussian.kalman import build_filter

    m, n = job.sensor.shape
    noise = np.pad(job.noise, ((0, 0), (0, n - job.noise.shape[1])))
    motion = tuple(map(jnp.asarray, (job.matrix, np.zeros(n), noise)))
    sensor = tuple(map(jnp.asarray, (job.sensor, np.zeros(m), job.std * np.eye(m))))

    def track(mean, root, z):
        f = build_filter(mean, root, lambda z: motion, lambda z: (*sensor, z))
        return cuthbert.filter(f, z, f.init_prepare()).mean

    return track


def kalman_py_kf(job: Job) -> Callable:
    """What is inside of the Kalman filter of kalman-py on JAX: from mean, root and ``z`` to all means."""
    from kalman_py.backends.jax_backend import kalman_filter

    q, r, _ = covariances(job)
    return lambda mean, root, z: kalman_filter(job.matrix, job.sensor, q, r, mean, root @ root.T, z).means


def kalman_py_in_turn(job: Job) -> Run:
    """The Kalman filter of kalman-py on JAX, as it is called."""
    from kalman_py import KalmanFilter

    q, r, p = covariances(job)

    def track(mean, z):
        f = KalmanFilter(job.matrix, job.sensor, q, r, mean, p)
        return np.asarray(f.filter(z, backend="jax").means)[-1]

    return in_turn(track, job)


def filterpy_kf(job: Job) -> Run:
    """The Kalman filter of FilterPy."""
    from filterpy.kalman import KalmanFilter

    (m, n), (q, r, p) = job.sensor.shape, covariances(job)

    def track(mean, z):
        f = KalmanFilter(n, m)
        f.x, f.P, f.F, f.Q, f.H, f.R = mean[:, None].copy(), p, job.matrix, q, job.sensor, r
        for z_k in z:
            f.predict()
            f.update(z_k)
        return f.x[:, 0]

    return in_turn(track, job)


def pykalman_kf(job: Job) -> Run:
    """The Kalman filter of pykalman."""
    from pykalman import KalmanFilter

    (q, r, _), (means, p) = covariances(job), predicted(job)

    def track(mean, z):
        f = KalmanFilter(job.matrix, job.sensor, q, r, initial_state_mean=mean, initial_state_covariance=p)
        return np.asarray(f.filter(z)[0])[-1]

    return in_turn(track, job._replace(means=means))


def stone_soup_kf(job: Job) -> Run:
    """The Kalman filter of Stone Soup."""
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.updater.kalman import KalmanUpdater

    sensor = LinearGaussian(len(job.matrix), tuple(job.sensor.argmax(1)), covariances(job)[1])
    return in_stone_soup(job, KalmanPredictor, KalmanUpdater(None), [sensor] * job.z.shape[1], float)


def simdkalman_kf(job: Job) -> Run:
    """The Kalman filter of simdkalman, all tracks at once in numpy."""
    from simdkalman import KalmanFilter

    (q, r, _), (means, p) = covariances(job), predicted(job)
    f = KalmanFilter(job.matrix, q, job.sensor, r)
    only = {"smoothed": False, "filtered": True, "observations": False, "covariances": False}
    return lambda: f.compute(job.z, 0, means[:, :, None], p, **only).filtered.states.mean[:, -1]


def torch_kf_kf(job: Job) -> Run:
    """The Kalman filter of torch-kf, all tracks at once in PyTorch."""
    import torch
    from torch_kf import GaussianState, KalmanFilter

    q, r, p = map(torch.from_numpy, covariances(job))
    f = KalmanFilter(torch.from_numpy(job.matrix), torch.from_numpy(job.sensor), q, r)
    z = torch.from_numpy(job.z).transpose(0, 1)[..., None].contiguous()
    start = GaussianState(torch.from_numpy(job.means)[..., None], p.expand(len(job.z), -1, -1))
    return lambda: f.filter(start, z, update_first=False).mean[..., 0].numpy()


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


def in_jax(track: Callable[[Job], Callable]) -> Callable[[Job], Run]:
    """A peer of a function of one track in JAX: the last means ``(B, n)`` of all tracks, under jit and vmap."""

    def peer(job: Job) -> Run:
        import jax
        import jax.numpy as jnp

        means, z, std = jnp.asarray(job.means), jnp.asarray(job.z), jnp.full(job.z.shape[1:], job.std)
        call = track(job)
        compiled = jax.jit(jax.vmap(lambda mean, z: call(mean, z, std)[-1]))
        return lambda: np.asarray(compiled(means, z).block_until_ready())

    return peer


def in_jax_by_roots(track: Callable[[Job], Callable], own: bool = True) -> Callable[[Job], Run]:
    """The same of a linear job: each track has its ``own`` covariance, or vmap may compute one for all."""

    def peer(job: Job) -> Run:
        import jax
        import jax.numpy as jnp

        means, root, z = map(jnp.asarray, (job.means, job.root, job.z))
        roots, call = jnp.tile(root, (len(z), 1, 1)) if own else root, track(job)
        compiled = jax.jit(jax.vmap(lambda mean, root, z: call(mean, root, z)[-1], (0, 0 if own else None, 0)))
        return lambda: np.asarray(compiled(means, roots, z).block_until_ready())

    return peer


LEARNERS: dict[str, Callable[[Job], Callable]] = {"jax": jax_srckf, "dynamax": dynamax_ukf}
BEARINGS: dict[str, Callable[[Job], Run]] = {
    **{name: in_jax(track) for name, track in LEARNERS.items()},
    "cuthbert": in_jax(cuthbert_ckf),
    "kalman-py": kalman_py_ukf,
    "filterpy": filterpy_ukf,
    "pykalman": pykalman_ukf,
    "stonesoup": stone_soup_ckf,
}
LINEAR: dict[str, Callable[[Job], Run]] = {
    "dynamax": in_jax_by_roots(dynamax_kf),
    "dynamax-one": in_jax_by_roots(dynamax_kf, own=False),
    "cuthbert": in_jax_by_roots(cuthbert_kf),
    "kalman-py": kalman_py_in_turn,
    "kalman-py-vmap": in_jax_by_roots(kalman_py_kf),
    "simdkalman": simdkalman_kf,
    "torch-kf": torch_kf_kf,
    "filterpy": filterpy_kf,
    "pykalman": pykalman_kf,
    "stonesoup": stone_soup_kf,
}


def peer(name: str, arrays: dict[str, np.ndarray]) -> Run:
    """The call of a peer on the job that the arrays are of.

    Raises:
        ImportError: its package is not installed.
        KeyError: it does not do this job.
    """
    job = Job(**{field: arrays.pop(field) for field in Job._fields if field in arrays})
    if job.sensor is not None:
        return LINEAR[name](job)
    if not arrays:
        return BEARINGS[name](job)
    weights = tuple(arrays[key] for key in sorted(arrays) if key.startswith("weight"))
    learning = Learning(arrays["features"], arrays["truth"], arrays["rate"], weights)
    return descent(LEARNERS[name](job), job, learning)


def main(arguments: list[str] | None = None) -> int:
    """Answers until standard input ends."""
    return serve(__doc__, [*BEARINGS, *LINEAR], peer, arguments)


def serve(
    words: str | None, names: Iterable[str], made: Callable[[str, dict[str, np.ndarray]], Run],
    arguments: list[str] | None = None,
) -> int:  # fmt: skip
    """Makes the call that a command line names, and times it for each line of standard input."""
    parser = argparse.ArgumentParser(description=words, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=dict.fromkeys(names))
    parser.add_argument("job", type=Path, metavar="JOB", help="arrays of the job (.npz)")
    parser.add_argument("--means", type=Path, metavar="FILE", help="write the means that the call gives (.npy)")
    options = parser.parse_args(arguments)
    os.environ["JAX_ENABLE_X64"] = "1"
    with np.load(options.job) as arrays:
        given = dict(arrays)
    learns = "rate" in given
    try:
        run = made(options.name, given)
        first = once(run)
    except ImportError as missing:
        answer(missing=str(missing))
        return 0
    if options.means is not None:
        np.save(options.means, run())
    answer(first_call_s=first, **({"error": float(run())} if learns else {}))
    for _ in sys.stdin:
        answer(seconds=one_pass(run))
    return 0


def answer(**values: float | str) -> None:
    """One JSON line on standard output."""
    print(json.dumps(values), flush=True)


if __name__ == "__main__":
    sys.exit(main())
