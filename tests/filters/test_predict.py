"""A forecast without a measurement: the state, and what a sensor would see."""

import pytest
import torch

from torchfra import Gaussian, presets
from torchfra.motion import ConstantVelocity, aircraft
from torchfra.sensors import Position, RangeBearing, Ranges

F64 = {"dtype": torch.float64}
GPS, RADAR = Position(2.0), RangeBearing(torch.tensor([3.0, 0.02], **F64))
NAMES = ["srckf", "ghckf", "rsrckf", "iaukf", "fra", "gpb", "alphabeta", "imm_srckf", "vsimm_srckf", "imm_fra"]


def made(name, **options):
    motion = aircraft(continuous=True) if "imm" in name else ConstantVelocity(1.0)
    return getattr(presets, name)(motion, GPS, **options)


def after_some(f, steps=5):
    """A state after some steps near (100, 80), of two targets."""
    n, rng = f.motion.size, torch.Generator().manual_seed(4)
    mean = torch.tensor([100.0, 80.0] + [0.0] * (n - 2), **F64).expand(2, n)
    state = f.init(Gaussian(mean, 5 * torch.eye(n, **F64)))
    for _ in range(steps):
        z = torch.tensor([100.0, 80.0], **F64) + 2 * torch.randn(2, 2, generator=rng, **F64)
        state, _ = f.step(state, z, dt=0.5)
    return state


def close(a, b, tolerance=1e-10):
    torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance)


def test_of_a_linear_motion_it_is_that_of_kalman():
    f, state, dt = made("srckf"), None, 1.7
    state = after_some(f)
    forecast = f.predict(state, dt)
    eye = torch.eye(2, **F64)
    transition = torch.kron(torch.tensor([[1.0, dt], [0.0, 1.0]], **F64), eye)
    gain = torch.kron(torch.tensor([[dt**2 / 2], [dt]], **F64), eye)
    covariance = transition @ state.belief.covariance @ transition.T + gain @ gain.T
    close(forecast.belief.mean, state.belief.mean @ transition.T)
    close(forecast.belief.covariance, covariance)
    close(forecast.measurement.mean, forecast.belief.mean[:, :2])
    close(forecast.measurement.covariance, covariance[:, :2, :2] + 4 * eye)


@pytest.mark.parametrize("name", NAMES)
def test_it_is_what_the_next_measurement_is_held_against(name):
    f = made(name)
    state, z = after_some(f), torch.tensor([[101.0, 82.0], [99.0, 77.0]], **F64)
    forecast = f.predict(state, 0.6)
    _, innovation = f.step(state, z, dt=0.6)
    close(z - forecast.measurement.mean, innovation.residual)
    if name != "gpb":  # whose jumps are as wide as the measurement asks for
        close(forecast.measurement.covariance, innovation.scale_tril @ innovation.scale_tril.mT)
    nothing, _ = f.step(state, torch.full((2, 2), torch.nan, **F64), dt=0.6)
    close(forecast.belief.mean, nothing.belief.mean)
    if name != "gpb":  # which counts on manoeuvres that may begin, as they do not without a measurement
        close(forecast.belief.covariance, nothing.belief.covariance)


@pytest.mark.parametrize("name", ["srckf", "fra", "gpb", "imm_srckf"])
def test_another_sensor_sees_the_same_state(name):
    f = made(name)
    state = after_some(f)
    here, there = f.predict(state, 0.0), f.predict(state, 0.0, sensor=RADAR)
    close(here.belief, there.belief)
    close(here.belief.mean, state.belief.mean)
    draws = torch.Generator().manual_seed(0)
    noise = torch.randn(200_000, f.motion.size, generator=draws, **F64)
    x = state.belief.mean[0] + noise @ state.belief.scale_tril[0].T
    seen = RADAR(x) + RADAR.std() * torch.randn(200_000, 2, generator=draws, **F64)
    torch.testing.assert_close(there.measurement.mean[0], seen.mean(0), rtol=0, atol=0.02)
    torch.testing.assert_close(there.measurement.covariance[0], seen.T.cov(), rtol=0.02, atol=0.01)


@pytest.mark.parametrize("name", ["srckf", "fra", "gpb", "imm_srckf"])
def test_another_sensor_may_measure_more(name):
    f = made(name)
    anchors = torch.tensor([[0.0, 0.0], [300.0, 0.0], [0.0, 300.0]], **F64)
    seen = f.predict(after_some(f), 0.5, sensor=Ranges(anchors, 2.0)).measurement
    assert seen.mean.shape[-1] == 3
    assert seen.covariance.isfinite().all()


def test_gradients_flow_through_it_and_angles_stay_near_the_mean():
    f = made("gpb", learn=("noise_levels",))
    south = Gaussian(torch.tensor([0.0, -50.0, 0.0, 0.0], **F64), torch.eye(4, **F64))
    forecast = f.predict(f.init(south), 1.0, sensor=RADAR)
    close(forecast.measurement.mean[1].abs(), torch.tensor(torch.pi, **F64), 0.1)
    assert forecast.measurement.covariance[1, 1] < 0.01
    forecast.measurement.covariance.sum().backward()
    assert all(p.grad.isfinite().all() and (p.grad != 0).any() for p in f.parameters())


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda f, s: f.predict(s, -1.0), "dt: expected seconds above 0"),
        (lambda f, s: f.predict(s.belief, 1.0), "state: expected what init or step has returned"),
        (lambda f, s: f.predict(s, torch.ones(3, **F64)), "batch: expected shapes that broadcast"),
        (lambda f, s: f.predict(s, 1.0, sensor=Position(1.0, dims=3)), "sensor: expected one of at most 2 dimensions"),
    ],
)
def test_what_does_not_fit_is_named(call, message):
    f = made("srckf")
    with pytest.raises(ValueError, match=message):
        call(f, after_some(f))
