"""Errors that last from fix to fix are seen and said, and uncertainties know of them."""

import numpy as np
import pytest
from cleaning.simulated import lasting, ship

from torchfra.cleaning import clean_tracks
from torchfra.cleaning.correlation import _fitted, _of_a_mean, lasting_errors
from torchfra.cleaning.outputs import notes, overview
from torchfra.cleaning.second import second_differences
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


def held(several):
    """The share of true coordinates within a standard deviation."""
    done = clean_tracks([recording for recording, _ in several])
    return np.mean([np.abs(one.position - truth) < one.std for one, (_, truth) in zip(done, several, strict=True)])


def test_bands_hold_the_truth_where_errors_last():
    assert 0.55 < held([voyage(seed, 6.0, 20.0) for seed in range(3)]) < 0.8


def test_errors_that_last_are_said_with_their_size_and_time():
    recording, _ = voyage(0, 6.0, 15.0)
    (one,) = clean_tracks([recording])
    assert one.found.said[-1].startswith("Errors that last: those of neighbouring fixes are alike over about ")
    found = lasting_errors(recording, "ship")
    assert 3.0 < found.std < 12.0
    assert 5.0 < found.seconds < 45.0


def test_errors_that_last_are_counted_among_several_tracks_and_are_no_doubt_of_sigma():
    recording, _ = voyage(0, 6.0, 15.0)
    results = clean_tracks([recording, voyage(1, 6.0, 0.0)[0]])
    assert "Errors that last: 1 of 2" in notes(results)
    assert not any(line.startswith("Sigma is unsure") for line in overview(results))


def test_errors_that_last_are_said_with_a_bank_of_ones_own_too():
    recording, _ = voyage(0, 6.0, 15.0, count=250)
    bank = Bank([ConstantVelocity(0.1, spectral=True, orders=3), ConstantVelocity(1.0, spectral=True, orders=3)])
    (one,) = clean_tracks([recording], filter="srckf", bank=bank)
    assert one.found.said[-1].startswith("Errors that last: those of neighbouring fixes are alike over about ")


def test_white_noise_is_no_error_that_lasts():
    assert [lasting_errors(voyage(seed, std)[0], "ship") for seed in range(5) for std in (1.0, 6.0)] == [None] * 10


def test_a_motion_is_no_error_that_lasts():
    rng = np.random.default_rng(1)
    velocity = np.cumsum(0.3 * rng.standard_normal((600, 2)), 0)
    fixes = np.cumsum(velocity, 0) + rng.standard_normal((600, 2))
    for kind in ("person", "vehicle"):
        assert lasting_errors(Recording("walk", np.arange(600.0), fixes, None, {}), kind) is None


def test_fixes_that_are_missing_or_few_do_no_harm():
    recording, _ = voyage(0, 6.0, 15.0)
    gone = recording.position.copy()
    gone[100:120] = np.nan
    assert lasting_errors(Recording("gap", recording.time, gone, None, {}), "ship") is not None
    assert lasting_errors(Recording("few", recording.time[:90], recording.position[:90], None, {}), "ship") is None


def test_the_process_and_the_noise_are_found_of_exact_second_differences():
    lag = 2.0 ** np.arange(7)
    time = np.arange(0.0, 200.0)
    covariance = 36.0 * np.exp(-np.abs(time[:, None] - time) / 12.0) + 4.0 * np.eye(200)
    variance = []
    for every in (2**i for i in range(7)):
        row = second_differences(time[::every][:3], np.eye(200)[::every][:3])[0]  # of each fix what goes into one
        variance.append(row @ covariance @ row)
    found = _fitted(lag, np.array(variance))
    assert found.std == pytest.approx(6.0, rel=0.1)
    assert found.seconds == pytest.approx(12.0, rel=0.2)
    assert found.white == pytest.approx(2.0, rel=0.1)


def test_the_variance_of_a_mean_is_the_sum_of_all_covariances():
    kept = 0.9
    for count in (1, 2, 25):
        step = np.arange(count)
        expected = (kept ** np.abs(step[:, None] - step)).mean()
        assert _of_a_mean(kept, np.array([count]))[0] == pytest.approx(expected)
