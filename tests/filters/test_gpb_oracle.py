"""GPB is what dense covariances and loops over hypotheses say, step by step."""

import numpy as np
import oracles
import pytest
import torch
from gpb_loops import (
    ANCHORS,
    PRIOR,
    SENSORS,
    STATIONS,
    STEPS,
    TWO,
    bank,
    bearings,
    carried,
    expected,
    measured,
    path,
    position,
    ranges,
    regimes,
    same,
    tensor,
)

from torchfra import presets
from torchfra.motion import (
    Bank,
    ConstantAcceleration,
    Motion,
)
from torchfra.sensors import Bearings
from torchfra.types import Gaussian

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
