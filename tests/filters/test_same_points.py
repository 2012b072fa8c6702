"""Filters that draw no new points for the measurement do what a paper's covariances say, and say what they refuse."""

import math

import numpy as np
import pytest
import torch

from torchfra import Gaussian, presets
from torchfra.association import Clutter, Euclidean
from torchfra.filters import SRCKF
from torchfra.motion import ConstantVelocity, CoordinatedTurn
from torchfra.sensors import Position, RangeBearing

MOTION, SENSOR = CoordinatedTurn(0.1, 2.0), RangeBearing([5.0, 0.02])
PRIOR = Gaussian(torch.tensor([300.0, 400, 20, -10]).double(), torch.diag(torch.tensor([40.0, 30, 5, 4])).double())
Z = torch.tensor([[510.0, 0.68], [495.0, 0.71], [math.nan, math.nan], [470.0, 0.79]], dtype=torch.float64)


def by_covariances(transition, noise, measure, r, mean, p, measurements):
    """Means of an unscented filter, written with covariances: Chen, Zou & Wu, eqs. (11)-(18) and (20)-(24)."""
    n = len(mean)
    weights = np.array([0.0, *[0.5 / n] * (2 * n)])
    of_covariance = weights + np.array([2.0, *[0.0] * (2 * n)])
    for z in measurements:
        root = math.sqrt(n) * np.linalg.cholesky(p)
        points = mean + np.concatenate([np.zeros((1, n)), root.T, -root.T])
        points = points @ transition.T
        mean = weights @ points
        apart = points - mean
        p = (of_covariance * apart.T) @ apart + noise
        if not np.isnan(z).any():
            seen = measure(points)
            expected = weights @ seen
            off = seen - expected
            gain = (of_covariance * apart.T) @ off @ np.linalg.inv((of_covariance * off.T) @ off + r)
            mean, p = mean + gain @ (z - expected), p - gain @ ((of_covariance * off.T) @ off + r) @ gain.T
        yield mean, p


def test_points_go_from_the_prediction_through_the_sensor():
    one = torch.ones(()).double()
    root = MOTION.process_noise(one).numpy()
    expected = by_covariances(
        MOTION.transition(one).numpy(), root @ root.T,
        lambda x: np.stack([np.hypot(x[:, 0], x[:, 1]), np.arctan2(x[:, 0], x[:, 1])], -1),
        np.diag([25.0, 0.02**2]), PRIOR.mean.numpy(), PRIOR.covariance.numpy(), Z.numpy(),
    )  # fmt: skip
    f = presets.ukf(MOTION, SENSOR, beta=2.0, kappa=0.0, redraw=False)
    estimate = f(Z, PRIOR)
    for found, root, (mean, p) in zip(estimate.mean, estimate.scale_tril, expected, strict=True):
        np.testing.assert_allclose(found, mean, rtol=1e-10)
        np.testing.assert_allclose(root @ root.mT, p, rtol=1e-8, atol=1e-8 * np.abs(p).max())
    redrawn = presets.ukf(MOTION, SENSOR, beta=2.0, kappa=0.0)(Z, PRIOR)
    assert (redrawn.mean - estimate.mean).abs().max() > 0.1


def test_a_forecast_is_what_the_step_compares_with():
    f = presets.iaukf(MOTION, SENSOR, redraw=False)
    state = f.init(PRIOR)
    state, _ = f.step(state, Z[0])
    forecast, (_, innovation) = f.predict(state, dt=1.0), f.step(state, Z[1])
    torch.testing.assert_close(Z[1] - forecast.measurement.mean, innovation.residual)
    torch.testing.assert_close(forecast.measurement.scale_tril, innovation.scale_tril)


def test_a_target_that_is_surely_measured_is_followed_as_without_association():
    clutter, motion, sensor = Clutter(1e12), ConstantVelocity(q=1.0), Position(2.0)
    z = torch.tensor([[9.0, 5], [26, 12], [41, 20]]).double()
    prior = Gaussian(torch.zeros(4).double(), torch.diag(torch.tensor([20.0, 20, 20, 20])).double())
    one = presets.iaukf(motion, sensor, redraw=False)
    several = presets.jpda(motion, sensor, clutter=clutter, inner=lambda m, s: presets.iaukf(m, s, redraw=False),
                           detection=1.0, gate=Euclidean(1e6))  # fmt: skip
    found = several(z.unsqueeze(-2), Gaussian(prior.mean[None], prior.scale_tril)).mean[0]
    torch.testing.assert_close(found, one(z, prior).mean, rtol=1e-6, atol=1e-6)


def test_what_needs_new_points_is_refused():
    with pytest.raises(ValueError, match="redraw: expected True beside fading factors"):
        SRCKF(MOTION, SENSOR, redraw=False, fading=presets.asrckf(MOTION, SENSOR).fading)
    with pytest.raises(ValueError, match=r"lost: expected 0 around a filter with redraw=False, received 0\.001"):
        presets.jpda(MOTION, SENSOR, clutter=Clutter(1e-4), lost=1e-3,
                     inner=lambda m, s: presets.ukf(m, s, redraw=False))  # fmt: skip
    with pytest.raises(ValueError, match="takes a mix"):
        presets.imm([MOTION, ConstantVelocity(q=1.0)], SENSOR, inner=lambda m, s: presets.ukf(m, s, redraw=False))
