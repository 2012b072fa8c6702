"""A NaN in ``u`` that nothing measured needs is no error: satellites that are gone have no position."""

import pytest
import torch

from torchfra import presets
from torchfra.motion import Augmented, Clock, ConstantVelocity, Level, Odometry
from torchfra.sensors import Position, Pseudoranges
from torchfra.types import Gaussian

STEPS, COUNT = 12, 6


def satellites():
    """A receiver, pseudoranges to six satellites of which one is gone after half the time, and where they are."""
    rng = torch.Generator().manual_seed(4)
    motion = Augmented(Level(ConstantVelocity(0.1), 1e-4), Clock(0.01, 1e-4))
    sensor = Pseudoranges(COUNT, 3.0, clock=motion.components.index("clock"))
    away = torch.randn(COUNT, 3, dtype=torch.float64, generator=rng)
    places = 2e7 * away / away.norm(dim=-1, keepdim=True)
    u = (places + 3e3 * torch.arange(STEPS, dtype=torch.float64)[:, None, None]).flatten(1)
    x = torch.zeros(STEPS, motion.size, dtype=torch.float64)
    x[:, 0] = 10.0 * torch.arange(STEPS)
    z = sensor(x, u) + 3 * torch.randn(STEPS, COUNT, dtype=torch.float64, generator=rng)
    z[STEPS // 2 :, 2] = torch.nan
    spread = torch.tensor([10.0, 10, 10, 10, 10, 30, 1], dtype=torch.float64).diag()
    return motion, sensor, z, u, Gaussian(torch.zeros(motion.size, dtype=torch.float64), spread)


def gone(u):
    u = u.clone()
    u[STEPS // 2 :, 6:9] = torch.nan
    return u


def test_the_place_of_a_satellite_that_is_not_measured_does_not_matter():
    motion, sensor, z, u, prior = satellites()
    f = presets.gpb(motion, sensor)
    whole, without = f(z, prior, u=u), f(z, prior, u=gone(u))
    assert not without.failed
    torch.testing.assert_close(without.mean, whole.mean, rtol=1e-9, atol=1e-6)
    torch.testing.assert_close(f.smooth(z, prior, u=gone(u)).mean, f.smooth(z, prior, u=u).mean, rtol=1e-9, atol=1e-6)


def test_steps_and_kernels_do_not_need_it_either():
    motion, sensor, z, u, prior = satellites()
    f = presets.srckf(motion, sensor)
    whole, u = f(z, prior, u=u), gone(u)
    state = f.init(prior)
    for k in range(STEPS):
        state, _ = f.step(state, z[k], u=u[k])
    torch.testing.assert_close(state.belief.mean, whole.mean[-1], rtol=1e-9, atol=1e-6)
    torch.testing.assert_close(f.compile()(z, prior, u=u).mean, whole.mean, rtol=1e-9, atol=1e-6)


def test_a_measurement_that_does_not_fit_is_named_beside_it_too():
    motion, sensor, z, u, prior = satellites()
    f, z, u = presets.srckf(motion, sensor), z[:, :-1], gone(u)
    for call in (lambda: f(z, prior, u=u), lambda: f.step(f.init(prior), z[-1], u=u[-1])):
        with pytest.raises(ValueError, match="z: expected"):
            call()


def test_a_track_fails_where_what_is_measured_needs_it():
    motion, sensor, z, u, prior = satellites()
    u[3, 3] = torch.nan  # of the second satellite, which is measured
    assert int(presets.srckf(motion, sensor)(z, prior, u=u).failure.step) == 3


def test_a_track_fails_where_the_motion_needs_it():
    z, u = torch.zeros(4, 2, dtype=torch.float64), torch.ones(4, 2, dtype=torch.float64)
    z[2], u[2] = torch.nan, torch.nan
    prior = Gaussian(torch.zeros(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64))
    assert int(presets.srckf(Odometry(0.1, 0.1, 0.1), Position(1.0))(z, prior, u=u).failure.step) == 2
