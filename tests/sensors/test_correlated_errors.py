"""Time-correlated errors are one argument of any sensor: exact where all is linear, with every preset."""

import math

import numpy as np
import pytest
import torch
from irregular import DT, F64, MOTION, PRIOR, close, measured
from oracles.lasting import lasting_errors

import torchfra
from torchfra import Gaussian, presets
from torchfra.catalogue import FILTERS
from torchfra.motion import ConstantVelocity, CoordinatedTurn, Odometry, aircraft
from torchfra.scenarios import clutter_crossing
from torchfra.sensors import Biased, Correlated, Position, RangeBearing, Ranges, Stacked
from torchfra.stream import Tracker

STD, TIME = torch.tensor([3.0, 5.0], **F64), torch.tensor([20.0, 6.0], **F64)


def by_oracle(z, std, time, white=1.5):
    matrices = [MOTION.transition(dt).numpy() for dt in DT]
    noises = [(root @ root.mT).numpy() for root in map(MOTION.process_noise, DT)]
    std, time = (np.broadcast_to(np.asarray(x, dtype=float), 2) for x in (std, time))
    return lasting_errors(
        z.numpy(), PRIOR.mean.numpy(), PRIOR.covariance.numpy(), matrices, noises, np.eye(2, 4), white**2 * np.eye(2),
        DT.numpy(), std, time,
    )  # fmt: skip


@pytest.mark.parametrize(("std", "time"), [(3.0, 20.0), (STD, TIME), (STD, 20.0)], ids=["same", "each", "one time"])
def test_estimates_are_those_of_one_large_gaussian_without_a_state_for_errors(std, time):
    f, z = presets.srckf(MOTION, Correlated(Position(1.5), std, time)), measured()
    r = by_oracle(z, std, time)
    filtered, smoothed = f(z, PRIOR, dt=DT), f.smooth(z, PRIOR, dt=DT)
    close(filtered.mean, r["mean"])
    close(filtered.covariance, r["P"])
    close(smoothed.mean, r["smoothed_mean"])
    close(smoothed.covariance, r["smoothed_P"])
    close(filtered.log_likelihood.sum(), r["log_likelihood"])


TRACKS = [name for name, entry in FILTERS.items() if not entry.scans and not entry.constant_gains]


@pytest.mark.parametrize("name", TRACKS)
def test_every_preset_of_single_targets_takes_errors_that_last_and_keeps_the_targets_states(name):
    turns = [ConstantVelocity(0.3), CoordinatedTurn(0.1, 0.3), CoordinatedTurn(-0.1, 0.3)]
    bank = torchfra.motion.Bank(turns, neighbours=((1, 2), (0,), (0,)), first=(0, 1, 2))
    motion = bank if FILTERS[name].bank else MOTION
    preset, z = FILTERS[name].preset, measured(2)[:, :4]
    with_errors = preset(motion, Correlated(Position(1.5), 3.0, 20.0))(z, PRIOR, dt=DT[:4])
    plain = preset(motion, Position(1.5))(z, PRIOR, dt=DT[:4])
    assert with_errors.mean.shape == plain.mean.shape == (2, 4, 4)
    assert (with_errors.covariance[:, 1, :2, :2].diagonal(dim1=-2, dim2=-1) > 4).all()  # more than white errors leave


@pytest.mark.parametrize("name", ["srckf", "rsrckf", "gpb", "fra"])
def test_errors_of_no_size_change_nothing(name):
    preset, z = FILTERS[name].preset, measured(2)[:, :4]
    without = preset(MOTION, Correlated(Position(1.5), 0.0, 20.0))
    plain = preset(MOTION, Position(1.5))
    close(without(z, PRIOR, dt=DT[:4]).mean, plain(z, PRIOR, dt=DT[:4]).mean)


def test_step_by_step_it_is_the_same_and_beliefs_are_the_targets():
    f, z = presets.gpb(MOTION, Correlated(Position(1.5), 3.0, 20.0)), measured()
    estimate, state = f(z, PRIOR, dt=DT), f.init(PRIOR)
    for k, dt in enumerate(DT):
        state, innovation = f.step(state, z[k], dt=dt)
        close(state.belief.mean, estimate.mean[k])
    close(innovation.alarm.probability, estimate.info.alarm.probability[-1])


def test_a_forecast_of_a_measurement_has_the_error_that_is_known_to_last():
    f = presets.srckf(MOTION, Correlated(Position(0.1), 30.0, 1000.0))
    sure = Gaussian(PRIOR.mean, 0.01 * torch.eye(4, **F64))
    state, _ = f.step(f.init(sure), torch.tensor([54.0, 2.0], **F64), dt=1.0)  # it should be at 4, 2
    forecast = f.predict(state, 1.0)
    close(forecast.belief.mean[:2], [7.0, 6.0], 0.1)
    close(forecast.measurement.mean, [57.0, 6.0], 1.0)
    assert forecast.belief.mean.shape == (4,)


def test_a_tracker_takes_it_among_other_sensors():
    gps, radar = Correlated(Position(1.0), 3.0, 60.0), RangeBearing(torch.tensor([3.0, 0.02], **F64))
    t = Tracker(presets.gpb(MOTION, gps), PRIOR, sensors={"gps": gps, "radar": radar}, lag=5.0)
    t.update(1.0, [4.0, 2.0], "gps")
    t.update(2.0, [9.0, 0.9], "radar")
    report = t.update(1.5, [5.5, 4.0], "gps")
    assert report.outcome == "late"
    assert report.belief.mean.shape == (4,)
    assert set(t.alarms) == {"gps", "radar"}


def test_one_of_stacked_sensors_may_have_errors_that_last():
    both = Stacked(Position(1.5), Correlated(Position(1.5), STD, TIME))
    z = torch.cat([torch.full_like(measured(), torch.nan), measured()], -1)
    f = presets.srckf(MOTION, both)
    close(f(z, PRIOR, dt=DT).mean, by_oracle(measured(), STD, TIME)["mean"])


def test_a_motion_that_measures_itself_among_ranges_whose_errors_last():
    anchors = torch.tensor([[0.0, 0.0], [30.0, 0.0], [0.0, 30.0]], **F64)
    f = presets.gpb(Odometry(1e-2, 1e-6, 1e-7), Correlated(Ranges(anchors, 0.3), 1.0, 30.0))
    prior = Gaussian(torch.tensor([5.0, 5, 0, 0], **F64), torch.tensor([1.0, 1, 0.1, 0.02], **F64).diag())
    z = (torch.stack([torch.arange(5.0, 9.0), torch.full((4,), 5.0)], -1).double()[:, None] - anchors).norm(dim=-1)
    estimate = f(z, prior, u=torch.tensor([1.0, 0.0], **F64).expand(4, 2))
    close(estimate.mean[-1, :2], [8.0, 5.0], 0.7)


@pytest.mark.slow
def test_size_and_duration_are_learned_from_measurements_alone():
    rng, keeps = torch.Generator().manual_seed(5), math.exp(-1 / 15)
    error, z = 4 * torch.randn(30, 2, generator=rng, **F64), []
    for _ in range(80):
        error = keeps * error + 4 * math.sqrt(1 - keeps**2) * torch.randn(30, 2, generator=rng, **F64)
        z.append(error + torch.randn(30, 2, generator=rng, **F64))
    still = ConstantVelocity(1e-9, continuous=True)
    prior = Gaussian(torch.zeros(4, **F64), torch.tensor([1e-3, 1e-3, 1e-5, 1e-5], **F64).diag())
    f = presets.srckf(still, Correlated(Position(2.0), 2.0, 60.0))
    data = {"z": torch.stack(z, 1), "prior": prior}
    fitted = torchfra.fit(f, data, learn=("std", "time"), iterations=12, compile=True, seed=3, quiet=True)
    (learned,) = fitted.filter.errors
    assert 3.5 < learned.std() < 4.5
    assert 11 < learned.time() < 20
    assert 0.9 < fitted.filter.sensor.std() < 1.1


BAD = [
    (lambda: Correlated(Position(1.0), -1.0, 60.0), r"std: expected a value of 0 or more, received -1"),
    (lambda: Correlated(Position(1.0), 3.0, 0.0), r"time: expected a value above 0, received 0"),
    (lambda: Correlated(Position(1.0), 3.0, -5.0), r"time: expected a value above 0, received -5"),
    (lambda: Correlated(Position(1.0), torch.ones(3), 5.0), r"std: expected a number or \(2,\), received \(3,\)"),
    (lambda: Correlated(MOTION, 3.0, 60.0), r"sensor: expected a sensor without time-correlated errors, rec"),
    (lambda: Correlated(Correlated(Position(1.0), 3.0, 60.0), 3.0, 60.0), r"sensor: expected a sensor without"),
    (lambda: torchfra.filters.SRCKF(MOTION, Correlated(Position(1.0), 3.0, 60.0)), r"sensor: expected one without"),
    (lambda: presets.alphabeta(MOTION, Correlated(Position(1.0), 3.0, 60.0)), r"sensor: expected"),
    (lambda: presets.srckf(MOTION, Biased(Correlated(Position(1.0), 3.0, 60.0), 2)), r"sensor: expected one without"),
    (lambda: presets.srckf(MOTION, Correlated(Position(1.0), 3.0, 60.0)).other_sensor(
        Correlated(Position(1.0), 3.0, 60.0)), r"sensor: expected one without time-correlated errors"),
    (lambda: presets.gpb(MOTION, Stacked(Correlated(Position(1.0), 3.0, 60.0), Position(1.0)))(
        torch.zeros(2, 4, **F64), PRIOR, noise=torch.ones(2, 4, 4, **F64).tril()), r"noise: expected noise that is"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "message"), BAD)
def test_what_it_cannot_be_is_refused_by_name(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_filters_of_several_targets_refuse_errors_that_last():
    scenario = clutter_crossing()
    with pytest.raises(ValueError, match="sensor: expected one without time-correlated errors"):
        presets.jpda(scenario.motion, Correlated(scenario.sensor, 3.0, 60.0), clutter=scenario.clutter, detection=0.9)


@pytest.mark.parametrize("name", ["asrckf", "fra"])
def test_rounding_errors_decide_no_fading_factor_where_a_turn_determines_its_acceleration(name):
    f = getattr(presets, name)(aircraft()[3], Correlated(Position(1.0), std=3.0, time=10.0))
    generator = torch.Generator().manual_seed(7)
    mean, z = (torch.randn(*shape, **F64, generator=generator) for shape in ((6,), (8, 2)))
    prior = Gaussian(5 * mean, torch.tensor([9.0, 7.0, 5.0, 6.0, 2.0, 1.0], **F64).diag())
    one, other = (f(20 * z + change, prior).mean for change in (0.0, 1e-12))
    assert (one - other).abs().max() < 1e-9
