"""Never locked out, never blown up: GPB has left behind what went wrong five measured steps later; jumps later."""

import functools
import math

import pytest
import torch

from torchfra import metrics, presets, scenarios, tree
from torchfra.motion import ConstantAcceleration, aircraft
from torchfra.sensors import Bearings, Position, RangeBearing, Ranges
from torchfra.types import Gaussian
from train.gpb.regimes import regimes

RUNS, STEPS = 5, 240
BOUND = 13.816
"""99.9 % of chi-square with 2 degrees of freedom."""
RECOVERED = 5
"""Measured steps after which all must be well again."""
LATER = {"position": 1, "ranges": 0, "radar": 3, "bearings": 20}
"""Steps more after a jump, which is a burst of outliers until it lasts; two bearings tell little of a position."""


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

COVERS = "test_a_bank_covers_99_percent_of_the_steps"
CALM = "a bank's calm is so calm that it misses the beginning of some turns"
OPEN = {f"{COVERS}[{sensor}]": CALM for sensor in SENSORS if sensor != "position"}
"""What its values do not reach on these five runs, and why; on others, of positions too, they cover 98.7 to 99.2 %."""


@pytest.fixture(autouse=True)
def still_open(request):
    """Tests of those claims must fail: one that passes is to be taken off the list."""
    if request.node.name in OPEN:
        request.applymarker(pytest.mark.xfail(strict=True, reason=OPEN[request.node.name]))


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


def check(motion, sensor, case, since, recovered=RECOVERED):
    """Finite; well from the measured step on in which it has to be; its covariance covers what happened otherwise."""
    truth, _, _, e = estimates(motion, sensor)[case]
    usual = usual_error(motion, sensor)
    assert not e.failed.any()
    assert all(x.isfinite().all() for of in (e.info.filtered, e.info.lagged) for x in of)
    assert well(e, truth, usual)[:, since + recovered - 1 :].all()
    covered = (nees(e, truth) < BOUND).double()
    assert torch.cat([covered[:, :since], covered[:, since + recovered - 1 :]], 1).mean() > COVERED[motion]
    return e, truth, usual


@pytest.mark.slow
@every_pair
def test_nothing_is_wrong(sensor, motion):
    e, truth, usual = check(motion, sensor, nothing, 0)
    assert (e.mean - truth)[:, 20:, :2].norm(dim=-1).square().mean().sqrt() < 1.1 * usual


@pytest.mark.slow
@pytest.mark.parametrize("sensor", SENSORS)
def test_a_bank_covers_99_percent_of_the_steps(sensor):
    truth, _, _, e = estimates("bank", sensor)[nothing]
    assert (nees(e, truth) < BOUND).double().mean() > COVERED["one motion"]


@pytest.mark.slow
def test_a_bank_that_leaves_its_calm_more_easily_does():
    truth, stay = flight(), (0.98, 0.98, 0.925, 0.969, 0.7, 0.99924, 0.00413)
    e = presets.gpb(aircraft(), SENSORS["bearings"], self_transition=stay)(
        measured(SENSORS["bearings"], truth), start(truth)
    )
    assert (nees(e, truth) < BOUND).double().mean() > COVERED["one motion"]


@every_pair
def test_half_a_minute_without_any_measurement(sensor, motion):
    check(motion, sensor, silence, 130)


@every_pair
def test_a_target_that_jumps_by_a_hundred_sigma_and_stays(sensor, motion):
    check(motion, sensor, jump, 120, RECOVERED + LATER[sensor])


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
        for name, options in (("rsrckf", {}), ("gpb", {"noise": "learned"}))
        for f in [getattr(presets, name)(ConstantAcceleration(0.3), sensor, **options).compile()]
    }
    assert rmse["gpb"] < rmse["rsrckf"]
