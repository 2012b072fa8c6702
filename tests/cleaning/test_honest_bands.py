"""Standard deviations of cleaned paths are those of their errors where noise is white, whatever the target is."""

import numpy as np
import pytest

from torchfra.cleaning import clean_tracks
from torchfra.readers import Recording

TENTH = 0.1
"""Seconds of a step of the simulation."""


def pieces(rng, count, values, shortest, longest):
    """Values that last for some seconds each, and change within a second."""
    steps = np.repeat([rng.choice(values) for _ in range(count)], rng.integers(10 * shortest, 10 * longest, count))
    return np.convolve(np.pad(steps[:count], 10, mode="edge"), np.ones(20) / 20, "same")[10:-10]


def path(rng, seconds, speeds, turns, lasting):
    """Positions every second of who goes at some speeds, m/s, and turns at some rates, rad/s."""
    count = 10 * seconds
    speed, turn = (pieces(rng, count, of, *lasting) for of in (speeds, turns))
    course = TENTH * turn.cumsum()
    return np.cumsum(TENTH * speed[:, None] * np.stack([np.cos(course), np.sin(course)], 1), 0)[::10]


TARGETS = {  # speeds, rates of turn, seconds that they last, noise
    "walker": ((0.0, 1.2, 1.5), (0.0, 0.0, 0.4, -0.4), (5, 20), 3.0),
    "runner": ((3.2, 3.4), (0.0, 0.01, -0.01), (20, 60), 4.0),
    "bike": ((4.0, 6.0, 8.0), (0.0, 0.0, 0.2, -0.2), (5, 15), 4.0),
    "car": ((0.0, 8.0, 14.0), (0.0, 0.0, 0.0, 0.25, -0.25), (5, 20), 5.0),
    "ship": ((6.0,), (0.0, 0.0, 0.01, -0.01), (60, 120), 10.0),
    "airliner": ((220.0,), (0.0, 0.0, 0.025, -0.025), (30, 80), 30.0),
    "glider": ((25.0,), (0.0, 0.3, -0.3), (40, 90), 5.0),
    "drone": ((0.0, 5.0, 10.0), (0.0, 0.0, 0.8, -0.8), (2, 8), 2.0),
    "bird": ((9.0, 11.0, 14.0), (0.1, 0.0, -0.1), (5, 20), 5.0),
    "kite": ((10.0,), (0.5, 0.2, -0.2, -0.5), (3, 10), 3.0),
}


@pytest.fixture(scope="module")
def cleaned():
    """Two tracks of each target with white noise, cleaned, and their truths, by the target."""
    truths = {
        (name, run): path(np.random.default_rng([57, run, i]), 300, *of[:3])
        for i, (name, of) in enumerate(TARGETS.items())
        for run in range(2)
    }
    recordings = []
    for number, ((name, _), truth) in enumerate(truths.items()):
        fixes = truth + TARGETS[name][3] * np.random.default_rng([58, number]).standard_normal(truth.shape)
        recordings.append(Recording(name, np.arange(300.0), fixes, None, {}))
    done = {}
    for (name, _), truth, one in zip(truths, truths.values(), clean_tracks(recordings), strict=True):
        done.setdefault(name, []).append((one, truth))
    return done


def nees(one, truth):
    """The mean normalised error squared of positions per axis, 1 where standard deviations are right."""
    error = one.position - truth
    return float(np.einsum("ti,tij,tj->t", error, np.linalg.inv(one.covariance[:, :2, :2]), error).mean() / 2)


@pytest.mark.slow
def test_errors_are_as_large_as_said(cleaned):
    of_targets = {name: np.mean([nees(*of) for of in several]) for name, several in cleaned.items()}
    assert 0.8 < np.mean(list(of_targets.values())) < 1.3
    assert all(0.4 < value < 2.0 for value in of_targets.values()), of_targets


def test_the_noise_is_found_and_no_good_fix_is_rejected(cleaned):
    for name, several in cleaned.items():
        for one, _ in several:
            assert one.found.sigma == pytest.approx(TARGETS[name][3], rel=0.25)
            assert (one.flag == "outlier").sum() <= 1


def test_of_what_nobody_says_a_kind_of_none_is_said(cleaned):
    assert {one.found.bank for several in cleaned.values() for one, _ in several} == {"any"}
    assert not any(
        "kind" in note.lower() for several in cleaned.values() for one, _ in several for note in one.found.notes
    )


def test_who_circles_with_few_fixes_around_is_as_far_off_as_said():
    time = np.arange(0.0, 1500.0, 5.0)  # four fixes around
    truth = 83.0 * np.stack([np.cos(0.3 * time), np.sin(0.3 * time)], 1)
    fixes = truth + 5.0 * np.random.default_rng(59).standard_normal(truth.shape)
    (one,) = clean_tracks([Recording("circling", time, fixes, None, {})])
    assert nees(one, truth) < 1.3


@pytest.mark.slow
@pytest.mark.parametrize(("hours", "named"), [(2, "animal"), (6, "bird")])
def test_with_a_given_sigma_bands_between_rare_fixes_are_those_of_who_rests_and_moves(hours, named):
    """A deer that forgets its course in twenty minutes and rests half of the time, with fixes of 8 m."""
    rng, count = np.random.default_rng([59, hours]), 60 * 24 * (10 * hours)
    moves = np.cumsum(rng.random(count) < 1 / 90) % 2 == 0
    kept, velocity, truth = np.exp(-1 / 20), np.zeros(2), np.zeros((count, 2))
    for k in range(1, count):
        velocity = kept * velocity + 0.25 * np.sqrt((1 - kept**2) / 2) * rng.standard_normal(2)
        truth[k] = truth[k - 1] + 60 * moves[k] * velocity
    fixes = truth[:: 60 * hours] + 8.0 * rng.standard_normal((count // (60 * hours), 2))
    deer = Recording("deer", 3600.0 * hours * np.arange(len(fixes)), fixes, None, {})
    for bank in (None, named):
        (one,) = clean_tracks([deer], sigma=8.0, bank=bank, dt=900.0 * hours)
        between = one.row < 0
        error = (one.position - truth[np.rint(one.time / 60).astype(int)])[between]
        covariance = one.covariance[between, :2, :2]
        inside = np.abs(error) < 1.96 * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        assert inside.mean() > 0.9
        assert 0.25 < np.einsum("ti,tij,tj->t", error, np.linalg.inv(covariance), error).mean() / 2 < 1.5
        if bank is not None:  # speeds are still those of the way from fix to fix
            rate = np.diff(fixes, axis=0) / (3600.0 * hours)
            assert np.square(one.velocity[~between]).mean() > 0.5 * np.square(rate).mean()
