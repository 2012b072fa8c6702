"""White and correlated parts of a sensor's errors are found where the truth is known, with intervals that hold."""

import math

import numpy as np
import pytest
import torch

import torchfra
from torchfra import Gaussian, presets
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Correlated, Position

TRUE = np.array([[1.0, 3.0, 20.0], [0.5, 4.84, 60.0]])
"""White std, correlated std and correlation time of two elements: m, m, s."""


def errors(rng, time, true=TRUE):
    """Errors ``(T, m)`` at these times, by the exact transition of the process."""
    c, found = rng.normal(size=len(true)) * true[:, 1], []
    for dt in np.diff(time, prepend=time[0]):
        kept = np.exp(-dt / true[:, 2])
        c = kept * c + np.sqrt(1 - kept**2) * true[:, 1] * rng.normal(size=len(true))
        found.append(c + true[:, 0] * rng.normal(size=len(true)))
    return np.array(found)


def dense(r, time, white, std, tau):
    """Log density of residuals ``(T,)`` by their whole covariance."""
    seen = ~np.isnan(r)
    lag = np.abs(time[seen, None] - time[None, seen])
    covariance = std**2 * np.exp(-lag / tau) + white**2 * np.eye(seen.sum())
    half = np.linalg.solve(np.linalg.cholesky(covariance), r[seen])
    return -0.5 * (half @ half + np.linalg.slogdet(covariance)[1] + seen.sum() * math.log(2 * math.pi))


def test_values_of_simulated_errors_are_found_within_a_fifth_at_uneven_times_with_gaps():
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.5, 2.0, (8, 1200)), 1)
    r = np.stack([errors(rng, one) for one in time])
    r[:, 300:400], r[rng.uniform(size=r.shape) < 0.1] = np.nan, np.nan
    found = torchfra.correlation(r, time)
    np.testing.assert_allclose(np.stack(found[:3], 1), TRUE, rtol=0.2)
    low, high = found.intervals[..., 0].T, found.intervals[..., 1].T
    assert ((low < TRUE) & (high > TRUE)).sum() >= 5
    assert (found.gain > 500).all()
    assert "correlation time, s[1]" in str(found)


def test_they_are_the_maximum_of_the_likelihood_by_whole_covariances():
    rng = np.random.default_rng(1)
    time = np.cumsum(rng.uniform(0.5, 2.0, 300))
    r = errors(rng, time, TRUE[:1])
    r[40:60] = np.nan
    found = torchfra.correlation(r, time)
    best = [float(x[0]) for x in found[:3]]
    top = dense(r[:, 0], time, *best)
    alone = dense(r[:, 0], time, float(np.sqrt(np.nanmean(r**2))), 1e-12, 1.0)
    assert float(found.gain[0]) == pytest.approx(top - alone, rel=1e-6)
    for i in range(3):
        for factor in (0.98, 1.02):
            assert dense(r[:, 0], time, *(x * factor if i == j else x for j, x in enumerate(best))) < top


@pytest.mark.slow
def test_intervals_hold_nine_times_of_ten_or_more():
    rng, time = np.random.default_rng(2), np.arange(500.0)
    inside = []
    for _ in range(25):
        ends = torchfra.correlation(errors(rng, time, TRUE[:1]), time).intervals[:, 0]
        inside.append((ends[:, 0] < TRUE[0]) & (TRUE[0] < ends[:, 1]))
    assert np.mean(inside) >= 0.9


def test_white_errors_have_no_correlation_to_speak_of():
    found = torchfra.correlation(np.random.default_rng(3).normal(size=500), np.arange(500.0))
    assert found.gain[0] < 4
    assert float(np.hypot(found.white, found.std)[0]) == pytest.approx(1, rel=0.1)


def test_what_is_found_goes_into_a_sensor_and_makes_the_covariance_right():
    """Fixes that agree far more closely than they are right: a plain filter is sure of what is wrong."""
    rng, time = np.random.default_rng(4), np.arange(600.0)
    known = np.stack([errors(rng, time, TRUE[[1, 1]]) for _ in range(8)])
    found = torchfra.correlation(known, time)
    sensor = Correlated(Position(found.white), std=found.std, time=found.time)
    z = torch.from_numpy(np.stack([errors(rng, time, TRUE[[1, 1]]) for _ in range(40)]))  # of targets that stand
    prior, motion = Gaussian.from_std([0, 0, 0, 0], [5, 5, 0.01, 0.01]), ConstantVelocity(1e-10)

    def nees(f):
        estimate = f(z, prior)
        root, mean = estimate.scale_tril[:, -1, :2, :2], estimate.mean[:, -1, :2, None]
        return float(torch.linalg.solve_triangular(root, mean, upper=False).square().sum((1, 2)).mean()) / 2

    assert nees(presets.srckf(motion, sensor)) == pytest.approx(1, abs=0.5)
    assert nees(presets.srckf(motion, Position(0.5))) > 20


@pytest.mark.parametrize(
    ("residuals", "time", "message"),
    [
        (np.zeros((30, 2, 2, 2)), np.arange(30.0), r"residuals, time: expected \(T,\), \(T, m\)"),
        (np.ones(30), np.arange(29.0), r"residuals, time: .*\(30,\) and \(29,\)"),
        (np.ones(30), -np.arange(30.0), r"time: expected finite seconds that do not decrease"),
        (np.ones(10), np.arange(10.0), r"residuals: expected 20 or more that differ, received 10 of element 0"),
        (np.zeros(30), np.arange(30.0), r"residuals: .*received zeros in element 0"),
        (np.full(30, np.inf), np.arange(30.0), r"residuals: expected finite numbers, or NaN"),
        ("north", np.arange(30.0), r"residuals: expected numbers"),
    ],
)
def test_residuals_that_say_nothing_are_named(residuals, time, message):
    with pytest.raises(ValueError, match=message):
        torchfra.correlation(residuals, time)
