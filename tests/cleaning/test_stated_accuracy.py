"""An accuracy that a file states is believed where its fixes do not show another."""

import numpy as np
import pytest

from torchfra.cleaning import clean_tracks
from torchfra.cleaning.outputs.csv_table import encode
from torchfra.readers.recording import Recording


def drive(seed, errors, stated, count=300):
    """A car for five minutes, a fix a second, and its true path."""
    rng = np.random.default_rng(seed)
    heading = np.cumsum(0.05 * rng.standard_normal(count))
    truth = np.cumsum(12.0 * np.stack([np.cos(heading), np.sin(heading)], 1), 0)
    return Recording("car", np.arange(float(count)), truth + errors(rng, count), None, {}, sigma=stated), truth


def white(rng, count):
    return 3.0 * rng.standard_normal((count, 2))


def smoothed_by_the_receiver(rng, count):
    errors, kept = 3.0 * rng.standard_normal((count, 2)), np.exp(-1 / 30)
    for k in range(1, count):
        errors[k] = kept * errors[k - 1] + np.sqrt(1 - kept**2) * errors[k]
    return errors


@pytest.fixture(scope="module")
def smoothed():
    several = [drive(seed, smoothed_by_the_receiver, np.full(300, 3.0)) for seed in range(3)]
    return [truth for _, truth in several], clean_tracks([recording for recording, _ in several])


@pytest.mark.slow
def test_where_a_receiver_has_smoothed_the_stated_accuracy_stays(smoothed):
    truths, cleaned = smoothed
    for truth, one in zip(truths, cleaned, strict=True):
        assert one.found.sigma == 1
        assert any("as stated" in note for note in one.found.notes)
        assert (one.std >= 3.0 - 1e-6).all()
        nees = (np.square(one.position - truth) / np.square(one.std)).mean()
        assert 0.2 < nees < 2.0  # ten independent errors


def test_where_noise_is_white_the_accuracy_is_found():
    recording, _ = drive(0, white, np.full(300, 5.0))
    (one,) = clean_tracks([recording])
    assert one.found.sigma == pytest.approx(0.6, rel=0.15)
    assert one.std[50:250].max() < 2.5


def test_no_fix_that_the_path_goes_through_is_an_outlier(smoothed):
    for one in smoothed[1]:
        assert not (one.flag == "outlier").any()


def test_no_standard_deviation_is_written_as_nothing():
    recording, _ = drive(1, lambda rng, count: 1e-5 * rng.standard_normal((count, 2)), np.full(300, 1e-5))
    (one,) = clean_tracks([recording])
    header, *rows = encode([one]).decode().splitlines()
    at = header.split(",").index("std_along")
    assert all(float(row.split(",")[at]) > 0 for row in rows)


def test_motion_that_may_be_noise_does_not_move_a_path_from_fixes_that_state_to_be_better_and_digits_show_it():
    rng = np.random.default_rng(3)
    truth = np.cumsum(np.cumsum(0.002 * rng.standard_normal((150, 2)), 0), 0)
    z = truth + 2e-6 * rng.standard_normal(truth.shape)
    (one,) = clean_tracks([Recording("probe", 0.2 * np.arange(150), z, None, {}, sigma=np.full(150, 2e-6))])
    assert np.abs(one.position - truth).max() < 1e-5
    assert one.std.max() < 3e-6
    assert (one.found.sigma, one.found.sigma_unsure) == (1, "")
    assert any("as stated" in note for note in one.found.notes)
    header, *rows = encode([one]).decode().splitlines()
    written = np.array([row.split(",")[header.split(",").index("x")] for row in rows], dtype=float)
    assert np.abs(written - one.position[:, 0]).max() < 2e-7
