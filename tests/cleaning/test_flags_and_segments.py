"""What a step was, and when a manoeuvre began and ended, is said as the probabilities and the smoothed path have it."""

import numpy as np
import pytest

from torchfra.cleaning.flags import flags
from torchfra.cleaning.segments import segments

NAN = np.nan


def path_of(rate, acceleration=0.0, climb=0.0, *, speed=60.0, std=(3.0, 0.3), dims=2, dt=1.0):
    """Times, states and covariances of a target with these turn rates (deg/s), accelerations and climbs per step."""
    rate, acceleration, climb = np.broadcast_arrays(rate, acceleration, climb)
    heading, fast = np.radians(np.cumsum(rate) * dt), speed + np.cumsum(acceleration) * dt
    velocity = np.stack([fast * np.cos(heading), fast * np.sin(heading), climb + 0.0 * fast], 1)[:, :dims]
    mean = np.concatenate([np.cumsum(velocity, axis=0) * dt, velocity], 1)
    covariance = np.diag(np.repeat(np.square(std), dims))
    return dt * np.arange(len(rate)), mean, np.broadcast_to(covariance, (len(rate), 2 * dims, 2 * dims))


def during(begin, end, value, steps=200):
    return np.where((np.arange(steps) >= begin) & (np.arange(steps) < end), value, 0.0)


# ---------------------------------------------------------------- flags


def test_a_step_is_what_is_more_probable_than_not():
    outlier = np.array([0.0, 0.9, 0.3, 0.3, 0.0, 0.9])
    manoeuvre = np.array([0.1, 0.9, 0.9, 0.1, 0.9, 0.2])
    fix = np.array([True, True, True, True, True, False])
    flag = flags(fix, np.full(6, 100.0), outlier, manoeuvre, np.ones(6, bool), 13.8)
    assert flag.tolist() == ["", "outlier", "unclear", "unclear", "manoeuvre", ""]


def test_a_manoeuvre_is_one_that_is_listed_too():
    fix, nothing = np.ones(3, bool), np.zeros(3)
    listed = np.array([True, True, False])
    assert flags(fix, nothing, nothing, np.array([0.9, 0.1, 0.9]), listed, 13.8).tolist() == ["manoeuvre", "", ""]
    assert flags(fix, nothing, nothing, np.full(3, NAN), listed, 13.8).tolist() == ["manoeuvre", "manoeuvre", ""]


def test_an_abnormal_step_of_a_filter_that_weighs_no_outliers_is_unclear():
    nothing = np.full(3, NAN)
    flag = flags(np.array([True, True, False]), np.array([20.0, 3.0, 20.0]), nothing, nothing, np.zeros(3, bool), 13.8)
    assert flag.tolist() == ["unclear", "", ""]
    flag = flags(np.ones(3, bool), np.array([20.0, 3.0, NAN]), nothing, np.full(3, 0.9), np.ones(3, bool), 13.8)
    assert flag.tolist() == ["unclear", "manoeuvre", "manoeuvre"]


# ---------------------------------------------------------------- segments


@pytest.mark.parametrize(("rate", "kind"), [(3.0, "left turn"), (-3.0, "right turn")])
@pytest.mark.parametrize("dt", [1.0, 5.0])
def test_a_turn_is_found_with_its_side_its_rate_and_its_ends(rate, kind, dt):
    (turn,) = segments(*path_of(during(60, 100, rate), dt=dt))
    assert turn.kind == kind
    assert turn.begin == pytest.approx(59.5 * dt, abs=dt)
    assert turn.end == pytest.approx(99.5 * dt, abs=dt)
    assert turn.rate == pytest.approx(rate, rel=0.1)


def test_what_follows_each_other_is_told_apart_and_listed_in_order():
    rate = during(20, 60, 6.0) - during(60, 90, 3.0)
    found = segments(*path_of(rate, during(120, 150, -1.0)))
    assert [one.kind for one in found] == ["left turn", "right turn", "slowing down"]
    assert found[0].end == pytest.approx(found[1].begin, abs=1.5)
    assert found[2].rate == pytest.approx(-1.0, rel=0.1)


def test_climbs_are_found_in_space():
    found = segments(*path_of(0.0, 0.0, during(50, 90, 4.0) - during(90, 140, 8.0), dims=3))
    assert [one.kind for one in found] == ["climbing", "descending"]
    assert [one.rate for one in found] == pytest.approx([4.0, -8.0], rel=0.1)
    assert segments(*path_of(np.zeros(50), dims=3)) == ()


def test_level_flight_over_a_round_earth_is_no_descent():
    time, mean, covariance = path_of(np.zeros(200), speed=200.0, dims=3)
    mean[:, 2] = -np.square(mean[:, 0] + 1e5) / 2 / 6.371e6  # it falls below the plane that touches the earth
    assert [one.kind for one in segments(time, mean, covariance)] == ["descending"]
    assert segments(time, mean, covariance, height=np.full(200, 9000.0)) == ()


@pytest.mark.parametrize(("rate", "speed"), [(0.6, 230.0), (-0.3, 8.0)])
def test_a_slow_turn_of_a_large_angle_is_one_whose_rate_is_known(rate, speed):
    flown = path_of(during(60, 60 + round(60 / abs(rate)), rate, 400), speed=speed, std=(3.0, 0.02 * speed))
    (turn,) = segments(*flown)
    assert turn.kind == ("left turn" if rate > 0 else "right turn")
    assert turn.rate * (turn.end - turn.begin) == pytest.approx(60.0 * np.sign(rate), abs=12)
    noisier = path_of(during(60, 60 + round(60 / abs(rate)), rate, 400), speed=speed, std=(3.0, 0.4 * speed))
    assert segments(*noisier) == ()


def test_a_slow_turn_is_not_listed_beside_a_faster_one_in_it():
    (turn,) = segments(*path_of(during(60, 200, 0.4, 400) + during(120, 140, 3.0, 400)))
    assert turn.rate > 1.5


def test_a_short_or_a_small_change_is_no_manoeuvre():
    assert segments(*path_of(during(60, 64, 3.0))) == ()
    assert segments(*path_of(during(60, 180, 0.2))) == ()
    assert segments(*path_of(0.0, during(60, 66, 0.6))) == ()
    assert segments(*path_of(0.0, during(60, 180, 0.3))) == ()
    assert segments(*path_of(0.0, 0.0, during(60, 180, 1.2), dims=3)) == ()


def test_a_change_within_what_is_unsure_is_no_manoeuvre():
    rate = during(60, 100, 1.2)
    assert len(segments(*path_of(rate, std=(3.0, 1.0)))) == 1
    assert segments(*path_of(rate, std=(3.0, 20.0))) == ()


def test_what_stands_still_has_no_manoeuvres_whichever_way_its_noise_points():
    rng = np.random.default_rng(0)
    time, mean, covariance = path_of(np.zeros(300), speed=0.0, std=(3.0, 0.2))
    mean = mean + 0.2 * rng.standard_normal(mean.shape)
    assert segments(time, mean, covariance) == ()


def test_steps_without_an_estimate_and_short_tracks_are_left_out():
    time, mean, covariance = path_of(during(60, 100, 3.0))
    hole = mean.copy()
    hole[70:75] = NAN
    assert [one.kind for one in segments(time, hole, covariance)] == ["left turn"]
    assert segments(time[:2], mean[:2], covariance[:2]) == ()
    assert segments(time, np.full_like(mean, NAN), covariance) == ()
