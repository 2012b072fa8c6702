"""GPB is what dense covariances and loops over hypotheses say, step by step."""

import math

import numpy as np
import oracles
import pytest
import torch
from oracles import gpb as oracle

from torchfra import presets
from torchfra.motion import (
    Bank,
    ConstantAcceleration,
    ConstantVelocity,
    CoordinatedTurn,
    CurrentStatistical,
    Motion,
)
from torchfra.sensors import Bearings, Position, Ranges
from torchfra.types import Gaussian

STEPS = 14
VALUES = {
    "outlier_transition": ((0.9, 0.1), (0.6, 0.4)),
    "outlier_sizes": (9.0, 400.0, 1e6),
    "outlier_shares": (0.6, 0.3, 0.1),
    "prior_outlier": 0.3,
    "prior_inflation": 50.0,
    "burst": 1.1,
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
    """Measurements with noise, an outlier, a missing element and two missing steps."""
    rng = np.random.default_rng(seed)
    z = np.array([h(x, k) for k, x in enumerate(path())])
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
        case.blocks, np.array(VALUES["outlier_transition"]), VALUES["outlier_sizes"], VALUES["outlier_shares"], **more
    )
    call = (VALUES["prior_outlier"], VALUES["prior_inflation"])
    return oracle.gpb(case.z, prior.mean.numpy(), prior.covariance.numpy(), motions, case.model, regimes, modes, *call)


def regimes(stay, restart, levels, jumps=(200.0,), motions=1, manoeuvres=(), separate=0):
    """Options of the preset, and regimes of the oracle: levels, other motions, manoeuvres, jumps."""
    options = {"noise_levels": levels, "manoeuvre_factors": manoeuvres, "jump_factors": jumps, "self_transition": stay,
               "restart": restart, "separate_levels": separate}  # fmt: skip
    count, others = len(levels), motions - 1
    stay, restart = ([*x[:count], *[x[count]] * others, *x[count + 1 :]] for x in (stay, restart))
    restart[count : count + others] = [x / others for x in restart[count : count + others]]
    odds = np.array(restart) / sum(restart)
    chain = oracle.restart_transition(stay, odds)
    unmeasured = (
        oracle.unmeasured_transition(stay, list(odds), range(count, count + others)) if others else np.eye(len(stay))
    )
    factors = [*levels, *[1.0] * others]
    which = [*range(motions, motions + separate), *[0] * (count - separate), *range(1, motions)]
    first = oracle.stationary(chain)
    return options | VALUES, oracle.Regimes(
        which, factors, list(jumps), chain, unmeasured, first, count - 1, manoeuvres, burst=VALUES["burst"]
    )


TWO = ((0.9, 0.8, 0.7, 0.1), (0.5, 0.3, 0.15, 0.05), (0.1, 30.0))
"""Two levels, other motions if any, and a jump: how they stay, how they are drawn anew, and what the levels are."""


def same(estimate, r, tolerance=1e-9):
    """Every result is that of the oracle, relative to its largest entry."""
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


# ---------------------------------------------------------------- one motion


@pytest.mark.slow
@pytest.mark.parametrize("sensor", SENSORS)
def test_three_levels_and_two_jumps(sensor):
    case, motion = sensor(), ConstantAcceleration(0.05)
    stay, restart = (0.9, 0.5, 0.6, 0.9, 0.2, 0.1), (0.4, 0.2, 0.1, 0.1, 0.15, 0.05)
    options, r = regimes(stay, restart, (0.1, 1.0, 60.0), (30.0, 2000.0))
    f = presets.gpb(motion, case.sensor, **options)
    same(f(tensor(case.z), PRIOR), expected(case, [carried(motion, 1.0)], r))


@pytest.mark.parametrize("sensor", [position, pytest.param(ranges, marks=pytest.mark.slow)])
def test_the_lowest_of_three_levels_keeps_a_belief_of_its_own(sensor):
    """Which for the oracle is a second motion, the same as the first."""
    case, motion = sensor(), ConstantAcceleration(0.05)
    stay, restart = (0.9, 0.5, 0.6, 0.9, 0.2, 0.1), (0.4, 0.2, 0.1, 0.1, 0.15, 0.05)
    options, r = regimes(stay, restart, (0.1, 1.0, 60.0), (30.0, 2000.0), separate=1)
    f = presets.gpb(motion, case.sensor, **options)
    same(f(tensor(case.z), PRIOR), expected(case, [carried(motion, 1.0)] * 2, r))


def test_the_lowest_and_the_highest_of_three_levels_keep_beliefs_of_their_own():
    """Which for the oracle are motions, the same as the first."""
    case, motion = position(), ConstantAcceleration(0.05)
    options, r = regimes((0.9, 0.5, 0.6, 0.9), (0.5, 0.2, 0.2, 0.1), (0.1, 1.0, 60.0), (), separate=1)
    r = r._replace(motions=[1, 0, 2])
    f = presets.gpb(motion, case.sensor, **options | {"separate_levels": (0, 2)})
    same(f(tensor(case.z), PRIOR), expected(case, [carried(motion, 1.0)] * 3, r))


def test_two_levels_of_the_first_of_three_motions_keep_beliefs_of_their_own():
    case, motions = position(), bank()
    stay, restart = (0.9, 0.5, 0.6, 0.9, 0.2), (0.4, 0.2, 0.1, 0.15, 0.15)
    options, r = regimes(stay, restart, (0.1, 1.0, 60.0), motions=3, separate=2)
    f = presets.gpb(Bank(motions), case.sensor, **options)
    each = [carried(m, 1.0) for m in motions]
    same(f(tensor(case.z), PRIOR), expected(case, [*each, each[0], each[0]], r))


@pytest.mark.slow
def test_a_start_so_wide_that_points_on_all_sides_of_an_anchor_are_equally_far():
    case, motion, (options, r) = ranges(), ConstantAcceleration(0.05), regimes(*TWO)
    options, r = options | {"burst": 1.4}, r._replace(burst=1.4)  # one outlier is no jump
    wide = Gaussian(tensor([*ANCHORS[0], 9, 0, 0, 0]), torch.diag(tensor([200, 200, 8, 8, 0.5, 0.5])))
    e = presets.gpb(motion, case.sensor, **options)(tensor(case.z), wide)
    same(e, expected(case, [carried(motion, 1.0)], r, prior=wide))
    error = (e.mean[:, :2] - tensor(path())).norm(dim=-1)
    assert (error[1:] < 20).all()


@pytest.mark.parametrize("sensor", SENSORS)
def test_noise_that_is_learned(sensor):
    case, motion, (options, r) = sensor(), ConstantAcceleration(0.05), regimes(*TWO)
    f = presets.gpb(motion, case.sensor, noise="learned", noise_doubt=0.9, noise_memory=6.0, **options)
    estimate, found = f(tensor(case.z), PRIOR), expected(case, [carried(motion, 1.0)], r, noise=(0.9, 6.0))
    same(estimate, found)
    torch.testing.assert_close(estimate.info.noise, tensor(found["noise"]), rtol=1e-9, atol=0.0)
    assert (estimate.info.noise - 1).abs().max() > 0.1


@pytest.mark.slow
def test_time_steps_of_their_own():
    case, motion, (options, r) = ranges(), ConstantAcceleration(0.05), regimes(*TWO)
    dt = np.linspace(0.4, 1.7, STEPS)
    f = presets.gpb(motion, case.sensor, **options)
    same(f(tensor(case.z), PRIOR, dt=tensor(dt)), expected(case, [carried(motion, dt)], r))


@pytest.mark.parametrize("sensor", [position, pytest.param(ranges, marks=pytest.mark.slow)])
def test_outliers_that_are_too_large_in_the_mean(sensor):
    case, motion, (options, r) = sensor(), ConstantAcceleration(0.05), regimes(*TWO)
    f = presets.gpb(motion, case.sensor, outlier_offsets=(2.0, 15.0, 400.0), **options)
    same(f(tensor(case.z), PRIOR), expected(case, [carried(motion, 1.0)], r, offsets=[2.0, 15.0, 400.0]))


def test_stations_that_move_and_a_known_push():
    case, (options, r) = bearings(), regimes(*TWO)
    places = np.array([STATIONS + 5.0 * np.arange(2)[:, None] * k for k in range(STEPS)])
    u = tensor(places.reshape(STEPS, 4))
    case.model = case.model._replace(h=lambda x, k: oracles.bearings(x, places[k]))
    case.z = measured(case.model.h, np.diag([0.01, 0.02]))
    motion, sensor = Pushed(0.05), Bearings(tensor([0.01, 0.02]))
    f = presets.gpb(motion, sensor, **options)
    same(f(tensor(case.z), PRIOR, u=u), expected(case, [carried(motion, 1.0, u)], r))


class Pushed(ConstantAcceleration):
    """With a known push along x where ``u`` says so."""

    def shift(self, dt, u):
        return u[..., :1] / 100 * tensor([1.0, 0, 0.5, 0, 0, 0])


class Curved(Motion):
    """Not linear."""

    def __init__(self):
        super().__init__(2, 3, 0.05)

    def forward(self, x, dt, u=None):
        p, v, a = x[..., :2], x[..., 2:4], x[..., 4:]
        dt = dt.unsqueeze(-1)
        return torch.cat([p + dt * v, v + dt * a, a - 0.3 * (v / 10).tanh()], -1)


def curved(mean, P, k):
    """The same for the oracle, through points of its own."""
    rule = oracles.third_degree(6)
    points = mean + (np.linalg.cholesky(P) @ rule[0]).T
    p, v, a = points[:, :2], points[:, 2:4], points[:, 4:]
    moved = np.hstack([p + v, v + a, a - 0.3 * np.tanh(v / 10)])
    ahead = rule[1] @ moved
    noise = oracles.ca(1.0, 0.05)[1]
    return ahead, (moved - ahead).T @ np.diag(rule[2]) @ (moved - ahead), noise @ noise.T


@pytest.mark.slow
@pytest.mark.parametrize("sensor", [position, ranges])
def test_a_motion_that_bends(sensor):
    case, (options, r) = sensor(), regimes(*TWO)
    same(presets.gpb(Curved(), case.sensor, **options)(tensor(case.z), PRIOR), expected(case, [curved], r))


# ---------------------------------------------------------------- a bank


def bank():
    return [
        ConstantVelocity(0.02, orders=3),
        CurrentStatistical(1 / 20, 3.0),
        CoordinatedTurn(math.pi / 30, 0.05, orders=3),
    ]


@pytest.mark.slow
@pytest.mark.parametrize("sensor", SENSORS)
def test_a_bank_of_three_motions_the_first_at_two_levels(sensor):
    case, motions, (options, r) = sensor(), bank(), regimes(*TWO, motions=3)
    f = presets.gpb(Bank(motions), case.sensor, **options)
    same(f(tensor(case.z), PRIOR), expected(case, [carried(m, 1.0) for m in motions], r))


@pytest.mark.parametrize("sensor", [position, bearings])
def test_a_bank_with_one_level_two_jumps_and_time_steps_of_their_own(sensor):
    case, motions = sensor(), bank()
    options, r = regimes((0.8, 0.6, 0.1, 0.05), (0.3, 0.4, 0.2, 0.1), (2.0,), (30.0, 2000.0), 3)
    dt = np.linspace(0.4, 1.7, STEPS)
    f = presets.gpb(motions, case.sensor, **options)
    same(f(tensor(case.z), PRIOR, dt=tensor(dt)), expected(case, [carried(m, dt) for m in motions], r))


# ---------------------------------------------------------------- manoeuvres


@pytest.mark.parametrize("motions", [1, 3])
def test_a_manoeuvre_is_as_large_as_the_measurement_asks_for(motions):
    case, stay, restart = position(), (0.8, 0.7, 0.6, 0.3, 0.1), (0.3, 0.3, 0.2, 0.15, 0.05)
    options, r = regimes(stay, restart, (0.1, 1.0), (200.0,), motions, (3.0,))
    each = bank() if motions == 3 else [ConstantAcceleration(0.05)]
    f = presets.gpb(each, case.sensor, **options)
    same(f(tensor(case.z), PRIOR), expected(case, [carried(motion, 1.0) for motion in each], r))
