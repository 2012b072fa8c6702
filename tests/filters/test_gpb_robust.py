"""Never locked out, never blown up: GPB has left behind what went wrong five measured steps later; jumps later."""

import functools
import itertools
import math
from functools import partial

import pytest
import torch
from regrets.open_cells import OpenCell, open_cell

from torchfra import metrics, presets, scenarios, tree
from torchfra.association import Clutter, Euclidean
from torchfra.motion import ConstantAcceleration, ConstantVelocity, aircraft
from torchfra.sensors import Bearings, Position, RangeBearing, Ranges
from torchfra.types import Gaussian
from train.gpb.regimes import regimes

RUNS, STEPS = 5, 240
BOUND = 13.816
"""99.9 % of chi-square with 2 degrees of freedom."""
RECOVERED = 5
"""Measured steps after which all must be well again."""


def tensor(x):
    return torch.as_tensor(x, dtype=torch.float64)


SENSORS = {
    "position": Position(10.0),
    "radar": RangeBearing(tensor([20.0, 0.003])),
    "bearings": Bearings(0.01, stations=tensor([[-6000, -2000], [6000, -3000]])),
    "ranges": Ranges(tensor([[-6000, -4000], [6000, -4000], [6000, 8000], [-6000, 8000]]), 10.0),
}
SIGMA = {"position": 10.0, "radar": 20.0, "bearings": 80.0, "ranges": 10.0}
"""What a standard deviation of the measurement is on the ground, m."""
STATED = {"one motion": 4.0, "one that fits": 0.3, "bank": 4.0}
"""Process noise: far more than the flight has; what fits it, as its acceleration changes by 1.6 m/s^2 four times in
four minutes; and what the bank of aircraft has if nothing is said."""
MOTIONS = {
    "one motion": lambda: ConstantAcceleration(STATED["one motion"]),
    "one that fits": lambda: ConstantAcceleration(STATED["one that fits"]),
    "bank": aircraft,
}
START = torch.diag(tensor([30, 30, 5, 5, 1, 1]))

COVERED = {"one motion": 0.99, "one that fits": 0.99, "bank": 0.975}
"""Share of steps whose NEES is below the bound, as the values reach it; what is asked of a bank too is a test below."""

CALM = pytest.mark.xfail(strict=True, reason="a bank's calm is so calm that it misses the beginning of some turns")
"""On these five runs; on others, of positions too, its values cover 98.7 to 99.2 %."""


PAIRS = [("position", "one motion"), ("position", "one that fits"), *((sensor, "bank") for sensor in SENSORS)]
"""Every motion with the plainest sensor, and every sensor with the largest filter."""


def with_sensors(*sensors):
    """The pairs of these; but for the plain ones they are slow.  One estimate is of all tests of a pair."""
    return pytest.mark.parametrize(("sensor", "motion"), [
        pytest.param(sensor, motion, id=f"{sensor}-{motion}", marks=pytest.mark.slow if motion == "bank" else ())
        for sensor, motion in PAIRS if sensor in sensors
    ])  # fmt: skip


every_pair = with_sensors(*SENSORS)


def flight():
    """An aircraft at 60 m/s that turns by 1.5 deg/s to either side for half a minute."""
    rng = torch.Generator().manual_seed(0)
    rate = torch.zeros(STEPS, dtype=torch.float64)
    rate[60:90], rate[150:180] = math.radians(1.5), -math.radians(1.5)
    heading = math.pi / 2 + 0.6 * torch.rand(RUNS, 1, dtype=torch.float64, generator=rng) - 0.3 + rate.cumsum(0)
    velocity = 60 * torch.stack([heading.sin(), heading.cos()], -1)
    place = velocity.cumsum(1) + tensor([-6000, 1000])
    return torch.cat([place, velocity, torch.zeros_like(place)], -1)


def measured(sensor, truth):
    """Its noise alone."""
    noise = torch.randn(*truth.shape[:2], sensor.size, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    return sensor(truth) + sensor.std.elements() * noise


def start(truth, off=0.0):
    """A prior one step before, off by so much."""
    before = truth[:, 0].clone()
    before[:, :2] -= before[:, 2:4]
    error = torch.randn(RUNS, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(2)) @ START
    error[:, :2] += off * tensor([0.6, -0.8])
    return Gaussian(before + error, START)


def nees(estimate, truth):
    """Of the position, ``(runs, steps)``."""
    error, covariance = (estimate.mean - truth)[..., :2], estimate.covariance[..., :2, :2]
    return (error * torch.linalg.solve(covariance, error)).sum(-1)


def well(estimate, truth, usual):
    """Where the error is three times the usual one at most, or within five of its own standard deviations."""
    error = (estimate.mean - truth)[..., :2].norm(dim=-1)
    return (error < 3 * usual) | (nees(estimate, truth) < 25)


# ---------------------------------------------------------------- what goes wrong, from a sensor


def nothing(sensor):
    truth = flight()
    return truth, measured(SENSORS[sensor], truth), start(truth)


def silence(sensor):
    truth, z, prior = nothing(sensor)
    z[:, 100:130] = torch.nan
    return truth, z, prior


def jump(sensor):
    truth = flight()
    truth[:, 120:, :2] += 100 * SIGMA[sensor] * tensor([0.6, 0.8])
    return truth, measured(SENSORS[sensor], truth), start(truth)


def poor_start(sensor):
    truth, z, _ = nothing(sensor)
    return truth, z, start(truth, 3000.0)


def half(wrong):
    def case(sensor):
        truth, z, prior = nothing(sensor)
        off = torch.rand(RUNS, 60, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
        z[:, 100:160, :2] += 300 * off if wrong == "anew" else tensor([300.0, 200.0])
        return truth, z, prior

    return case


def elsewhere(sensor):
    truth, z, prior = nothing(sensor)
    place = truth[:, 120].clone()
    place[:, 0] += 3.6e6
    z[:, 120] = SENSORS[sensor](place)
    return truth, z, prior


def bursts(sensor):
    truth, z, prior = nothing(sensor)
    quiet = SENSORS[sensor](truth)
    starts = torch.rand(RUNS, STEPS, generator=torch.Generator().manual_seed(4)) < 0.0125
    inside = torch.stack([starts.roll(k, 1) for k in range(4)]).any(0)
    inside[:, :10] = False
    return truth, quiet + torch.where(inside.unsqueeze(-1), 10.0, 1.0) * (z - quiet), prior


CASES = dict.fromkeys((nothing, silence, jump, poor_start, bursts), SENSORS)
CASES |= {elsewhere: ("position", "radar", "ranges")}
HALF = {wrong: half(wrong) for wrong in ("anew", "the same")}
CASES |= dict.fromkeys(HALF.values(), ("ranges",))
"""Each with the sensors that it is of."""


@functools.cache
def estimates(motion, sensor):
    """Of all cases at once: the truth, the measurements, the prior, the estimate of each."""
    cases = [(case, *case(sensor)) for case, sensors in CASES.items() if sensor in sensors]
    _, _, zs, priors = zip(*cases, strict=True)
    prior = Gaussian(torch.cat([prior.mean for prior in priors]), START)
    whole = presets.gpb(MOTIONS[motion](), SENSORS[sensor])(torch.cat(zs), prior)
    parts = [tree.map_tensors(lambda x, i=i: x[RUNS * i : RUNS * (i + 1)], whole) for i in range(len(cases))]
    return {case: (*given, part) for (case, *given), part in zip(cases, parts, strict=True)}


@functools.cache
def usual_error(motion, sensor):
    """Of a plain filter where nothing is wrong."""
    truth, z, prior = nothing(sensor)
    e = presets.srckf(ConstantAcceleration(STATED[motion]), SENSORS[sensor])(z, prior)
    return (e.mean - truth)[:, 20:, :2].norm(dim=-1).square().mean().sqrt()


def check(motion, sensor, case, since):
    """Finite; well from the measured step on in which it has to be; its covariance covers what happened otherwise."""
    truth, _, _, e = estimates(motion, sensor)[case]
    usual = usual_error(motion, sensor)
    assert not e.failed.any()
    assert all(x.isfinite().all() for of in (e.info.filtered, e.info.lagged) for x in of)
    assert well(e, truth, usual)[:, since + RECOVERED - 1 :].all()
    covered = (nees(e, truth) < BOUND).double()
    assert torch.cat([covered[:, :since], covered[:, since + RECOVERED - 1 :]], 1).mean() > COVERED[motion]
    return e, truth, usual


@pytest.mark.slow
@every_pair
def test_nothing_is_wrong(sensor, motion):
    e, truth, usual = check(motion, sensor, nothing, 0)
    assert (e.mean - truth)[:, 20:, :2].norm(dim=-1).square().mean().sqrt() < 1.1 * usual


@pytest.mark.slow
@pytest.mark.parametrize("sensor", [pytest.param(s, marks=() if s == "position" else CALM) for s in SENSORS])
def test_a_bank_covers_99_percent_of_the_steps(sensor):
    truth, _, _, e = estimates("bank", sensor)[nothing]
    assert (nees(e, truth) < BOUND).double().mean() > COVERED["one motion"]


@every_pair
def test_half_a_minute_without_any_measurement(sensor, motion):
    check(motion, sensor, silence, 130)


@every_pair
def test_a_target_that_jumps_by_a_hundred_sigma_and_stays(sensor, motion):
    check(motion, sensor, jump, 120)


@every_pair
def test_a_start_that_is_three_kilometres_off(sensor, motion):
    check(motion, sensor, poor_start, 0)


@pytest.mark.slow
@pytest.mark.parametrize("wrong", HALF)
def test_half_of_the_elements_wrong_for_a_minute(wrong):
    e, truth, usual = check("bank", "ranges", HALF[wrong], 160)
    assert (e.info.outlier[:, 105:160, :2].mean((0, 1)) > 0.8).all()
    assert (e.info.outlier[:, 105:160, 2:].mean((0, 1)) < 0.2).all()
    assert (e.mean - truth)[:, 100:160, :2].norm(dim=-1).median() < 3 * usual


@with_sensors(*CASES[elsewhere])
def test_one_fix_that_is_thousands_of_kilometres_off(sensor, motion):
    e, truth, usual = check(motion, sensor, elsewhere, 120)
    assert (nees(e, truth)[:, 120] < 25).all()
    assert well(e, truth, usual)[:, 120:].all()
    assert ((e.mean - truth)[:, 121, :2].norm(dim=-1) < 5 * usual).all()


@every_pair
def test_bursts_of_four_measurements_at_ten_sigma(sensor, motion):
    e, truth, usual = check(motion, sensor, bursts, STEPS)
    _, z, prior = bursts(sensor)
    plain = presets.srckf(ConstantAcceleration(STATED[motion]), SENSORS[sensor])(z, prior)
    error, loose = ((x.mean - truth)[:, 20:, :2].norm(dim=-1).square().mean().sqrt() for x in (e, plain))
    assert error < 0.7 * loose
    assert error < 1.6 * usual


@pytest.mark.slow
def test_covariances_are_honest_where_targets_do_what_it_believes():
    known = {
        "noise_levels": (1.0, 100.0),
        "self_transition": (0.94, 0.8, 0.5, 0.1),
        "restart": (5 / 9, 4 / 9 - 2e-9, 1e-9, 1e-9),
        "outlier_transition": ((0.97, 0.03), (0.4, 0.6)),
        "outlier_sizes": (100.0,),
        "outlier_shares": (1.0,),
        "adaptive_largest_size": False,
        "prior_outlier": 1e-6,
        "prior_inflation": 1.0,
    }
    scenario = regimes()
    tracks = scenario.simulate(runs=200, seed=4242)
    e = presets.gpb(scenario.motion, scenario.sensor, **known)(tracks.z, tracks.prior)
    for of, size in ((slice(0, 2), 2), (slice(0, 6), 6)):
        assert 0.9 * size < metrics.nees(e, tracks.truth, of).mean() < 1.1 * size


@pytest.mark.slow
def test_a_poor_start_is_none_of_a_parameter_that_acts_exponentially():
    scenario = scenarios.reentry()
    tracks = scenario.simulate(20, 3)
    f = presets.gpb(scenario.motion, scenario.sensor)
    estimate = f(tracks.z, tracks.prior, u=tracks.u)
    assert not estimate.failed.any()
    plain = presets.srckf(scenario.motion, scenario.sensor)(tracks.z, tracks.prior, u=tracks.u)
    errors = [(e.mean - tracks.truth)[..., scenario.position].norm(dim=-1).mean(-1) for e in (estimate, plain)]
    assert (errors[0] < 2 * errors[1]).all()


@pytest.mark.slow
def test_a_walker_far_from_all_anchors_is_not_lost_where_ranges_state_more_noise_and_it_is_learned():
    scenario = scenarios.ranges_outliers()
    tracks = scenario.simulate(6, seed=11)
    sensor = Ranges(scenario.sensor.anchors, 0.45, height=0.1)  # three times the true one: a belief is a wide arc then
    rmse = {
        name: metrics.track_rmse(f(tracks.z, tracks.prior, dt=scenario.dt).mean, tracks.truth, slice(0, 2)).mean()
        for name, options in (("rsrckf", {}), ("gpb", {"noise": "learned", "noise_least": 0.0}))
        for f in [getattr(presets, name)(ConstantAcceleration(0.3), sensor, **options).compile()]
    }
    assert rmse["gpb"] < rmse["rsrckf"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cell", "seed", "runs", "noise"), [(8, 161803, [10, 18], "stated"), (65, 99001, [8], "learned")]
)
def test_hypotheses_without_weight_that_fail_leave_the_others_alone(cell, seed, runs, noise):
    """Robots that turn: ranges 2e4 standard deviations too large, and positions 7e5 off, to which nobody jumps."""
    scenario = open_cell(cell, seed=seed)
    tracks = scenario.simulate(20, seed)
    z, u, mean = tracks.z[runs, :70], tracks.u[runs, :70], tracks.prior.mean[runs]
    dt = scenario.dt if isinstance(scenario.dt, float) else scenario.dt[:70]
    f = presets.gpb(scenario.motion, scenario.sensor, noise=noise)
    estimate = f(z, Gaussian(mean, tracks.prior.scale_tril), u=u, dt=dt)
    assert not estimate.failed.any()
    assert estimate.nis.isfinite().all()
    error = (estimate.mean - tracks.truth[runs, :70])[..., scenario.position].norm(dim=-1)
    assert (error < 20 * scenario.settings["std"]).all()


# ---------------------------------------------------------------- of any size


MANY, LENGTH, STD, MIDDLE = 20, 40, 2.0, 25
INDEX = 0.1
"""Process noise of a step by the measurement noise, as standard deviations."""
MOTION, SENSOR = ConstantVelocity((INDEX * STD) ** 2, continuous=True), Position(STD)
SIZES = (10.0, 30.0, 1e3, 1e5)
"""Standard deviations of the measurement noise."""


def as_it_believes(confident=1.0):
    """Truth ``(B, T, 4)``, measurements and a prior, all as stated; a confident prior is as much closer."""
    g = torch.Generator().manual_seed(0)
    second = torch.tensor(1.0, dtype=torch.float64)
    F, L = MOTION.transition(second), MOTION.process_noise(second)

    def normal(*shape):
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    spread = confident * torch.tensor([STD, STD, 1.0, 1.0], dtype=torch.float64)
    first = 10 * normal(MANY, 4)
    x, truth = first, []
    for _ in range(LENGTH):
        x = x @ F.mT + normal(MANY, L.shape[-1]) @ L.mT
        truth.append(x)
    truth = torch.stack(truth, 1)
    z = truth[..., :2] + STD * normal(MANY, LENGTH, 2)
    return truth, z, Gaussian(first + spread * normal(MANY, 4), spread.diag())


def ways():
    """A direction for each run."""
    angle = torch.linspace(0, 6, MANY, dtype=torch.float64)
    return torch.stack([angle.cos(), angle.sin()], -1)


def errors(truth, z, prior, **options):
    """Root mean square position errors of each step ``(..., T)``, in standard deviations of the measurement noise."""
    estimate = presets.gpb(MOTION, SENSOR, **options)(z, prior)
    return (estimate.mean - truth)[..., :2].square().sum(-1).mean(-2).sqrt().detach() / STD


def test_spikes_of_any_size_cost_what_they_cost_without_manoeuvres():
    truth, z, prior = as_it_believes()
    z = z.repeat(len(SIZES), 1, 1, 1)
    for step in (6, 7, 15, 20, 22, 30):
        z[:, :, step] += tensor(SIZES)[:, None, None] * STD * ways() * (-1) ** step
    known, some = (errors(truth, z, prior, manoeuvres=m).square().mean(-1).sqrt() for m in ("none", "some"))
    assert (some < 1.02 * known).all()


def followed(motion, burst, seed):
    """Whether each of ``(240, 9)`` measurements that stay elsewhere is, of targets of many kinds.

    They are 100 to 1e5 standard deviations away, at steps of 0.05 to 10 s, indices of 0.01 and 0.1, of targets that
    rest or cover 20 standard deviations in a step.  The belief of jumps stays apart longer where bursts are longer.
    """
    runs, middle, g = 5, 12, torch.Generator().manual_seed(seed)
    kinds = itertools.product((0.05, 1.0, 10.0), (0.01, 0.1), (100.0, 300.0, 1e3, 1e5), (0.0, 20.0))
    dt, index, size, speed = torch.tensor([*kinds], dtype=torch.float64).repeat_interleave(runs, 0).unbind(-1)
    motion = motion(index.square() / dt ** (5 if motion is ConstantAcceleration else 3), continuous=True)

    def normal(*shape):
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    rates = torch.stack([torch.ones_like(dt), 1 / dt, index / dt**2], -1).repeat_interleave(2, -1)[:, : motion.size]
    mean = torch.zeros_like(rates)
    mean[:, 2] = STD * speed / dt
    x, path = mean + STD * rates * normal(*rates.shape), []
    F, L = motion.transition(dt), STD * motion.process_noise(dt)
    for _ in range(middle + 9):
        x = (F @ x.unsqueeze(-1) + L @ normal(len(dt), L.shape[-1], 1)).squeeze(-1)
        path.append(x[:, :2])
    path = torch.stack(path, 1)
    angle = 6.28 * torch.rand(len(dt), generator=g, dtype=torch.float64)
    z = path + STD * normal(*path.shape)
    z[:, middle:] += (STD * size * torch.stack([angle.cos(), angle.sin()])).mT.unsqueeze(1)
    motion.q.set(STD**2 * motion.q().detach(), "q")
    durations = (*presets.regimes.MANOEUVRES["some"]["durations"][:-1], max(2.0, 2 * burst - 6))
    estimate = presets.gpb(motion, Position(STD), burst=burst, durations=durations)(
        z, Gaussian(mean, STD * torch.diag_embed(rates)), dt=dt.unsqueeze(-1).expand(-1, z.shape[1])
    )
    error = (estimate.mean[..., :2] - path)[:, middle:].norm(dim=-1)
    return error > 0.5 * STD * size.unsqueeze(-1)


@pytest.mark.parametrize(("motion", "burst", "seed"), [
    (ConstantVelocity, 4.0, 1), pytest.param(ConstantAcceleration, 4.0, 2, marks=pytest.mark.slow),
    *(pytest.param(ConstantVelocity, burst, 3, marks=pytest.mark.slow) for burst in (2.0, 3.0, 7.0)),
])  # fmt: skip
def test_as_many_equal_outliers_as_stated_are_a_burst_and_one_more_makes_them_a_jump(motion, burst, seed):
    far = followed(motion, burst, seed)
    assert far[:, : int(burst)].double().mean() < 0.002
    assert far[:, int(burst)].double().mean() > 0.97
    assert far[:, int(burst) + 1 :].double().mean() > 0.995


def test_after_a_jump_it_is_as_near_as_before():
    truth, z, prior = as_it_believes()
    plain, away = errors(truth, z, prior), 1e3 * STD * ways().unsqueeze(1)
    z[:, MIDDLE:] += away
    truth[:, MIDDLE:, :2] += away
    assert (errors(truth, z, prior)[MIDDLE + 5 :] < 2.5 * plain[MIDDLE + 5 :]).all()


@pytest.mark.parametrize("confident", [0.05, 1.0])
def test_a_prior_that_is_off_by_any_distance_is_left_within_three_measurements(confident):
    truth, z, prior = as_it_believes(confident)
    off = torch.cat([ways(), ways()], -1) @ prior.scale_tril.mT
    away = tensor([250.0, 2500.0, 25000.0])[:, None, None]
    found = errors(truth, z, Gaussian(prior.mean + away * off, prior.scale_tril))
    assert (found[:, 2:] < 1.5 * 2**0.5).all()  # of a fix alone it is the root of 2


def test_an_outlier_after_a_confident_prior_costs_no_more_than_one_later():
    truth, z, prior = as_it_believes(0.05)
    sizes, steps = tensor(SIZES[:-1]), (0, 1, 2, MIDDLE)
    hit = z.repeat(1 + len(steps), len(sizes), 1, 1, 1)
    for of, step in zip(hit[1:], steps, strict=True):
        of[:, :, step] += sizes[:, None, None] * STD * ways()
    plain, *found = errors(truth, hit, prior)
    *early, later = ((of / plain)[:, step] for of, step in zip(found, steps, strict=True))
    assert (torch.stack(early) < 1.05 * later).all()


@pytest.mark.parametrize("size", [1e3, 1e4])
def test_a_target_that_was_carried_elsewhere_may_move_as_fast_in_another_direction(size):
    truth, z, prior = as_it_believes()
    speed, turned = 30 * STD * ways(), 30 * STD * ways().flip(-1)
    seconds = torch.arange(1.0, LENGTH + 1, dtype=torch.float64).reshape(-1, 1)
    since = (seconds - MIDDLE).clamp_min(0.0)
    moved = (seconds - since) * speed.unsqueeze(1) + since * turned.unsqueeze(1)
    moved = moved + size * STD * ways().unsqueeze(1) * (since > 0)
    start = torch.cat([torch.zeros_like(speed), speed], -1)
    found = errors(truth + torch.cat([moved, moved], -1), z + moved, Gaussian(prior.mean + start, prior.scale_tril))
    assert (found[MIDDLE + 7 :] < 3).all()


def test_a_turn_beyond_all_noise_is_hardly_ever_lost_for_eight_measurements_though_there_are_spikes_in_it():
    cell = OpenCell("spikes", index=0.012, turn=True, share=0.03, size=100.0)
    scenario = cell.scenario(steps=80)
    tracks = scenario.simulate(200, 7)
    estimate = presets.gpb(scenario.motion, scenario.sensor)(tracks.z, tracks.prior, dt=scenario.dt)
    far = (estimate.mean - tracks.truth)[..., :2].norm(dim=-1) > 6 * cell.std
    assert far[:, 26:40].any()  # it is beyond all noise
    assert far.unfold(-1, 8, 1).all(-1).any(-1).double().mean() < 0.06


def test_outliers_that_follow_each_other_take_no_vehicle_with_them_whose_way_is_measured():
    cell = OpenCell("half", motion="gyroscope", sensor="radar", index=0.3, dt=30.0, spacing="mixed", size=1e6)
    scenario = cell.scenario()
    tracks = scenario.simulate(40, 2)
    estimate = presets.gpb(scenario.motion, scenario.sensor)(tracks.z, tracks.prior, u=tracks.u, dt=scenario.dt)
    assert (estimate.mean - tracks.truth)[..., :2].norm(dim=-1).max() < 100 * cell.std


def test_a_confused_start_does_not_take_a_heading_away():
    scenario = OpenCell("half", motion="gyroscope", size=2000.0, index=0.3, one_sided=True).scenario(steps=30)
    tracks = scenario.simulate(20, 1)
    estimate = presets.gpb(scenario.motion, scenario.sensor)(tracks.z, tracks.prior, u=tracks.u, dt=scenario.dt)
    off = (estimate.mean - tracks.truth)[..., :2].norm(dim=-1)
    assert (off[:, -10:].mean(-1) < 20 * scenario.sensor.std()).all()


def test_two_far_outliers_on_one_side_at_the_beginning_hardly_pull_the_estimate():
    g, runs, steps = torch.Generator().manual_seed(5), 200, 12
    prior = Gaussian(torch.zeros(4, dtype=torch.float64), torch.diag(tensor([2, 2, 1, 1])))
    first = torch.randn(runs, 4, generator=g, dtype=torch.float64) @ prior.scale_tril
    truth = first[:, None, :2] + first[:, None, 2:] * torch.arange(1.0, steps + 1)[:, None]
    z = truth + torch.randn(truth.shape, generator=g, dtype=torch.float64)
    angle = torch.rand(runs, 2, generator=g, dtype=torch.float64) * torch.pi / 2
    z[:, :2] += 1e5 * torch.stack([angle.cos(), angle.sin()], -1)
    e = presets.gpb(ConstantVelocity(1e-4, continuous=True), Position(1.0))(z, prior)
    assert (e.mean[..., :2] - truth).norm(dim=-1).max() < 20


def test_three_outliers_at_the_beginning_that_disagree_are_no_prior_that_is_off():
    """With a wide acceleration any three places would agree, where the third comes later."""
    scenario = OpenCell(motion="acceleration", index=0.015, dt=4.0).scenario(steps=40)
    tracks, steps = scenario.simulate(100, 1), [0, 1, *range(12, 20)]
    dt = torch.full((len(steps),), 4.0, dtype=torch.float64)
    dt[2] = 44.0
    z, truth = tracks.z[:, steps].clone(), tracks.truth[:, steps, :2]
    angle = 6.28 * torch.rand(100, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    z[:, :3] += 3e4 * torch.stack([angle.cos(), angle.sin()], -1)
    found = presets.gpb(scenario.motion, scenario.sensor)(z, tracks.prior, dt=dt).mean
    assert (found[..., :2] - truth).norm(dim=-1).max() < 3000


# ---------------------------------------------------------------- steps without any measurement


FIXES = Position(2.0)
CONTINUOUS = {"one motion": ConstantVelocity(1.0, continuous=True),
           "bank": [ConstantAcceleration(q, continuous=True) for q in (0.1, 4.0)]}  # fmt: skip
every_motion = pytest.mark.parametrize("motion", CONTINUOUS)
TARGETS, SPAN, TURN = 60, 40, 20


def turning(jump):
    """True positions of targets that change their velocity by so much at a step, measurements, and a prior."""
    rng = torch.Generator().manual_seed(5)
    noise = [torch.randn(*shape, 2, dtype=torch.float64, generator=rng) for shape in ((TARGETS, 1), (TARGETS, SPAN))]
    velocity = (10 * noise[0]).expand(TARGETS, SPAN, 2).clone()
    velocity[:, TURN:] += jump * noise[0].flip(-1) / noise[0].norm(dim=-1, keepdim=True)
    truth = velocity.cumsum(1)
    mean = torch.cat([torch.zeros(TARGETS, 2).double(), velocity[:, 0]], -1)
    return truth, truth + 2 * noise[1], Gaussian(mean, 5 * torch.eye(4, dtype=torch.float64))


def padded(z, rows):
    """The same with so many rows of NaN before each measurement."""
    every = torch.full((len(z), (rows + 1) * z.shape[1], 2), torch.nan, dtype=torch.float64)
    every[:, rows :: rows + 1] = z
    return every


def rmse(mean, truth):
    """Of the position, at each step."""
    return (mean[..., :2] - truth).square().sum(-1).mean(0).sqrt()


def at_rest(motion):
    n = 4 if motion == "one motion" else 6
    return Gaussian(torch.zeros(2, n).double(), 5 * torch.eye(n).double())


def after_some(f, motion):
    """A state that is in doubt: its last measurement may be an outlier."""
    z = torch.zeros(2, 6, 2, dtype=torch.float64)
    z[:, -1] = torch.tensor([[9.0, 0.0], [40.0, 30.0]])
    state = f.init(at_rest(motion))
    for now in z.unbind(1):
        state, _ = f.step(state, now)
    return state


NOTHING = torch.full((2, 2), torch.nan, dtype=torch.float64)


def lasting(f, state):
    """Logs of the probabilities of regimes: a jump and what follows it are one, whose parts are the same every step."""
    others, jumped = state.log_weights.tensor_split([f.regimes.kinds.index("jump")], -1)
    return torch.cat([others, jumped.logsumexp(-1, keepdim=True)], -1)


# ---------------------------------------------------------------- until the next measurement


@pytest.mark.slow
@pytest.mark.parametrize(("jump", "rows"), [(5.0, 3), (20.0, 1)])
def test_a_target_that_turns_is_found_again_on_a_finer_grid_of_time_too(jump, rows):
    truth, z, prior = turning(jump)
    f = presets.gpb(CONTINUOUS["one motion"], FIXES)
    fine = rmse(f(padded(z, rows), prior, dt=1 / (rows + 1)).mean[:, rows :: rows + 1], truth)
    plain = rmse(f(z, prior).mean, truth)
    assert (
        fine[2:] < 1.3 * torch.stack([plain[2:], plain[1:-1], plain[:-2]]).amax(0) + 1
    ).all()  # two steps later at most
    assert fine[-1] < 4


@every_motion
def test_both_readings_of_a_doubtful_measurement_wait_for_the_next(motion):
    f = presets.gpb(CONTINUOUS[motion], FIXES)
    before = state = after_some(f, motion)
    for _ in range(3):
        state, _ = f.step(state, NOTHING)
    share = [x.log_weights.exp().sum(-1) for x in (before, state)]
    torch.testing.assert_close(*share, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(state.outlier, before.outlier, rtol=0, atol=0)
    gap = (state.hypotheses.mean[1, 0, 0] - state.hypotheses.mean[1, 1, 0])[:2].norm()
    assert gap > 10


def test_of_one_motion_the_regimes_wait_too_if_they_count_steps():
    f = presets.gpb(CONTINUOUS["one motion"], FIXES, self_transition=(0.998, 0.998, 0.999, 0.87, 0.95, 0.7, 0.96, 0.06))
    before = after_some(f, "one motion")
    state, _ = f.step(before, NOTHING)
    torch.testing.assert_close(lasting(f, state), lasting(f, before), rtol=1e-10, atol=1e-10)


def test_other_motions_of_a_bank_may_begin_so_that_less_is_known_the_longer_a_gap_is():
    f = presets.gpb(CONTINUOUS["bank"], FIXES)
    first = f.regimes.kinds.index("motion")
    last = first + f.regimes.motions - 1
    state = after_some(f, "bank")
    shares = []
    for _ in range(4):
        shares.append(state.log_weights.exp().sum(-2)[..., first:last].sum(-1))
        state, _ = f.step(state, NOTHING)
    assert (torch.stack(shares).diff(dim=0) > 0).all()


def test_a_poor_start_is_not_forgotten_before_the_first_measurement():
    f = presets.gpb(CONTINUOUS["one motion"], FIXES, prior_outlier=0.3)
    state, _ = f.step(f.init(at_rest("one motion")), NOTHING)
    assert state.log_weights[..., 1, :].exp().sum(-1) == pytest.approx(0.3)


@pytest.mark.slow
def test_what_is_not_measured_is_no_outlier():
    _, z, prior = turning(20.0)
    z = z[:, :14]
    z[:, 10] += 300
    z[:, 11] = torch.nan
    f = presets.gpb(CONTINUOUS["one motion"], FIXES)
    for e in (f(z, prior), f.smooth(z, prior)):
        outlier = e.info.outlier[..., 0]
        assert (outlier[:, 10] > 0.99).all()
        assert (outlier[:, 11] == 0).all()


# ---------------------------------------------------------------- no time


@every_motion
def test_a_step_of_no_time_without_a_measurement_changes_nothing(motion):
    f = presets.gpb(CONTINUOUS[motion], FIXES)
    before = after_some(f, motion)
    state, _ = f.step(before, NOTHING, dt=0.0)
    for name in ("belief", "hypotheses"):
        a, b = getattr(state, name), getattr(before, name)
        torch.testing.assert_close(a.mean, b.mean, rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(a.covariance, b.covariance, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(lasting(f, state), lasting(f, before), rtol=1e-10, atol=1e-10)


# ---------------------------------------------------------------- later


@pytest.mark.slow
def test_smoothed_it_is_as_near_the_truth():
    truth, z, prior = turning(20.0)
    f = presets.gpb(CONTINUOUS["one motion"], FIXES)
    plain, fine = rmse(f.smooth(z, prior).mean, truth), rmse(f.smooth(padded(z, 1), prior, dt=0.5).mean[:, 1::2], truth)
    assert (fine < 1.3 * plain + 1).all()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@every_motion
def test_smoothed_gradients_are_finite_however_far_off_a_measurement_is(motion, dtype):
    z = torch.zeros(2, 9, 2, dtype=dtype)
    z[:, 3], z[:, 5] = 1000.0, torch.nan
    f = presets.gpb(CONTINUOUS[motion], FIXES, learn="all")
    e = f.smooth(z, Gaussian(*(x.to(dtype) for x in at_rest(motion))))
    (e.mean.square().mean() + e.log_likelihood.mean()).backward()
    assert all(p.grad.isfinite().all() for p in f.parameters())


@pytest.mark.parametrize("separate_levels", [0, 1])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_gradients_of_targets_that_are_always_detected_are_finite_however_far_off_they_are(dtype, separate_levels):
    start = torch.tensor([[0.0, 0, 1, 0], [5000, 0, 1, 0]], dtype=dtype)
    noise = torch.randn(8, 2, 2, generator=torch.Generator().manual_seed(0)).to(dtype)
    z = start[:, :2] + torch.arange(1, 9)[:, None, None] * start[:, 2:] + noise
    z[3:, 0] += 900
    z[4] = torch.nan
    inner = partial(presets.gpb, separate_levels=separate_levels)
    f = presets.jpda(ConstantVelocity(1.0), Position(1.0), clutter=Clutter(1e12, rate=0.01), inner=inner,
                     gate=Euclidean(2000.0), detection=1.0, learn=["q"])  # fmt: skip
    e = f(z, Gaussian(start, torch.diag(torch.tensor([5.0, 5, 2, 2], dtype=dtype))))
    e.mean.square().mean().backward()
    assert all(p.grad.isfinite().all() for p in f.parameters())
