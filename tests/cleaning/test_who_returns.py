"""The path of who returns between rare fixes stays at them, or sigma is said to be unsure."""

from __future__ import annotations

import numpy as np
import pytest

import torchfra

HOUR = 3600.0


def deer(rng, steps=700, forgotten=1.5 * HOUR, size=250.0):
    """Times and positions every hour of who returns to a home in some hours."""
    time = np.arange(steps) * HOUR + rng.integers(0, 60, steps)
    place = size * rng.standard_normal((steps, 2))
    for k, gap in enumerate(np.diff(time), start=1):
        kept = np.exp(-gap / forgotten)
        place[k] = kept * place[k - 1] + np.sqrt(1 - kept**2) * place[k]
    return time, place


def over_raw(cleaned, fixes, place):
    """Error of the path over that of its fixes, root mean squares."""
    error, raw = (((of - place) ** 2).sum(1).mean() for of in (cleaned.position, fixes))
    return np.sqrt(error / raw)


@pytest.mark.slow
def test_the_path_stays_at_the_fixes_of_who_returns_within_hours():
    rng = np.random.default_rng(0)
    time, place = deer(rng, forgotten=3 * HOUR)
    fixes = place + 7.0 * rng.standard_normal(place.shape)
    cleaned = torchfra.clean((time, fixes), bank="animal")
    assert np.sqrt(np.median(((cleaned.position - fixes) ** 2).sum(1))) < 2


@pytest.mark.parametrize("bank", [None, "animal"])
def test_what_returns_within_an_hour_and_noise_are_not_told_apart_and_it_is_said(bank):
    time, place = deer(np.random.default_rng(0), 200, forgotten=HOUR)
    assert "hardly distinguish" in torchfra.clean((time, place), bank=bank).found.sigma_unsure


@pytest.mark.slow
def test_white_noise_about_a_drifting_home_is_still_smoothed():
    rng = np.random.default_rng(1)
    time, place = deer(rng, forgotten=60 * HOUR)
    fixes = place + 200.0 * rng.standard_normal(place.shape)
    cleaned = torchfra.clean((time, fixes), bank="animal")
    assert over_raw(cleaned, fixes, place) < 0.8


def test_an_animal_that_wanders_on_is_still_smoothed():
    rng = np.random.default_rng(4)
    velocity = np.zeros((400, 2))
    for k in range(1, 400):  # forgotten in some hours
        velocity[k] = 0.7 * velocity[k - 1] + 0.2 * rng.standard_normal(2)
    time, place = 2 * HOUR * np.arange(400), 2 * HOUR * np.cumsum(velocity, 0)
    fixes = place + 500.0 * rng.standard_normal(place.shape)
    cleaned = torchfra.clean((time, fixes), bank="animal")
    assert over_raw(cleaned, fixes, place) < 0.95


def test_who_forgets_a_course_from_fix_to_fix_is_at_the_fixes_by_a_given_sigma_and_without_one_it_is_said():
    rng = np.random.default_rng(5)
    velocity = np.zeros((1200, 2))
    for k in range(1, 1200):  # every second; forgotten in 5 s
        velocity[k] = np.exp(-1 / 5) * velocity[k - 1] + 0.6 * rng.standard_normal(2)
    time, place = np.arange(0.0, 1200.0, 15.0), np.cumsum(velocity, 0)[::15]
    fixes = place + 0.4 * rng.standard_normal(place.shape)
    given = torchfra.clean((time, fixes), bank="person", sigma=0.4)
    assert over_raw(given, fixes, place) < 1.05
    assert "hardly distinguish" in torchfra.clean((time, fixes), bank="person").found.sigma_unsure


def test_a_bus_that_stops_and_goes_along_a_street_is_where_it_was_measured():
    rng = np.random.default_rng(6)
    speed = np.concatenate([np.repeat([rng.uniform(7, 13), 0.0], rng.integers((30, 15), (70, 45))) for _ in range(80)])
    along = np.convolve(speed, np.ones(10) / 10, "same").cumsum()[::30]
    place = np.stack([0.8 * along, 0.6 * along], 1)
    fixes = place + 3.0 * rng.standard_normal(place.shape)
    cleaned = torchfra.clean((30.0 * np.arange(len(place)), fixes), bank="vehicle")
    assert over_raw(cleaned, fixes, place) < 1.05


def test_a_bus_that_turns_at_corners_is_where_it_was_measured():
    rng = np.random.default_rng(9)
    speed = np.concatenate([np.repeat([rng.uniform(8, 13), 0.0], rng.integers((30, 10), (50, 45))) for _ in range(90)])
    speed = np.convolve(speed, np.ones(10) / 10, "same")
    corners = np.cumsum(rng.uniform(150, 450, 400))  # m along its streets, most of them a quarter turn
    turn = rng.choice([0.0, 0.5, -0.5], 401, p=[0.3, 0.35, 0.35]).cumsum() * np.pi
    course = turn[np.searchsorted(corners, speed.cumsum())]
    place = np.cumsum(speed[:, None] * np.stack([np.cos(course), np.sin(course)], 1), 0)[::15]
    fixes = place + 4.0 * rng.standard_normal(place.shape)
    cleaned = torchfra.clean((15.0 * np.arange(len(place)), fixes), bank="vehicle")
    assert over_raw(cleaned, fixes, place) < 1.05
