"""Where the noise of fixes grows along a track, cleaning finds by how much."""

import numpy as np
import pytest

from torchfra.cleaning import Cleaned, clean_tracks
from torchfra.readers.recording import Recording

SEEDS = (0, 1, 2)
TIME = 4.0 * np.arange(300.0)
PATH = np.stack([5000.0 + 170.0 * TIME, 3000.0 + 60.0 * TIME], 1)
DISTANCE = np.hypot(*PATH.T)


def cleaned(noise: np.ndarray, sigma: float | None = None) -> list[Cleaned]:
    """An aircraft that flies straight on, with noise of these standard deviations (T,), for each seed."""
    fixes = [PATH + noise[:, None] * np.random.default_rng(seed).standard_normal(PATH.shape) for seed in SEEDS]
    return clean_tracks([Recording("radar", TIME, z, None, {}) for z in fixes], sigma=sigma)


def notes(one: Cleaned) -> list[str]:
    return [note for note in one.found.notes if note.startswith("Sigma varies")]


@pytest.mark.slow
def test_noise_that_grows_with_the_range_is_found_and_no_good_fix_is_rejected():
    noise = np.hypot(30.0, 0.0026 * DISTANCE)  # 0.15 degrees
    for one in cleaned(noise):
        error, raw = (np.sqrt(np.square(x - PATH).mean()) for x in (one.position, one.raw))
        assert (one.flag == "outlier").sum() <= 3
        assert error < 0.25 * raw
        low, high = (float(text.split()[0].replace(",", "")) for text in notes(one)[0].partition(": ")[2].split(" to "))
        assert low < 1.5 * noise[30]  # the middle of the first sixty fixes
        assert high > 0.6 * noise[-1]


@pytest.mark.slow
def test_standard_deviations_of_estimates_grow_with_the_noise():
    for one in cleaned(0.003 * DISTANCE):
        std = np.sqrt(one.covariance[:, 0, 0])
        assert std[-60:].mean() > 3 * std[60:120].mean()
        assert 0.5 < (np.abs(one.position - PATH) < np.sqrt(one.covariance[:, [0, 1], [0, 1]])).mean() < 0.9


def test_white_noise_has_one_sigma():
    assert not any(notes(one) for one in cleaned(np.full(len(TIME), 50.0)))


def test_a_given_sigma_is_that_of_all_fixes():
    assert not any(notes(one) for one in cleaned(0.003 * DISTANCE, sigma=200.0))
