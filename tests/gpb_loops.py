"""Cases of gpb for torchfra and for the oracle, with what both say of them."""

import math

import numpy as np
import oracles
import torch
from oracles import gpb as oracle

from torchfra.motion import ConstantVelocity, CoordinatedTurn, CurrentStatistical
from torchfra.sensors import Bearings, Position, Ranges
from torchfra.types import Gaussian

STEPS = 14
VALUES = {
    "outlier_transition": ((0.9, 0.1), (0.6, 0.4)),
    "outlier_sizes": (9.0, 400.0, 1e6),
    "outlier_shares": (0.6, 0.3, 0.1),
    "prior_outlier": 0.3,
    "unreliable": 0.05,
    "prior_inflation": 50.0,
    "burst": 1.1,
    "noise": "stated",
}
"""None of them a default, so that the tests hold whatever those are."""


def tensor(x):
    return torch.as_tensor(x, dtype=torch.float64)


PRIOR = Gaussian(tensor([0.0, 100, 9, 0, 0, 0]), torch.diag(tensor([20, 20, 8, 8, 0.5, 0.5])))
ANCHORS = [[-200.0, -100], [300, -150], [250, 400]]
STATIONS = [[-800.0, -500], [900, -600]]


def path():
    """Positions of a target that turns hard."""
    t = np.arange(1, STEPS + 1)
    return np.stack([9.0 * t, 100 + 1.5 * np.maximum(t - 6, 0) ** 2], 1)


def measured(h, noise, seed=0):
    """Measurements with noise, an outlier, a missing element, two missing steps and a jump before the last four."""
    rng = np.random.default_rng(seed)
    jumped = path()
    jumped[-4:, 0] += 400
    z = np.array([h(x, k) for k, x in enumerate(jumped)])
    z += rng.standard_normal(z.shape) @ np.atleast_2d(noise).T
    z[4] += 30 * noise.sum(1)
    z[7, 0] += 200 * noise[0, 0]
    z[2, 1] = np.nan
    z[9:11] = np.nan
    return z


class Case:
    """A sensor as torchfra has it, and for the oracle."""

    def __init__(self, sensor, h, noise, angles=False):
        size = len(noise)
        self.sensor = sensor
        self.model = oracles.Model(None, None, noise, h, np.full(size, angles))
        self.blocks = [list(block) for block in sensor.blocks]
        self.z = measured(h, noise)


def position():
    root = np.array([[5.0, 0], [2, 4]])
    return Case(Position(noise=tensor(root)), lambda x, k: x[:2], root)


def bearings():
    places = np.array(STATIONS)
    noise = np.diag([0.01, 0.02])
    sensor = Bearings(tensor([0.01, 0.02]), stations=tensor(places))
    return Case(sensor, lambda x, k: oracles.bearings(x, places), noise, angles=True)


def ranges():
    places = np.array(ANCHORS)
    noise = np.diag([2.0, 3.0, 2.5])
    sensor = Ranges(tensor(places), tensor([2.0, 3.0, 2.5]))
    return Case(sensor, lambda x, k: np.hypot(*(x[:2] - places).T), noise)


SENSORS = [position, bearings, ranges]


def carried(motion, dt, u=None):
    """A motion for the oracle: its matrices at the times of the steps."""

    def carry(mean, P, k):
        ahead = tensor(np.broadcast_to(dt, STEPS)[k])
        F, noise = motion.transition(ahead), motion.process_noise(ahead)
        shift, follows = motion.shift(ahead, None if u is None else u[k]), motion.adaptation(ahead)
        if follows is not None:
            shift, noise = follows(tensor(mean), shift, noise)
        known = np.zeros(len(mean)) if shift is None else shift.numpy()
        return F.numpy() @ mean + known, F.numpy() @ P @ F.numpy().T, (noise @ noise.mT).numpy()

    return carry


def expected(case, motions, regimes, prior=PRIOR, **more):
    modes = oracle.OutlierModes(
        case.blocks, np.array(VALUES["outlier_transition"]), VALUES["outlier_sizes"], VALUES["outlier_shares"],
        **{"unreliable": VALUES["unreliable"]} | more,
    )  # fmt: skip
    call = (VALUES["prior_outlier"], VALUES["prior_inflation"])
    return oracle.gpb(case.z, prior.mean.numpy(), prior.covariance.numpy(), motions, case.model, regimes, modes, *call)


def regimes(stay, restart, levels, jumps=(200.0,), motions=1, manoeuvres=(), separate=0):
    """Options of the preset, and regimes of the oracle: levels, other motions, manoeuvres, jumps."""
    options = {"noise_levels": levels, "manoeuvre_factors": manoeuvres, "jump_factors": jumps, "self_transition": stay,
               "restart": restart, "separate_levels": separate}  # fmt: skip
    count, others = len(levels), motions - 1
    stay, restart = ([*x[:count], *[x[count]] * others, *x[count + 1 :]] for x in (stay, restart))
    restart[count : count + others] = [x / others for x in restart[count : count + others]]
    factors = [*levels, *[1.0] * others]
    which = [*range(motions, motions + separate), *[0] * (count - separate), *range(1, motions)]
    return options | VALUES, of_oracle(which, factors, jumps, stay, restart, count - 1, manoeuvres, others)


def of_oracle(which, factors, jumps, stay, restart, home, manoeuvres=(), others=0):
    """Regimes of the oracle, with these values of each level, manoeuvre and jump."""
    count = len(factors) + len(manoeuvres)
    odds, begins = np.array(restart[:count]) / sum(restart[:count]), np.array(restart[count:])
    chain, stay, keeps = oracle.restart_transition(stay[:count], odds), stay[:count], stay[count:]
    motions = range(home + 1, home + 1 + others)
    unmeasured = oracle.unmeasured_transition(stay, list(odds), motions) if others else np.eye(count)
    return oracle.Regimes(
        which, factors, list(jumps), chain, unmeasured, oracle.stationary(chain), home, manoeuvres,
        burst=VALUES["burst"], restart=odds, keeps=keeps, shares=begins / begins.sum(),
    )  # fmt: skip


TWO = ((0.9, 0.8, 0.7, 0.1), (0.5, 0.3, 0.15, 0.05), (0.1, 30.0))
"""Two levels, other motions if any, and a jump: how they stay, how they are drawn anew, and what the levels are."""


def same(estimate, r, tolerance=1e-9):
    """Every result is that of the oracle, relative to its largest entry; every regime is at least as probable once."""
    info = estimate.info
    for name, a in (
        ("mean", info.filtered.mean), ("P", info.filtered.covariance), ("lagged_mean", info.lagged.mean),
        ("lagged_P", info.lagged.covariance), ("regimes", info.probabilities), ("outlier", info.outlier),
        ("log_likelihood", estimate.log_likelihood), ("nis", estimate.nis),
    ):  # fmt: skip
        b = tensor(r[name])
        near = {"rtol": tolerance, "atol": tolerance * b.abs().max().item()}
        torch.testing.assert_close(a, b, **near, msg=lambda m, n=name: f"{n}: {m}")
    assert r["outlier"].max() > 0.5
    assert r["regimes"].max(0).min() > 1e-4  # every regime has its say


def bank():
    """Three motions with an acceleration."""
    return [
        ConstantVelocity(0.02, orders=3),
        CurrentStatistical(1 / 20, 3.0),
        CoordinatedTurn(math.pi / 30, 0.05, orders=3),
    ]
