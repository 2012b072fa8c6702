"""A target that circles hard loses no good fix, although nobody says what it is."""

import numpy as np
import pytest

from torchfra.cleaning import clean_tracks
from torchfra.cleaning.kinds import kind_of
from torchfra.readers import Recording


def circling(speed, acceleration, noise, fixes=12, count=300):
    """A target that flies the same circle, with so many ``fixes`` once around."""
    rate = acceleration / speed
    time = np.arange(count) * (2 * np.pi / rate / fixes)
    path = speed / rate * np.stack([np.cos(rate * time), np.sin(rate * time)], 1)
    z = path + noise * np.random.default_rng(7).standard_normal(path.shape)
    return path, Recording("circling", time, z, None, {})


@pytest.mark.parametrize(("speed", "acceleration", "noise"), [(150.0, 24.5, 3.0), (40.0, 19.6, 1.0)])
def test_of_who_circles_at_two_g_no_good_fix_is_rejected(speed, acceleration, noise):
    path, recording = circling(speed, acceleration, noise)
    (cleaned,) = clean_tracks([recording])
    assert not (cleaned.flag == "outlier").any()
    left, raw = (np.square(z - path).sum(1).mean() ** 0.5 for z in (cleaned.position, recording.position))
    assert left < 1.02 * raw


@pytest.mark.parametrize("lasting", [0.0, 10.0, 40.0])
def test_noise_makes_nobody_much_faster_who_walks(lasting):
    rng, kept = np.random.default_rng(8), np.exp(-1 / lasting) if lasting else 0.0
    time, noise = np.arange(400.0), rng.standard_normal((400, 2))
    for k in range(1, 400):
        noise[k] = kept * noise[k - 1] + np.sqrt(1 - kept**2) * noise[k]
    path = 1.4 * time[:, None] * (0.6, 0.8)
    assert kind_of(Recording("walk", time, path + 15.0 * noise, None, {}))[1].fastest < 15.0


def wandering(speed, seconds, noise, seed, count=400, rate=30):
    """A target whose velocity forgets itself within some seconds: truth and fixes ``(count, 2)``."""
    rng, kept = np.random.default_rng(seed), np.exp(-1 / (rate * seconds))
    velocity = np.zeros((count, 2))
    for k in range(1, count):
        velocity[k] = kept * velocity[k - 1] + speed * np.sqrt(1 - kept**2) * rng.standard_normal(2)
    path = 300 + np.cumsum(velocity, 0) / rate
    return np.arange(count) / rate, path, np.round(path + noise * rng.standard_normal(path.shape), 1)


@pytest.mark.parametrize(("speed", "seconds", "noise"), [(80.0, 0.4, 1.0), (20.0, 0.5, 3.0)])
def test_pixels_of_a_video_are_cleaned_as_well_for_metres_as_for_millimetres(speed, seconds, noise):
    time, path, z = wandering(speed, seconds, noise, seed=3)
    z[::40] += 150.0
    several = clean_tracks([Recording("mouse", time, z * unit, None, {}) for unit in (1e-3, 1.0)])
    errors = []
    for cleaned, unit in zip(several, (1e-3, 1.0), strict=True):
        errors.append(np.square(cleaned.position / unit - path).mean() ** 0.5)
        assert np.array_equal(np.flatnonzero(cleaned.flag == "outlier"), np.arange(0, 400, 40))
        assert 0.7 * noise < cleaned.found.sigma / unit < 1.5 * noise
    assert errors[1] < 1.15 * errors[0]
    assert max(errors) < 0.75 * noise
