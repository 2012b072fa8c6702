"""Time stamps that are off are seen, and the fixes put along the path to where they belong."""

from dataclasses import replace

import numpy as np
import pytest
from cleaning.simulated import ship

from torchfra.cleaning import clean_tracks
from torchfra.cleaning.kinds import KINDS
from torchfra.cleaning.time_stamps import moved_along, stamps_are_wrong
from torchfra.readers.recording import Recording, Source

TIME = np.arange(0.0, 600.0, 5.0)
INSIDE = slice(10, -10)
"""Steps that are not near an end, where the first and last reports leave open where the aircraft was."""


def path(time):
    """Straight on at 100 m/s, a turn of 90 degrees at 2 deg/s, and straight on."""
    course = np.radians(2.0 * (np.arange(0, 640, 0.1) - 300).clip(0, 45))
    xy = 10.0 * np.cumsum(np.stack([np.cos(course), np.sin(course)], 1), 0)
    return np.stack([np.interp(time, np.arange(0, 640, 0.1), axis) for axis in xy.T], 1)


def flight(position, word="aircraft"):
    return Recording("flight", TIME, position, None, {}, None, None, Source(word=word))


@pytest.fixture(scope="module")
def late():
    """As receivers' records often are: reports every few seconds with wrong stamps, and positions between them."""
    rng = np.random.default_rng(0)
    reports = np.cumsum(rng.uniform(8.0, 22.0, 100))
    reports = np.append(0.0, reports[reports < TIME[-1] + 30])
    stamps = np.maximum.accumulate(reports + rng.uniform(-4.0, 4.0, len(reports)))
    return flight(np.stack([np.interp(TIME, stamps, axis) for axis in path(reports).T], 1))


def test_late_stamps_are_seen_and_noise_and_outliers_are_not(late):
    rng = np.random.default_rng(1)
    assert stamps_are_wrong(late, KINDS["aircraft"])
    assert not stamps_are_wrong(flight(path(TIME)), KINDS["aircraft"])
    for std in (3.0, 30.0):
        noisy = path(TIME) + std * rng.standard_normal((len(TIME), 2))
        assert not stamps_are_wrong(flight(noisy), KINDS["aircraft"])
        noisy[rng.random(len(TIME)) < 0.03] += 3000.0
        assert not stamps_are_wrong(flight(noisy), KINDS["aircraft"])


def error(position):
    return np.sqrt(np.square(position - path(TIME))[INSIDE].sum(1).mean())


def test_fixes_move_along_the_path_to_where_they_belong(late):
    assert error(moved_along(late, KINDS["aircraft"])[0].position) < 0.75 * error(late.position)


@pytest.mark.slow
def test_cleaned_tracks_are_nearer_the_truth_say_so_and_keep_the_fixes_as_recorded(late):
    (mended,), (plain,) = clean_tracks([late]), clean_tracks([late], repair=False)
    assert error(mended.position) < 0.75 * error(plain.position)
    speed = [np.linalg.norm(one.velocity, axis=1)[INSIDE] - 100.0 for one in (mended, plain)]
    assert np.square(speed[0]).mean() < np.square(speed[1]).mean() / 4
    np.testing.assert_array_equal(mended.raw, late.position)
    assert mended.recording is late
    assert any("Time stamps were off" in line for line in mended.found.notes)
    assert not any("time stamps" in line for line in plain.found.notes)
    course = mended.velocity[20] / np.linalg.norm(mended.velocity[20])
    along = course @ mended.covariance[20, :2, :2] @ course
    across = course[::-1] * [-1, 1] @ mended.covariance[20, :2, :2] @ (course[::-1] * [-1, 1])
    assert along > 10 * across


@pytest.mark.slow
def test_a_filter_on_line_takes_them_as_they_come(late):
    (online,) = clean_tracks([late], smooth=False)
    assert not any("time stamps" in line for line in online.found.notes)


# ---------------------------------------------------------------- ships, and all else that moves


def voyage(wrong):
    """A ship that reports every 6 s: stamps right to 0.2 s, this share of them to 2 s; the recording and the truth."""
    rng, time = np.random.default_rng(1), 20.0 + 6.0 * np.arange(220)
    route = 1.7 * ship(rng, 1900)

    def at(seconds):
        return np.stack([np.interp(seconds, np.arange(1901), axis) for axis in route.T], 1)

    late = np.where(rng.random(220) < wrong, 2.0, 0.2) * rng.standard_normal(220)
    fixes = at(time + late) + 0.7 * rng.standard_normal((220, 2))
    return Recording("ship", time, fixes, None, {}, source=Source(word="ship")), at(time)


BESIDE = [50, 120, 200], [[400.0, -300.0], [-2000.0, 0.0], [0.0, 300.0]]
"""Fixes beside the path, and by how many metres."""


@pytest.fixture(scope="module")
def sailed():
    """Ships whose stamps are all wrong, or one in five, the latter also with outliers and with missing fixes: each
    recording, its truth and what comes of it; and what comes of the first two as they are."""
    (every, truth), (some, _) = voyage(1.0), voyage(0.2)
    fixes = some.position.copy(), some.position.copy()
    fixes[0][BESIDE[0]] += BESIDE[1]
    fixes[1][100:103] = np.nan
    several = [every, some, *(replace(some, position=position) for position in fixes)]
    return several, truth, clean_tracks(several), clean_tracks(several[:2], repair=False)


@pytest.mark.slow
def test_a_ship_whose_stamps_are_wrong_comes_nearer_the_truth(sailed):
    _, truth, mended, plain = sailed
    off = [np.sqrt(np.square(one.position - truth).sum(1).mean()) for one in (mended[0], plain[0])]
    assert off[0] < 0.95 * off[1]


def test_fixes_of_a_ship_with_wrong_stamps_are_no_outliers(sailed):
    several, _, mended, plain = sailed
    assert (plain[1].flag == "outlier").mean() > 0.05
    assert (mended[1].flag == "outlier").mean() < 0.03
    np.testing.assert_array_equal(mended[1].raw, several[1].position)


def test_a_fix_beside_the_path_is_an_outlier_where_stamps_are_off_too(sailed):
    _, _, mended, _ = sailed
    assert any("Time stamps were off" in line for line in mended[2].found.notes)
    assert (mended[2].flag[BESIDE[0]] == "outlier").all()


def test_fixes_may_be_missing_where_stamps_are_off(sailed):
    _, truth, mended, _ = sailed
    assert any("Time stamps were off" in line for line in mended[3].found.notes)
    assert np.isnan(mended[3].raw[100:103]).all()
    assert np.linalg.norm(mended[3].position - truth, axis=1)[100:103].max() < 20.0


def test_a_bus_that_stops_and_goes_has_right_stamps():
    """It does change its speed, far more than its direction, and for several fixes."""
    speed = np.convolve(np.repeat(np.tile([12.0, 0.0], 30), 25), np.ones(8) / 8, "same")  # 1.5 m/s^2
    for period, std in ((1, 0.1), (2, 0.5), (5, 3.0)):
        along = np.cumsum(speed)[::period]
        noise = std * np.random.default_rng(0).standard_normal((len(along), 2))
        fixes = np.stack([along, 0 * along], 1) + noise
        bus = Recording("bus", period * np.arange(len(along)) * 1.0, fixes, None, {})
        assert not stamps_are_wrong(bus, KINDS["vehicle"])


# ---------------------------------------------------------------- times that are cut to whole seconds
