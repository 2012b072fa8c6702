"""What fixes are off circles is what a search over all rates of turn leaves, and noise if there is nothing else."""

import numpy as np
import torch

from torchfra.cleaning.circles import off_circles


def off(z, gap=None):
    gap = np.full(len(z), 5.0) if gap is None else gap
    return off_circles(torch.from_numpy(z).unsqueeze(-1), torch.from_numpy(gap).unsqueeze(-1))[:, 0].numpy()


def circle(count, turn, radius=100.0):
    """A circle with ``turn`` fixes once around, whose centre drifts."""
    k = np.arange(count)
    return np.stack([radius * np.cos(2 * np.pi * k / turn) + 7 * k, radius * np.sin(2 * np.pi * k / turn) - 3 * k], 1)


def test_it_is_the_least_that_any_rate_leaves():
    z = circle(60, 3.7) + 5.0 * np.random.default_rng(1).standard_normal((60, 2))
    k, found = np.arange(8), off(z)
    for first in range(0, 53, 4):
        one = z[first : first + 8, 0] + 1j * z[first : first + 8, 1]
        left = []
        for rate in np.linspace(0.02, 2 * np.pi - 0.02, 2000):
            basis = np.stack([np.ones(8), k, np.exp(1j * rate * k)], 1)
            left.append(np.square(np.abs(one - basis @ np.linalg.lstsq(basis, one, rcond=None)[0])).sum())
        least = np.sqrt(min(left) / 9)
        assert 0.99 * least < found[first] < 1.1 * least


def test_noise_about_circles_is_found_at_any_rate_and_noise_alone_nearly():
    noise = np.random.default_rng(2).standard_normal((2000, 2))
    for turn in (2.3, 3.0, 4.5, 10.0, -6.0):
        assert 0.9 < np.median(off(circle(2000, turn) + noise)) < 1.1
    assert 0.74 < np.median(off(noise)) < 0.82


def test_nothing_is_said_of_fixes_that_are_missing_or_come_unevenly():
    z, gap = circle(40, 5.0), np.full(40, 5.0)
    z[10], gap[30] = np.nan, 8.0
    silent = np.isnan(off(z, gap))
    assert silent[3:11].all()
    assert silent[23:30].all()
    assert silent.sum() == 15
