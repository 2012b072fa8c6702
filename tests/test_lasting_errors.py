"""Time-correlated errors are seen and said, and uncertainties know of them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from cleaning.simulated import lasting, ship
from oracles import lasting as oracle

from torchfra.cleaning import clean_tracks
from torchfra.cleaning.correlation import CorrelatedErrors, _variance_of_mean, log_likelihood, widened
from torchfra.cleaning.outputs.summary import notes, overview
from torchfra.motion import ConstantVelocity
from torchfra.motion.bank import Bank
from torchfra.readers import Recording
from torchfra.readers.recording import Source


def voyage(seed, std, seconds=0.0, count=500):
    """A ship with a fix every second, whose errors last for so many seconds or are white: the recording, the truth."""
    rng = np.random.default_rng(seed)
    truth = ship(rng, count)[:count]
    noise = lasting(rng, truth.shape, 1.0, seconds) if seconds else rng.standard_normal(truth.shape)
    fixes = truth + std * noise + 0.3 * rng.standard_normal(truth.shape)
    return Recording("ship", np.arange(count) * 1.0, fixes, None, {}, source=Source(word="ship")), truth


@pytest.fixture(scope="module")
def cleaned():
    """Voyages with time-correlated errors and without, cleaned as one batch: by name their truths and results."""
    voyages = {
        "20 s": [voyage(seed, 6.0, 20.0) for seed in range(3)],
        "15 s": [voyage(0, 6.0, 15.0)],
        "missing": [voyage(0, 6.0, 15.0)],
        "few": [voyage(0, 6.0, 15.0, count=25)],
        "few and white": [voyage(0, 1.0, 0.0, 25)],
        "white": [voyage(seed, std) for seed in range(3) for std in (1.0, 6.0)],
    }
    voyages["missing"][0][0].position[100:120] = np.nan
    done = iter(clean_tracks([recording for several in voyages.values() for recording, _ in several]))
    return {name: [(next(done), truth) for _, truth in several] for name, several in voyages.items()}


def test_bands_hold_the_truth_where_errors_last(cleaned):
    held = np.mean([np.abs(one.position - truth) < one.std for one, truth in cleaned["20 s"]])
    assert 0.55 < held < 0.8


SEEN, ASSUMED = (
    "Time-correlated errors detected: ",
    "Time-correlated errors possible: not distinguishable from motion ",
)


def said(one):
    """What is said of time-correlated errors."""
    return [line for line in one.found.notes if line.startswith("Time-correlated errors")]


def test_errors_that_last_are_said_with_their_size_and_time(cleaned):
    (line,) = said(cleaned["15 s"][0][0])
    assert line.startswith(SEEN)
    metres, seconds = line.removeprefix(SEEN).split(";")[0].split(" over about ")
    assert 10.0 <= float(seconds.removesuffix(" s")) <= 40.0
    assert 3.0 < float(metres.removesuffix(" m")) < 12.0


def test_errors_that_last_are_counted_among_several_tracks_and_are_no_doubt_of_sigma(cleaned):
    results = [cleaned[name][0][0] for name in ("15 s", "few and white")]
    assert "Time-correlated errors detected: 1 of 2" in notes(results)
    assert not any(line.startswith("Sigma is unsure") for line in overview(results))


def test_errors_that_last_are_said_with_a_bank_of_ones_own_too():
    recording, _ = voyage(0, 6.0, 15.0, count=250)
    bank = Bank([ConstantVelocity(0.1, continuous=True, orders=3), ConstantVelocity(1.0, continuous=True, orders=3)])
    (line,) = said(*clean_tracks([recording], filter="srckf", bank=bank))
    assert line.startswith(SEEN)


def test_white_noise_is_not_seen_as_errors_that_last(cleaned):
    assert not any(SEEN in line for one, _ in cleaned["white"] for line in one.found.notes)


def test_a_stated_deviation_that_is_twice_the_noise_is_not_seen_as_errors_that_last():
    several = [voyage(seed, 3.0)[0] for seed in range(3)]
    assert not any(SEEN in line for one in clean_tracks(several, sigma=6.0) for line in one.found.notes)


def test_fixes_that_are_good_to_a_millimetre_have_bands():
    recording, _ = voyage(0, 6.0, count=200)
    (one,) = clean_tracks([replace(recording, position=recording.position / 6000)], sigma=0.001)
    assert np.isfinite(one.std).all()
    assert np.median(one.std) < 0.01


def test_errors_of_a_target_that_turns_all_the_time_are_assumed_and_less_so_in_the_air():
    rng = np.random.default_rng(1)
    velocity = np.cumsum(0.3 * rng.standard_normal((300, 2)), 0)
    fixes = np.cumsum(velocity, 0) + 3.0 * rng.standard_normal((300, 2))
    walk = Recording("walk", np.arange(300.0), fixes, None, {})
    on_the_ground, in_the_air = (clean_tracks([walk], bank=kind)[0] for kind in ("vehicle", "aircraft"))
    assert said(on_the_ground)[0].startswith(ASSUMED)
    assert not said(in_the_air)
    assert np.median(in_the_air.std) < np.median(on_the_ground.std)


def test_fixes_that_are_missing_do_no_harm_and_few_say_nothing(cleaned):
    assert said(cleaned["missing"][0][0])
    assert not said(cleaned["few"][0][0])


def test_an_estimate_is_left_alone_and_its_variance_grows_by_that_of_the_errors_in_their_mean():
    (one,) = clean_tracks([voyage(0, 6.0, count=210)[0]], bank="aircraft")
    errors = CorrelatedErrors(np.array([0.5]), np.array([4.0]), np.array([20.0]), one.found.sigma)
    wider = widened(one, errors)
    count = one.found.sigma**2 / one.covariance[200, 0, 0]
    more = 0.5 * 4.0**2 * _variance_of_mean(np.exp(-1 / 20), np.array([count]))[0]
    assert wider.covariance[200, 0, 0] == pytest.approx(one.covariance[200, 0, 0] + more)
    np.testing.assert_array_equal(wider.mean, one.mean)


def test_the_likelihood_is_that_of_one_large_gaussian_given_the_first_two_fixes():
    rng, count = np.random.default_rng(0), 12
    gap, q, std = rng.uniform(0.5, 3.0, count), rng.uniform(0.01, 1.0, count), rng.uniform(1.0, 2.0)
    z = np.cumsum(rng.standard_normal((count, 1)), 0)
    z[5] = np.nan
    F = [np.array([[1.0, dt], [0.0, 1.0]]) for dt in gap]
    Q = [qk * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]) for qk, dt in zip(q, gap, strict=True)]
    F[0], Q[0] = np.eye(2), np.zeros((2, 2))
    given = {"mean": np.zeros(2), "P": np.diag([1e10, 1e5]), "H": np.array([[1.0, 0.0]]), "R": np.array([[std**2]]),
             "std": np.array([1.5]), "time": np.array([8.0])}  # fmt: skip
    of = [oracle.lasting_errors(z[:k], F=F[:k], Q=Q[:k], dt=gap[:k], **given)["log_likelihood"] for k in (2, count)]
    columns = (torch.from_numpy(x).unsqueeze(-1) for x in (gap, np.full(count, std**2), q))
    found = log_likelihood(torch.from_numpy(z).unsqueeze(-1), *columns, torch.tensor([1.5**2]), torch.tensor([8.0]))
    constant = 0.5 * (count - 3) * np.log(2 * np.pi)
    assert found.item() - constant == pytest.approx(of[1] - of[0], abs=1e-4)


def test_the_variance_of_a_mean_is_the_sum_of_all_covariances():
    kept = 0.9
    for count in (1, 2, 25):
        step = np.arange(count)
        expected = (kept ** np.abs(step[:, None] - step)).mean()
        assert _variance_of_mean(kept, np.array([count]))[0] == pytest.approx(expected)
