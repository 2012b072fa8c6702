"""A target that returns to its home between rare fixes is not taken for noise."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchfra
from torchfra.cleaning.homes import innovations

HOUR = 3600.0


def deer(rng, steps=700, forgotten=1.5 * HOUR, size=250.0):
    """Times and positions every hour of who returns to a home in some hours."""
    time = np.arange(steps) * HOUR + rng.integers(0, 60, steps)
    place = size * rng.standard_normal((steps, 2))
    for k, gap in enumerate(np.diff(time), start=1):
        kept = np.exp(-gap / forgotten)
        place[k] = kept * place[k - 1] + np.sqrt(1 - kept**2) * place[k]
    return time, place


@pytest.mark.slow
@pytest.mark.parametrize("forgotten", [HOUR, 3 * HOUR])
def test_the_path_stays_at_the_fixes_of_who_returns_within_hours(forgotten):
    rng = np.random.default_rng(0)
    time, place = deer(rng, forgotten=forgotten)
    fixes = place + 7.0 * rng.standard_normal(place.shape)
    cleaned = torchfra.clean((time, fixes), bank="animal")
    assert np.sqrt(np.median(((cleaned.position - fixes) ** 2).sum(1))) < 2


@pytest.mark.slow
def test_white_noise_about_a_drifting_home_is_still_smoothed():
    rng = np.random.default_rng(1)
    time, place = deer(rng, forgotten=60 * HOUR)
    fixes = place + 200.0 * rng.standard_normal(place.shape)
    cleaned = torchfra.clean((time, fixes), bank="animal")
    error, raw = (np.linalg.norm(of - place, axis=1) for of in (cleaned.position, fixes))
    assert np.sqrt((error**2).mean() / (raw**2).mean()) < 0.8


@pytest.mark.parametrize("velocity", [False, True])
def test_the_likelihood_is_that_of_the_joint_normal_distribution(velocity):
    rng = np.random.default_rng(2)
    gap, z = rng.uniform(1.0, 3.0, 12), 5.0 * rng.standard_normal((12, 2))
    variance, noise, drift, size, seconds = rng.uniform(0.5, 2.0, 12), 1.5, 0.7, 4.0, 2.5
    time = (np.cumsum(gap) - gap[0]) / seconds
    early, late = np.minimum.outer(time, time), np.maximum.outer(time, time)
    kept = np.exp(early - late)
    if velocity:  # the integral of a Gauss-Markov process
        of_motion = size * seconds**2 * (2 * early + np.exp(-early) + np.exp(-late) - 1 - kept)
    else:
        of_motion = size * kept
    covariance = drift * seconds * early + of_motion + np.diag(noise * variance)
    difference = np.eye(12)[1:] - np.eye(12)[0]  # without the place at the start
    covariance, ahead = difference @ covariance @ difference.T, difference @ z
    fit = np.einsum("ia,ij,ja->", ahead, np.linalg.inv(covariance), ahead)
    joint = -0.5 * (fit + 2 * np.linalg.slogdet(covariance)[1])
    of = innovations(
        torch.tensor(z).unsqueeze(-1), torch.tensor(gap).unsqueeze(-1), torch.tensor(variance).unsqueeze(-1),
        *(torch.tensor([value]) for value in (noise, drift, size, seconds)), velocity=velocity,
    )  # fmt: skip
    assert float(-0.5 * (of.squares + of.log_variance)) == pytest.approx(joint, rel=1e-6)
    assert float(of.number) == 22


@pytest.mark.parametrize("gone", [0, 10])
def test_a_missing_fix_has_no_part_in_the_likelihood(gone):
    time, place = deer(np.random.default_rng(3), 30)
    place[gone] = np.nan
    values = [torch.tensor([value]) for value in (100.0, 0.3, 6e4, 5000.0)]

    def fit(rows):
        time_, place_ = (torch.tensor(of[rows]).unsqueeze(-1) for of in (time, place))
        of = innovations(place_, time_.diff(dim=0, prepend=time_[:1]), torch.ones_like(time_), *values)
        return [float(value) for value in of]

    assert fit(np.arange(30)) == pytest.approx(fit(np.delete(np.arange(30), gone)), rel=1e-9)


def test_an_animal_that_wanders_on_is_still_smoothed():
    rng = np.random.default_rng(4)
    velocity = np.zeros((400, 2))
    for k in range(1, 400):  # forgotten in some hours
        velocity[k] = 0.7 * velocity[k - 1] + 0.2 * rng.standard_normal(2)
    time, place = 2 * HOUR * np.arange(400), 2 * HOUR * np.cumsum(velocity, 0)
    fixes = place + 500.0 * rng.standard_normal(place.shape)
    cleaned = torchfra.clean((time, fixes), bank="animal")
    error, raw = (np.linalg.norm(of - place, axis=1) for of in (cleaned.position, fixes))
    assert np.sqrt((error**2).mean() / (raw**2).mean()) < 0.95


def test_who_forgets_a_course_from_fix_to_fix_is_where_it_was_measured():
    rng = np.random.default_rng(5)
    velocity = np.zeros((1200, 2))
    for k in range(1, 1200):  # every second; forgotten in 5 s
        velocity[k] = np.exp(-1 / 5) * velocity[k - 1] + 0.6 * rng.standard_normal(2)
    time, place = np.arange(0.0, 1200.0, 15.0), np.cumsum(velocity, 0)[::15]
    fixes = place + 0.4 * rng.standard_normal(place.shape)
    cleaned = torchfra.clean((time, fixes), bank="person")
    error, raw = (np.linalg.norm(of - place, axis=1) for of in (cleaned.position, fixes))
    assert np.sqrt((error**2).mean() / (raw**2).mean()) < 1.05


def test_a_bus_that_stops_and_goes_along_a_street_is_where_it_was_measured():
    rng = np.random.default_rng(6)
    speed = np.concatenate([np.repeat([rng.uniform(7, 13), 0.0], rng.integers((30, 15), (70, 45))) for _ in range(80)])
    along = np.convolve(speed, np.ones(10) / 10, "same").cumsum()[::30]
    place = np.stack([0.8 * along, 0.6 * along], 1)
    fixes = place + 3.0 * rng.standard_normal(place.shape)
    cleaned = torchfra.clean((30.0 * np.arange(len(place)), fixes), bank="vehicle")
    error, raw = (np.linalg.norm(of - place, axis=1) for of in (cleaned.position, fixes))
    assert np.sqrt((error**2).mean() / (raw**2).mean()) < 1.05


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
    error, raw = (np.linalg.norm(of - place, axis=1) for of in (cleaned.position, fixes))
    assert np.sqrt((error**2).mean() / (raw**2).mean()) < 1.05
