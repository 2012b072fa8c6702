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
