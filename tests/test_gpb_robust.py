"""Never locked out, never blown up: GPB with its defaults has left behind what went wrong five measured steps later."""

import math

import pytest
import torch

from torchfra import metrics, presets, scenarios
from torchfra.motion import ConstantAcceleration, aircraft
from torchfra.sensors import Bearings, Position, RangeBearing, Ranges
from torchfra.types import Gaussian
from train.regimes import regimes

RUNS, STEPS = 10, 240
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
MOTIONS = {"one motion": lambda: ConstantAcceleration(4.0), "bank": aircraft}
START = torch.diag(tensor([30, 30, 5, 5, 1, 1]))

COVERED = {"one motion": 0.99, "bank": 0.975}
"""Share of steps whose NEES is below the bound, as the values reach it; what is asked of a bank too is a test below."""

JUMP = "test_a_target_that_jumps_by_a_hundred_sigma_and_stays"
SHORT = "by bearings it jumps from near the line between the stations, where they tell little of the place along it"
OPEN = {
    f"{JUMP}[radar-one motion]": "one run in ten takes a step more",
    f"{JUMP}[bearings-one motion]": SHORT,
    f"{JUMP}[bearings-bank]": SHORT,
}
"""What its values do not reach yet, and why."""


@pytest.fixture(autouse=True)
def still_open(request):
    """Tests of those claims must fail: one that passes is to be taken off the list."""
    if request.node.name in OPEN:
        request.applymarker(pytest.mark.xfail(strict=True, reason=OPEN[request.node.name]))


every_motion = pytest.mark.parametrize("motion", MOTIONS)
every_sensor = pytest.mark.parametrize("sensor", SENSORS)


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


def check(motion, name, truth, z, prior, since):
    """Finite; well from the fifth measured step on; and its covariance covers what happened."""
    sensor = SENSORS[name]
    e = presets.gpb(MOTIONS[motion](), sensor)(z, prior)
    usual = (presets.srckf(ConstantAcceleration(4.0), sensor)(measured(sensor, flight()), start(flight())).mean
             - flight())[:, 20:, :2].norm(dim=-1).square().mean().sqrt()  # fmt: skip
    assert not e.failed.any()
    assert all(x.isfinite().all() for of in (e.info.filtered, e.info.settled) for x in of)
    assert well(e, truth, usual)[:, since + RECOVERED - 1 :].all()
    assert (nees(e, truth) < BOUND).double().mean() > COVERED[motion]
    return e, usual


@every_motion
@every_sensor
def test_nothing_is_wrong(sensor, motion):
    truth = flight()
    e, usual = check(motion, sensor, truth, measured(SENSORS[sensor], truth), start(truth), 0)
    assert (e.mean - truth)[:, 20:, :2].norm(dim=-1).square().mean().sqrt() < 1.1 * usual


@every_sensor
@pytest.mark.xfail(strict=True, reason="a bank's calm is so calm that it misses the beginning of some turns")
def test_a_bank_covers_99_percent_of_the_steps(sensor):
    truth = flight()
    e = presets.gpb(aircraft(), SENSORS[sensor])(measured(SENSORS[sensor], truth), start(truth))
    assert (nees(e, truth) < BOUND).double().mean() > COVERED["one motion"]


def test_a_bank_that_leaves_its_calm_more_easily_does():
    truth, stay = flight(), (0.98, 0.28, 0.9988, 0.0013)
    e = presets.gpb(aircraft(), SENSORS["bearings"], stay=stay)(measured(SENSORS["bearings"], truth), start(truth))
    assert (nees(e, truth) < BOUND).double().mean() > COVERED["one motion"]


@every_motion
@every_sensor
def test_half_a_minute_without_any_measurement(sensor, motion):
    truth = flight()
    z = measured(SENSORS[sensor], truth)
    z[:, 100:130] = torch.nan
    check(motion, sensor, truth, z, start(truth), 130)


@every_motion
@every_sensor
def test_a_target_that_jumps_by_a_hundred_sigma_and_stays(sensor, motion):
    truth = flight()
    truth[:, 120:, :2] += 100 * SIGMA[sensor] * tensor([0.6, 0.8])
    check(motion, sensor, truth, measured(SENSORS[sensor], truth), start(truth), 120)


@every_motion
@every_sensor
def test_a_start_that_is_three_kilometres_off(sensor, motion):
    truth = flight()
    check(motion, sensor, truth, measured(SENSORS[sensor], truth), start(truth, 3000.0), 0)


@every_motion
@pytest.mark.parametrize("wrong", ["anew", "the same"])
def test_half_of_the_elements_wrong_for_a_minute(wrong, motion):
    truth = flight()
    z = measured(SENSORS["ranges"], truth)
    off = torch.rand(RUNS, 60, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    z[:, 100:160, :2] += 300 * off if wrong == "anew" else tensor([300.0, 200.0])
    e, usual = check(motion, "ranges", truth, z, start(truth), 160)
    assert (e.info.outlier[:, 105:160, :2].mean((0, 1)) > 0.8).all()
    assert (e.info.outlier[:, 105:160, 2:].mean((0, 1)) < 0.2).all()
    assert (e.mean - truth)[:, 100:160, :2].norm(dim=-1).median() < 3 * usual


@every_motion
@pytest.mark.parametrize("sensor", ["position", "radar", "ranges"])
def test_one_fix_that_is_thousands_of_kilometres_off(sensor, motion):
    truth = flight()
    z, elsewhere = measured(SENSORS[sensor], truth), truth[:, 120].clone()
    elsewhere[:, 0] += 3.6e6
    z[:, 120] = SENSORS[sensor](elsewhere)
    e, usual = check(motion, sensor, truth, z, start(truth), 120)
    assert (nees(e, truth)[:, 120] < 25).all()
    assert well(e, truth, usual)[:, 120:].all()
    assert ((e.mean - truth)[:, 121, :2].norm(dim=-1) < 5 * usual).all()


@every_motion
@every_sensor
def test_bursts_of_four_measurements_at_ten_sigma(sensor, motion):
    truth = flight()
    z, quiet = measured(SENSORS[sensor], truth), SENSORS[sensor](truth)
    starts = torch.rand(RUNS, STEPS, generator=torch.Generator().manual_seed(4)) < 0.0125
    inside = torch.stack([starts.roll(k, 1) for k in range(4)]).any(0)
    inside[:, :10] = False
    noisy = quiet + torch.where(inside.unsqueeze(-1), 10.0, 1.0) * (z - quiet)
    e, usual = check(motion, sensor, truth, noisy, start(truth), STEPS)
    plain = presets.srckf(ConstantAcceleration(4.0), SENSORS[sensor])(noisy, start(truth))
    error, loose = ((x.mean - truth)[:, 20:, :2].norm(dim=-1).square().mean().sqrt() for x in (e, plain))
    assert error < 0.7 * loose
    assert error < 1.6 * usual


def test_covariances_are_honest_where_targets_do_what_it_believes():
    known = {"levels": (1.0, 100.0), "stay": (0.94, 0.8, 0.5, 0.1), "renew": (5 / 9, 4 / 9 - 2e-9, 1e-9, 1e-9),
             "qualities": ((0.97, 0.03), (0.4, 0.6)), "sizes": (100.0,), "shares": (1.0,), "grows": False, "poor": 1e-6,
             "start": 1.0}  # fmt: skip
    scenario = regimes()
    tracks = scenario.simulate(runs=200, seed=4242)
    e = presets.gpb(scenario.motion, scenario.sensor, **known)(tracks.z, tracks.prior)
    for of, size in ((slice(0, 2), 2), (slice(0, 6), 6)):
        assert 0.9 * size < metrics.nees(e, tracks.truth, of).mean() < 1.1 * size


def test_a_poor_start_is_none_of_a_parameter_that_acts_exponentially():
    scenario = scenarios.reentry()
    tracks = scenario.simulate(20, 3)
    f = presets.gpb(scenario.motion, scenario.sensor)
    estimate = f(tracks.z, tracks.prior, u=tracks.u)
    assert not estimate.failed.any()
    plain = presets.srckf(scenario.motion, scenario.sensor)(tracks.z, tracks.prior, u=tracks.u)
    errors = [(e.mean - tracks.truth)[..., scenario.position].norm(dim=-1).mean(-1) for e in (estimate, plain)]
    assert (errors[0] < 2 * errors[1]).all()
