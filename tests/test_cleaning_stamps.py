"""Time stamps of aircraft that are off by seconds are seen, and the fixes put along the path to where they belong."""

from dataclasses import replace

import numpy as np
import pytest

from torchfra.cleaning import clean_tracks
from torchfra.cleaning.stamps import in_place, stamps_are_off
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
    assert stamps_are_off(late)
    assert not stamps_are_off(replace(late, source=Source(word="ship")))
    assert not stamps_are_off(flight(path(TIME)))
    for std in (3.0, 30.0):
        noisy = path(TIME) + std * rng.standard_normal((len(TIME), 2))
        assert not stamps_are_off(flight(noisy))
        noisy[rng.random(len(TIME)) < 0.03] += 3000.0
        assert not stamps_are_off(flight(noisy))


def error(position):
    return np.sqrt(np.square(position - path(TIME))[INSIDE].sum(1).mean())


def test_fixes_move_along_the_path_to_where_they_belong(late):
    assert error(in_place(late).position) < 0.75 * error(late.position)


@pytest.mark.slow
def test_cleaned_tracks_are_nearer_the_truth_say_so_and_keep_the_fixes_as_recorded(late):
    (mended,), (plain,) = clean_tracks([late]), clean_tracks([late], repair=False)
    assert error(mended.position) < 0.75 * error(plain.position)
    speed = [np.linalg.norm(one.velocity, axis=1)[INSIDE] - 100.0 for one in (mended, plain)]
    assert np.square(speed[0]).mean() < np.square(speed[1]).mean() / 4
    np.testing.assert_array_equal(mended.raw, late.position)
    assert mended.recording is late
    assert any("time stamps were off" in line for line in mended.found.said)
    assert not any("time stamps" in line for line in plain.found.said)
    course = mended.velocity[20] / np.linalg.norm(mended.velocity[20])
    along = course @ mended.covariance[20, :2, :2] @ course
    across = course[::-1] * [-1, 1] @ mended.covariance[20, :2, :2] @ (course[::-1] * [-1, 1])
    assert along > 10 * across


@pytest.mark.slow
def test_a_filter_on_line_takes_them_as_they_come(late):
    (online,) = clean_tracks([late], smooth=False)
    assert not any("time stamps" in line for line in online.found.said)
