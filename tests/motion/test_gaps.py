"""A gap in one step is the gap in many: the noise of continuous time is exact however long a step is."""

import math

import mpmath
import pytest
import torch

from torchfra import Gaussian, learnable, presets
from torchfra.motion import (
    Augmented,
    Clock,
    ConstantAcceleration,
    ConstantVelocity,
    CoordinatedTurn,
    CurrentStatistical,
    GaussMarkov,
    IntegratedOrnsteinUhlenbeck,
    Level,
    RandomWalk,
    Singer,
    WhiteJerk,
)
from torchfra.sensors import Position

GAP, STEPS = 3600.0, 360
MOTIONS = {
    "constant velocity": ConstantVelocity(0.7, 2, continuous=True),
    "constant acceleration": ConstantAcceleration(0.7, 2, continuous=True),
    "white jerk": WhiteJerk(0.7),
    "random walk": RandomWalk(0.7),
    "clock": Clock(0.3, 0.02),
    "gauss markov": GaussMarkov(3.0, 10.0, 2),
    "turn": CoordinatedTurn(0.3, 0.7, 3, continuous=True),
    "constant velocity with an acceleration": ConstantVelocity(0.7, 2, orders=3, continuous=True),
    "turn of no rate": CoordinatedTurn(0.0, 0.7, 2, continuous=True),
    "turn with an acceleration": CoordinatedTurn(-0.3, 0.7, orders=3, continuous=True),
    "level": Level(IntegratedOrnsteinUhlenbeck(1.0, 1.0), 0.1),
    "augmented": Augmented(Singer(1.0, 1.0), RandomWalk(0.1, 2, kind="bias")),
} | {
    f"{name}, {alpha}": motion
    for alpha in (1e-6, 0.02, 1.0, 1e3)
    for name, motion in (
        ("singer", Singer(0.7, alpha)),
        ("ornstein uhlenbeck", IntegratedOrnsteinUhlenbeck(0.7, alpha)),
        ("current statistical", CurrentStatistical(alpha, 2.0)),
    )
}
PRODUCTS = [1e-8, 1e-6, 1e-3, 0.1, 1.0, 3.99, 4.01, 16.0, 100.0, 1e3, 1e5, 1e8]
"""``alpha dt``."""


def tensor(value):
    return torch.tensor(value, dtype=torch.float64)


def covariance(root):
    return root @ root.mT


def expect_close(found, expected, scale, tolerance):
    """Expects covariances that differ by less than so many of the product of two standard deviations."""
    assert ((found - expected).abs() <= tolerance * scale.unsqueeze(-1) * scale.unsqueeze(-2)).all()


@pytest.mark.parametrize("name", MOTIONS)
def test_a_gap_in_one_step_is_the_gap_in_360(name):
    motion = MOTIONS[name]
    matrix, noise = motion.transition(tensor(GAP / STEPS)), covariance(motion.process_noise(tensor(GAP / STEPS)))
    on, grown = torch.eye(motion.size, dtype=torch.float64), torch.zeros_like(noise)
    for _ in range(STEPS):
        on, grown = matrix @ on, matrix @ grown @ matrix.mT + noise
    torch.testing.assert_close(motion.transition(tensor(GAP)), on, rtol=1e-10, atol=1e-12)
    expect_close(covariance(motion.process_noise(tensor(GAP))), grown, grown.diagonal().sqrt(), 1e-10)


@pytest.mark.parametrize("engine", ["eager", "compiled"])
@pytest.mark.parametrize("motion", [Singer(0.7, 1.0), IntegratedOrnsteinUhlenbeck(0.7, 1.0)])
def test_a_filter_is_as_uncertain_after_one_long_step_without_a_measurement_as_after_360(motion, engine):
    f = presets.srckf(motion, Position(2.0))
    f = f if engine == "eager" else f.compile()
    n = motion.size
    prior = Gaussian(torch.arange(1.0, n + 1).double(), torch.eye(n, dtype=torch.float64))
    many = f(torch.full((STEPS, 2), math.nan).double(), prior, dt=GAP / STEPS)
    one = f(torch.full((1, 2), math.nan).double(), prior, dt=GAP)
    torch.testing.assert_close(one.mean[-1], many.mean[-1], rtol=1e-10, atol=1e-10)
    scale = many.covariance[-1].diagonal().sqrt()
    expect_close(one.covariance[-1], many.covariance[-1], scale, 1e-10)


def exact(alpha, dt):
    """Covariance of one axis of a Singer motion of variance 1, by integration with 60 digits."""
    a, end = mpmath.mpf(alpha), mpmath.mpf(dt)

    def response(s):
        e = mpmath.exp(-a * s)
        return (a * s - 1 + e) / a**2, (1 - e) / a, e

    parts = [0, *(k / a for k in (1, 4, 16, 64, 256) if k / a < end), end]
    return [[2 * a * mpmath.quad(lambda s, i=i, j=j: response(s)[i] * response(s)[j], parts)
             for j in range(3)] for i in range(3)]  # fmt: skip


@pytest.mark.parametrize("product", PRODUCTS)
def test_the_noise_and_its_gradients_are_exact_however_short_or_long_the_memory(product):
    dt = 3.0
    alpha = float(mpmath.mpf(product) / dt)
    with mpmath.workdps(60):
        small = mpmath.mpf(10) ** -25
        at, more, longer = exact(alpha, dt), exact(alpha * (1 + small), dt), exact(alpha, dt * (1 + small))
        value, by_alpha, by_dt = (
            tensor([[float((x[i][j] - y[i][j]) / step) for j in range(3)] for i in range(3)])
            for x, y, step in ((at, [[0] * 3] * 3, 1), (more, at, small), (longer, at, small))
        )  # by relative changes of both

    motion, seconds = learnable(Singer(1.0, alpha, 1), ("alpha",)), tensor(dt).requires_grad_()
    found = covariance(motion.process_noise(seconds))
    each = [torch.autograd.grad(x, (motion.alpha.raw, seconds), retain_graph=True) for x in found.flatten()]
    of_log_alpha, of_dt = (torch.stack(x).reshape(3, 3) for x in zip(*each, strict=True))
    deviations = value.diagonal().sqrt()
    expect_close(found.detach(), value, deviations, 1e-14)
    expect_close(of_log_alpha, by_alpha, deviations, 1e-13)
    expect_close(of_dt * dt, by_dt, deviations, 1e-13)


@pytest.mark.parametrize("product", PRODUCTS)
def test_the_mean_of_the_current_statistical_model_goes_on_exactly(product):
    """Its level is the acceleration itself: what that moves is no difference of large numbers."""
    with mpmath.workdps(60):
        a, t = mpmath.mpf(product) / 3, mpmath.mpf(3)
        e = mpmath.exp(-a * t)
        expected = tensor([float(t**2 / 2 - (a * t - 1 + e) / a**2), float(t - (1 - e) / a), float(1 - e)])
    found = CurrentStatistical(float(a), 2.0, dims=1).adaptation(tensor(3.0)).response.flatten()
    torch.testing.assert_close(found, expected, rtol=1e-14, atol=0)
