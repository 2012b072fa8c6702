"""GPB is what dense covariances and loops over hypotheses say, step by step."""

import copy
from functools import partial

import numpy as np
import oracles
import pytest
import torch
from gpb_cases import FEWER
from gpb_cases import SENSORS as PLAIN
from gpb_loops import (
    ANCHORS,
    PRIOR,
    SENSORS,
    STATIONS,
    STEPS,
    TWO,
    VALUES,
    Case,
    bank,
    bearings,
    carried,
    expected,
    measured,
    of_oracle,
    path,
    position,
    ranges,
    regimes,
    same,
    tensor,
)
from test_gpb_promises import agree
from torch.testing import assert_close

from torchfra import presets
from torchfra.association import Clutter
from torchfra.filters import Regimes
from torchfra.motion import (
    Bank,
    ConstantAcceleration,
    ConstantVelocity,
    IntegratedOrnsteinUhlenbeck,
    Level,
    Motion,
    Spherical,
    UnknownTurn,
    aircraft,
)
from torchfra.sensors import Bearings, Position, RangeBearing, RangeRates, Stacked
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


def test_the_lowest_of_three_levels_keeps_a_belief_of_its_own():
    """Which for the oracle is a second motion, the same as the first."""
    case, motion = position(), ConstantAcceleration(0.05)
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
    assert (error[1:-4] < 20).all()  # then it jumps


def test_a_prior_that_is_far_off():
    case, motion, (options, r) = position(), ConstantAcceleration(0.05), regimes(*TWO)
    off = PRIOR._replace(mean=PRIOR.mean + tensor([2e3, -1e3, 0, 0, 0, 0]))
    same(presets.gpb(motion, case.sensor, **options)(tensor(case.z), off),
         expected(case, [carried(motion, 1.0)], r, prior=off))  # fmt: skip


@pytest.mark.parametrize("least", [0.0, 0.9, 1.0])
@pytest.mark.parametrize("sensor", SENSORS)
def test_noise_that_is_learned(sensor, least):
    case, motion, (options, r) = sensor(), ConstantAcceleration(0.05), regimes(*TWO)
    options |= {"noise": "learned", "noise_doubt": 2.0, "noise_memory": 20.0, "noise_least": least}
    estimate = presets.gpb(motion, case.sensor, **options)(tensor(case.z), PRIOR)
    found = expected(case, [carried(motion, 1.0)], r, noise=(2.0, 20.0), least=least)
    same(estimate, found)
    torch.testing.assert_close(estimate.info.noise, tensor(found["noise"]), rtol=1e-9, atol=0.0)
    assert (estimate.info.noise - 1).abs().max() > 0.03


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


def test_a_motion_that_bends():
    case, (options, r) = position(), regimes(*TWO)
    same(presets.gpb(Curved(), case.sensor, **options)(tensor(case.z), PRIOR), expected(case, [curved], r))


# ---------------------------------------------------------------- jumps


@pytest.mark.parametrize("separate", [0, 1])
def test_a_jump_that_lasts(separate):
    case, motion = position(), ConstantAcceleration(0.05)
    case.z = path() + 4 * np.random.default_rng(1).standard_normal((STEPS, 2))
    case.z[5:] += 40 * np.array([5.0, 2.0])
    case.z[7], case.z[11, 0] = np.nan, np.nan
    options, r = regimes((0.9, 0.8, 0.7, 0.6), (0.5, 0.3, 0.15, 0.05), (0.1, 1.0), separate=separate)
    f = presets.gpb(motion, case.sensor, **options | {"burst": 1.5})
    found = expected(case, [carried(motion, 1.0)] * 2, r._replace(burst=1.5))
    same(f(tensor(case.z), PRIOR), found)
    assert found["regimes"][6:, -3:].sum(1).max() > 0.5  # it has jumped


def test_a_jump_aslant_of_bearings_from_afar():
    """Points on the axes of a belief see no bend there: only where the update by them arrives it shows."""
    places, noise, motion = np.array([[-1e4, 0.0], [0.0, -1e4]]), 1e-4 * np.eye(2), ConstantAcceleration(0.05)
    sensor = Bearings(tensor([1e-4, 1e-4]), stations=tensor(places))
    case = Case(sensor, lambda x, k: oracles.bearings(x, places), noise, angles=True)
    target = path() + 350.0 * (np.arange(STEPS) >= 6)[:, None]
    case.z = np.array([case.model.h(x, 0) for x in target])
    case.z += 1e-4 * np.random.default_rng(2).standard_normal(case.z.shape)
    options, r = regimes((0.9, 0.8, 0.7, 0.6), (0.5, 0.3, 0.15, 0.05), (0.1, 1.0), (5.0,))
    found = expected(case, [carried(motion, 1.0)], r)
    same(presets.gpb(motion, sensor, **options)(tensor(case.z), PRIOR), found, 1e-8)
    assert found["regimes"][6:, -3:].sum(1).max() > 0.5  # it has jumped


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
    f, r = presets.gpb(motions, case.sensor, **options), r._replace(steps=dt.__getitem__)
    same(f(tensor(case.z), PRIOR, dt=tensor(dt)), expected(case, [carried(m, dt) for m in motions], r))


# ---------------------------------------------------------------- manoeuvres


@pytest.mark.parametrize("motions", [1, 3])
def test_a_manoeuvre_is_as_large_as_the_measurement_asks_for(motions):
    case, stay, restart = position(), (0.8, 0.7, 0.6, 0.3, 0.1), (0.3, 0.3, 0.2, 0.15, 0.05)
    options, r = regimes(stay, restart, (0.1, 1.0), (200.0,), motions, (3.0,))
    each = bank() if motions == 3 else [ConstantAcceleration(0.05)]
    f = presets.gpb(each, case.sensor, **options)
    same(f(tensor(case.z), PRIOR), expected(case, [carried(motion, 1.0) for motion in each], r))


# ---------------------------------------------------------------- outliers with one offset


FIVE = (0.9, 0.8, 0.7, 0.6, 0.1), (0.4, 0.3, 0.15, 0.1, 0.05), (0.1, 1.0), (200.0,)


def with_bursts(case):
    """Outliers in a row with one offset: in both elements, and where the position before is missing in part."""
    rng = np.random.default_rng(4)
    case.z[4:8] = np.array([9.0, 0]) * np.arange(5, 9)[:, None] + [800.0, 300] + 3 * rng.standard_normal((4, 2))
    case.z[6, 0] = np.nan
    return case


def transition(motion, k=0):
    return motion.transition(tensor(1.0)).numpy()


def expected_with(case, motions, r, **more):
    transitions = [lambda k, m=motion: transition(m) for motion in motions]
    return expected(case, [carried(motion, 1.0) for motion in motions], r, transitions=transitions, **more)


def patient(options, r):
    """The same regimes, with jumps rarer than some outliers in a row, so that both have their say."""
    return options | {"burst": 1.0}, r._replace(burst=1.0)


@pytest.mark.parametrize(("inform", "offset"), [(True, 0.4), (False, 0.0)])
def test_one_motion_with_levels_manoeuvres_and_jumps(inform, offset):
    case, motion = with_bursts(position()), ConstantAcceleration(0.05)
    options, r = patient(*regimes(*FIVE, manoeuvres=(3.0,)))
    f = presets.gpb(motion, case.sensor, outliers_update=inform, same_offset=offset, **options)
    expected = expected_with(case, [motion], r, inform=inform, same_offset=offset)
    same(f(tensor(case.z), PRIOR), expected)


@pytest.mark.slow
def test_a_bank_and_elements_that_are_outliers_each_by_itself():
    case, motions = with_bursts(position()), bank()
    case.model = case.model._replace(SR=np.diag([5.0, 4.0]))
    case.blocks = [[0], [1]]
    case.sensor = Position(tensor([5.0, 4.0]))
    case.sensor.blocks = ((0,), (1,))
    options, r = regimes(*FIVE, motions=3, manoeuvres=(3.0,))
    f = presets.gpb(motions, case.sensor, outliers_update=False, same_offset=0.4, **options)
    same(f(tensor(case.z), PRIOR), expected_with(case, motions, r, inform=False, same_offset=0.4))


def test_other_motions_may_last_and_begin_each_in_its_own_way():
    case, motions = position(), bank()
    stay, restart = [0.9, 0.8, 0.7, 0.5, 0.1], [0.3, 0.3, 0.2, 0.15, 0.05]
    options, r = regimes((0.9, 0.8, 0.7, 0.1), (0.3, 0.3, 0.3, 0.1), (0.1, 1.0), motions=3)
    r = of_oracle(r.motions, r.levels, r.jumps, stay, restart, 1, others=2)
    f = presets.gpb(motions, case.sensor, **options | {"self_transition": stay, "restart": restart})
    same(f(tensor(case.z), PRIOR), expected(case, [carried(motion, 1.0) for motion in motions], r))


def test_several_motions_with_values_for_neither_kinds_nor_regimes_are_named():
    values = regimes((0.9, 0.8, 0.7, 0.1), (0.3, 0.3, 0.3, 0.1), (0.1, 1.0), motions=3)[0]
    with pytest.raises(
        ValueError, match=r"restart: expected \(..., 4\), or of each regime \(..., 5\), received \(3,\)"
    ):
        presets.gpb(bank(), Position(5.0), **values | {"restart": (0.5, 0.3, 0.2)})


def test_the_offset_of_a_sensor_that_is_not_linear_is_refused():
    with pytest.raises(ValueError, match="same_offset: expected None or a linear sensor, received Bearings"):
        presets.gpb(ConstantAcceleration(0.05), PLAIN["bearings"], same_offset=0.5)


def burst(steps=20, length=5):
    """A target at a constant velocity, and a burst of fixes beside it by one offset."""
    z = tensor([[9.0 * k, 0.0] for k in range(1, steps + 1)])
    z = z + 3 * torch.randn(z.shape, dtype=z.dtype, generator=torch.Generator().manual_seed(2))
    z[8 : 8 + length] += tensor([500.0, 300.0])
    return z, Gaussian(torch.zeros(4).double() + tensor([0, 0, 9, 0]), torch.diag(tensor([20, 20, 8, 8])))


@pytest.mark.parametrize("offset", [None, 0.5])
def test_a_long_burst_of_one_offset_is_a_jump_there_and_back_unless_outliers_may_have_the_same(offset):
    z, prior = burst(30, length=12)
    often = {"outlier_transition": ((0.98, 0.02), (0.4, 0.6)), "outliers_update": False}
    estimate = presets.gpb(ConstantVelocity(0.1), Position(3.0), same_offset=offset, **often).smooth(z, prior)
    wrong = torch.zeros(len(z), dtype=torch.bool)
    wrong[8:20] = offset is not None
    told = torch.ones(len(z), dtype=torch.bool)
    told[8:11] = offset is not None  # up to four are taken for outliers, where these have no offset
    assert_close(estimate.info.outlier[told, 0].round(), wrong[told].double())


def test_the_gradient_of_the_probability_is_that_of_small_differences():
    z, prior = burst()

    def likelihood(probability):
        f = presets.gpb(ConstantVelocity(0.1), Position(3.0), same_offset=probability, learn=("same_offset",))
        total = f(z, prior).log_likelihood.sum()
        return f.outliers.same_offset, total

    hyper, total = likelihood(0.4)
    (slope,) = torch.autograd.grad(total, hyper.raw)
    up, down = (likelihood(0.4 + step)[1].item() for step in (1e-6, -1e-6))
    (unit,) = torch.autograd.grad(hyper(), hyper.raw)
    assert (slope / unit).item() == pytest.approx((up - down) / 2e-6, rel=1e-5)


@pytest.mark.slow
def test_compiled_it_says_the_same():
    """Of a target on a line, for the compiler's time."""
    z, prior = burst()[0][:, :1], Gaussian(tensor([0.0, 9.0]), torch.diag(tensor([20.0, 8.0])))
    motion, sensor = ConstantVelocity(0.1, dims=1), Position(3.0, dims=1)
    f = presets.gpb(motion, sensor, same_offset=0.4, outliers_update=False, **FEWER)
    eager, g = f.smooth(z, prior), f.compile()
    compiled = g.smooth(z, prior)
    assert_close(compiled.mean, eager.mean, rtol=1e-9, atol=1e-9)
    assert_close(compiled.info.outlier, eager.info.outlier, rtol=1e-9, atol=1e-9)


def test_each_of_two_targets_in_a_scan_may_have_outliers_of_one_offset():
    inner = partial(presets.gpb, same_offset=0.4)
    f = presets.jpda(ConstantVelocity(0.1), Position(3.0), clutter=Clutter(1e6, rate=1.0), inner=inner)
    start = tensor([[0.0, 0, 9, 0], [500, 0, -9, 0]])
    z = torch.stack([start[:, :2] + k * start[:, 2:] for k in range(1, 4)])
    estimate = f(z, Gaussian(start, torch.diag(tensor([9, 9, 4, 4]))))
    assert_close(estimate.mean[:, -1, :2], z[-1], rtol=0, atol=1.0)


# ---------------------------------------------------------------- climbs


SPACE = ConstantVelocity(0.5, dims=3)
SENSOR = Position(5.0, dims=3)


# ---------------------------------------------------------------- what a climb is


@pytest.mark.parametrize(("motion", "vertical"), [
    (ConstantVelocity(1.0, dims=3), (2, 5)),
    (ConstantAcceleration(1.0, 3), (2, 5, 8)),
    (UnknownTurn(1.0, 0.1, 3), (2, 5)),
    (aircraft(dims=3), (2, 5, 8)),
    (ConstantVelocity(1.0), ()),
    (Level(IntegratedOrnsteinUhlenbeck(1.0, 0.2), 0.1), ()),
    (Spherical(ConstantVelocity(1.0, 3)), ()),
])  # fmt: skip
def test_vertical_components_are_those_along_the_third_axis_of_a_motion_that_can_climb(motion, vertical):
    assert motion.vertical == vertical


def test_a_climb_is_what_the_oracle_says():
    """Of a motion in the plane, of which the second axis is called vertical."""
    case, motion, vertical = position(), ConstantAcceleration(0.05), (1, 3, 5)
    levels, jumps = (0.1, 1.0, 60.0), [30.0]
    stay, restart = [0.9, 0.5, 0.6, 0.9, 0.2], [0.4, 0.2, 0.1, 0.1, 0.2]
    f = presets.gpb(motion, case.sensor, **VALUES)
    f.regimes = Regimes(
        1, noise_levels=levels, jump_factors=jumps, self_transition=stay, restart=restart, separate_levels=1,
        vertical=vertical, burst=VALUES["burst"],
    )  # fmt: skip
    root = np.full(6, np.sqrt(levels[0]))
    root[list(vertical)] = 1.0
    odds = [0.2, 0.2, 0.1, 0.2, 0.2]  # of levels, the climb, the jump: calm is shared, others are impossible
    r = of_oracle([1, 0, 0, 2], [*levels, np.outer(root, root)], jumps, [0.9, 0.5, 0.6, 0.9, 0.2], odds, 2)
    same(f(tensor(case.z), PRIOR), expected(case, [carried(motion, 1.0)] * 3, r))


class Climbing(ConstantVelocity):
    """Calm, but for the vertical process noise."""

    def __init__(self, q, factor):
        super().__init__(q, dims=3)
        self.factor = factor

    def process_noise(self, dt):
        rows = torch.tensor([self.factor, self.factor, 1.0] * 2, dtype=torch.float64).sqrt()
        return rows.unsqueeze(-1) * super().process_noise(dt)


def test_a_climb_is_a_motion_of_its_own_beside_the_calm_one_smoothed_too():
    factor, (calm, stated, jump), (a, b, c) = 0.01, (60.0, 30.0, 0.5), (0.5, 0.4, 0.1)
    few = {"jump_factors": (9.0,), "outlier_sizes": (100.0,), "outlier_shares": (1.0,)}
    one = presets.gpb(
        SPACE, SENSOR, noise_levels=(factor, 1.0), durations=(calm, stated, 1.0, jump), restart=(a, b, 0.0, c),
        separate_levels=1, climbs=True, **few,
    )  # fmt: skip
    bank = [SPACE, ConstantVelocity(factor * 0.5, dims=3), Climbing(0.5, factor)]
    three = presets.gpb(
        bank, SENSOR, noise_levels=(1.0,), durations=(stated, calm, jump), restart=(b, a, c), separate_levels=0,
        climbs=False, **few,
    )  # fmt: skip
    generator = torch.Generator().manual_seed(3)
    dt = 0.5 + torch.rand(13, generator=generator, dtype=torch.float64)
    z = dt.cumsum(0)[:, None] * torch.tensor([8.0, 2.0, 0.0]).double()
    z = z + 5 * torch.randn(13, 3, generator=generator, dtype=torch.float64)
    z[8:, 2] += 6 * dt.cumsum(0)[8:] - 6 * dt.cumsum(0)[8]
    z[5] += 200.0
    z[10:12] = torch.nan
    prior = Gaussian(torch.zeros(6).double(), torch.diag(torch.tensor([20.0, 20, 20, 9, 9, 9]).double()))
    agree(one, three, z, prior, dt)


@pytest.mark.slow
def test_compiled_a_climb_is_the_same():
    """Of a target on a line whose velocity alone is called vertical: its kernels are small."""
    f = presets.gpb(ConstantVelocity(0.5, dims=1), Position(5.0, dims=1), **FEWER)
    chain = {name: FEWER[name] for name in ("noise_levels", "jump_factors", "self_transition", "restart")}
    f.regimes = Regimes(1, **chain, separate_levels=1, vertical=(1,))
    z = burst()[0][:, :1] + 6.0 * torch.arange(-8, 12).clamp_min(0).unsqueeze(-1)
    prior = Gaussian(tensor([0.0, 9.0]), torch.diag(tensor([20.0, 8.0])))
    compiled, eager = (g.smooth(z, prior) for g in (copy.deepcopy(f).compile(), f))
    assert_close((compiled.mean, compiled.covariance), (eager.mean, eager.covariance), rtol=1e-9, atol=1e-9)
    assert eager.info.probabilities[..., f.regime_names.index("climb")].max() > 0.2


def test_regimes_have_names_in_the_order_of_their_probabilities():
    bank = [SPACE, IntegratedOrnsteinUhlenbeck(0.5, 0.1, dims=3)]
    f = presets.gpb(bank, SENSOR, manoeuvres="hard")
    names = f.regime_names
    info = f(torch.zeros(3, 3).double(), Gaussian.from_std([0.0] * f.motion.size, 5.0)).info
    assert len(names) == info.probabilities.shape[-1]
    assert names[0].startswith("constant velocity, noise x ")
    settled = "settled, noise x 1", "settled, noise x 2e+04"
    assert names[f.regimes.kinds.count("level") :] == (f.bank.names[1], "climb", "manoeuvre", "jump", *settled)


# ---------------------------------------------------------------- when there are climbs


def test_climbs_are_for_motions_in_space_unless_values_are_given():
    plane = presets.gpb(ConstantVelocity(1.0), Position(5.0))
    none = presets.gpb(SPACE, SENSOR, manoeuvres="none")
    own = presets.gpb(SPACE, SENSOR, noise_levels=(0.1, 0.3, 1.0, 2.0, 50.0, 500.0))
    asked = presets.gpb(SPACE, SENSOR, noise_levels=(0.1, 1.0, 50.0, 500.0), climbs=True)
    counts = [f.regimes.kinds.count("climb") for f in (plane, none, own, presets.gpb(SPACE, SENSOR), asked)]
    assert counts == [0, 0, 0, 1, 1]
    assert presets.gpb(SPACE, SENSOR, manoeuvres="hard").regimes.kinds.count("manoeuvre") == 1


def test_a_target_in_the_plane_does_not_climb():
    with pytest.raises(ValueError, match="climbs: expected a motion with a height and its rate, received"):
        presets.gpb(ConstantVelocity(1.0), Position(5.0), climbs=True)


@pytest.mark.slow
def test_a_climb_that_only_a_coarse_elevation_shows_is_followed():
    std = tensor([10.0, 0.01, 0.05, 1.0])  # ranges and rates speak against noise in all directions
    radar = Stacked(RangeBearing(std[:3], dims=3), RangeRates([[0.0, 0.0, 0.0]], 1.0))
    velocity = torch.tensor([[60.0, 10.0, 0.0]] * 15 + [[60.0, 10.0, 12.0]] * 35, dtype=torch.float64)
    truth = torch.cat([tensor([1000.0, 3000.0, 300.0]) + velocity.cumsum(0), velocity], -1).expand(20, -1, -1)
    noise = torch.randn(20, 50, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(8))
    z = radar(truth) + std * noise
    prior = Gaussian(truth[0, 0], torch.diag(tensor([50.0, 50, 50, 10, 10, 10])))
    error = {
        climbs: (presets.gpb(ConstantVelocity(16.0, dims=3), radar, climbs=climbs)(z, prior).mean - truth)[:, 20:, 2]
        for climbs in (True, False)
    }
    assert error[True].square().mean() < 0.85 * error[False].square().mean()
