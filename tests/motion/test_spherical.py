"""Modified spherical coordinates go both ways, with their Jacobian, and a motion in them is the Cartesian one."""

import math

import numpy as np
import oracles
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchfra import coordinates, presets
from torchfra.coordinates import cartesian_jacobian, from_cartesian, jacobian, to_cartesian
from torchfra.motion import Bank, ConstantAcceleration, ConstantSpeed, ConstantVelocity, CoordinatedTurn, Spherical
from torchfra.sensors import InfraredLaser
from torchfra.types import Gaussian


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def somewhere(count, seed=0):
    rng = torch.Generator().manual_seed(seed)
    return torch.randn(count, 6, generator=rng, dtype=torch.float64) * tensor(3e3, 3e3, 1e3, 100, 100, 50)


@given(
    position=st.lists(st.floats(-1e5, 1e5), min_size=3, max_size=3).filter(lambda p: math.hypot(p[0], p[1]) > 10.0),
    velocity=st.lists(st.floats(-500, 500), min_size=3, max_size=3),
)
@settings(deadline=None, max_examples=60)
def test_there_and_back_is_where_it_began(position, velocity):
    x = tensor(*position, *velocity)
    state = from_cartesian(x)
    torch.testing.assert_close(to_cartesian(state), x, rtol=1e-9, atol=1e-9)
    assert 0 <= state[3] < 2 * math.pi


def test_both_ways_are_those_of_an_independent_oracle():
    for x in somewhere(20):
        np.testing.assert_allclose(from_cartesian(x), oracles.msc_from_cartesian(x.numpy()), rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(
            to_cartesian(from_cartesian(x)), oracles.msc_to_cartesian(from_cartesian(x).numpy()), rtol=1e-12
        )


def test_the_first_states_of_the_paper_are_these():
    starts = tensor([1500, 500, 1000, 30, 40, 50], [500, 1500, 1000, 40, 30, 50])
    expected = tensor(
        [-0.0152127766, 0.0108420948, 0.0328571429, 1.2490457724, 0.5639426414, 0.0005345225],
        [0.0152127766, 0.0108420948, 0.0328571429, 0.3217505544, 0.5639426414, 0.0005345225],
    )
    torch.testing.assert_close(from_cartesian(starts), expected, rtol=0, atol=5.1e-11)


def test_the_jacobians_are_the_derivatives_and_inverse_to_each_other():
    x = somewhere(50)
    state = from_cartesian(x)
    exact = torch.func.vmap(torch.func.jacrev(lambda y: from_cartesian(y)))(x)
    torch.testing.assert_close(jacobian(state), exact, rtol=1e-9, atol=1e-15)
    back = torch.func.vmap(torch.func.jacrev(lambda y: to_cartesian(y)))(state)
    torch.testing.assert_close(cartesian_jacobian(state), back, rtol=1e-9, atol=1e-9)
    eye = torch.eye(6, dtype=torch.float64).expand(50, 6, 6)
    torch.testing.assert_close(jacobian(state) @ back, eye, rtol=0, atol=1e-10)
    np.testing.assert_allclose(
        jacobian(from_cartesian(x)),
        [oracles.msc_jacobian(s.numpy()) for s in from_cartesian(x)],
        rtol=1e-10,
        atol=1e-18,
    )


def test_rates_are_finite_differences_of_what_is_seen():
    x, h = somewhere(20), 1e-3
    ahead, behind = (from_cartesian(torch.cat([x[:, :3] + s * h * x[:, 3:], x[:, 3:]], -1)) for s in (1, -1))
    rate = (ahead - behind) / (2 * h)
    state = from_cartesian(x)
    torch.testing.assert_close(state[:, 0], rate[:, 3] * state[:, 4].cos(), rtol=1e-5, atol=1e-9)
    torch.testing.assert_close(state[:, 1], rate[:, 4], rtol=1e-5, atol=1e-9)
    torch.testing.assert_close(state[:, 2], -rate[:, 5] / state[:, 5], rtol=1e-5, atol=1e-9)


def test_gradients_flow_both_ways():
    x = somewhere(3).requires_grad_()
    assert torch.autograd.gradcheck(from_cartesian, x, atol=1e-7)
    state = from_cartesian(somewhere(3)).requires_grad_()
    assert torch.autograd.gradcheck(lambda s: to_cartesian(s) / 1e3, state)
    assert torch.autograd.gradcheck(lambda s: jacobian(s), state)


def test_straight_above_the_sensor_states_are_nan_and_other_tracks_go_on():
    states = from_cartesian(tensor([0, 0, 1000, 10, 0, 0], [1, 0, 1000, 10, 0, 0]))
    assert states[0].isnan().any()
    assert states[1].isfinite().all()


@pytest.mark.parametrize("motion", [ConstantVelocity(0.3, 3), CoordinatedTurn(0.05, 0.3, 3)])
def test_a_step_is_the_cartesian_step(motion):
    x, dt = somewhere(10), tensor(2.0).squeeze()
    moved = Spherical(motion)(from_cartesian(x), dt)
    torch.testing.assert_close(to_cartesian(moved), motion(x, dt), rtol=1e-10, atol=1e-7)
    # steps of its own for each state
    each = torch.linspace(0.5, 5, 10, dtype=torch.float64)
    moved = Spherical(motion)(from_cartesian(x), each)
    torch.testing.assert_close(to_cartesian(moved), motion(x, each), rtol=1e-10, atol=1e-7)


@pytest.mark.parametrize("cartesian", [ConstantVelocity(0.3, 3), ConstantSpeed(0.3, 0.01)])
def test_the_process_noise_is_mapped_at_the_predicted_mean(cartesian):
    there, dt = somewhere(1)[0], tensor(1.5).squeeze()
    motion, x = Spherical(cartesian), from_cartesian(there)
    noise = motion.process_noise_at(motion.process_noise(dt), x, dt)
    root, J = cartesian.process_noise_at(cartesian.process_noise(dt), there, dt), oracles.msc_jacobian(x.numpy())
    expected = J @ (root @ root.mT).numpy() @ J.T
    np.testing.assert_allclose(noise @ noise.mT, expected, rtol=1e-10, atol=1e-22)


def test_the_state_says_which_components_are_position_and_rates():
    motion = Spherical(ConstantVelocity(0.3, 3))
    assert (motion.position, motion.velocity) == (slice(3, 6), slice(0, 3))
    assert not motion.linear


def crossing_north(steps=40):
    """A target that passes north of the sensor: its azimuth jumps from 2 pi to 0."""
    t = torch.arange(1, steps + 1, dtype=torch.float64).unsqueeze(-1)
    position = tensor(-400.0, 2000.0, 300.0) + t * tensor(20.0, 1.0, 0.0)
    return torch.cat([position, tensor(20.0, 1.0, 0.0).expand(steps, 3)], -1)


def test_a_target_that_passes_north_is_followed_over_the_jump():
    truth, sensor = crossing_north(), InfraredLaser(tensor(1e-3, 1e-3, 5.0))
    rng = torch.Generator().manual_seed(0)
    z = sensor(from_cartesian(truth)) + tensor(1e-3, 1e-3, 5.0) * torch.randn(40, 3, generator=rng, dtype=torch.float64)
    z[:, 0] = z[:, 0].remainder(2 * math.pi)
    root = torch.diag(tensor(30, 30, 30, 5, 5, 5))
    prior = coordinates.belief_from_cartesian(Gaussian(tensor(-400.0, 2000.0, 300.0, 20.0, 1.0, 0.0), root))
    for f in (presets.srckf, presets.iaukf, presets.ekf):
        estimate = f(Spherical(ConstantVelocity(0.25, 3)), sensor)(z, prior)
        assert (z[:, 0] > 6).any()
        assert (z[:, 0] < 0.5).any()
        assert ((estimate.mean[:, 3] >= 0) & (estimate.mean[:, 3] < 2 * math.pi)).all()
        assert (to_cartesian(estimate.mean)[10:, :3] - truth[10:, :3]).norm(dim=-1).max() < 15


def test_a_belief_there_and_back_is_what_it_was():
    belief = Gaussian(somewhere(5), torch.diag(tensor(30, 30, 30, 5, 5, 5)).expand(5, 6, 6))
    back = coordinates.belief_to_cartesian(coordinates.belief_from_cartesian(belief))
    torch.testing.assert_close(back.mean, belief.mean, rtol=1e-10, atol=1e-8)
    torch.testing.assert_close(back.covariance, belief.covariance, rtol=1e-8, atol=1e-6)


def test_the_sensor_measures_angles_and_range_in_blocks():
    sensor, x = InfraredLaser(1e-3), from_cartesian(somewhere(4))
    z = sensor(x)
    torch.testing.assert_close(z[:, :2], x[:, 3:5])
    torch.testing.assert_close(z[:, 2], 1 / x[:, 5])
    torch.testing.assert_close(sensor.locate(z), to_cartesian(x)[:, :3])
    assert sorted(i for block in sensor.blocks for i in block) == [0, 1, 2]


def test_a_metre_of_space_is_the_density_of_the_map():
    """The density in measurements of points that fall evenly in space: r^2 cos(elevation)."""
    sensor = InfraredLaser(1e-3)
    z = sensor(from_cartesian(somewhere(6)))
    volume = torch.func.vmap(torch.func.jacrev(sensor.locate))(z).det().abs()
    torch.testing.assert_close(1 / sensor.units_per_metre(z).prod(-1), volume)


def test_what_does_not_fit_is_named():
    with pytest.raises(ValueError, match="motion: expected one of 3 positions"):
        Spherical(ConstantAcceleration(1.0, 3))
    with pytest.raises(ValueError, match="models: expected motions of one state"):
        Bank([Spherical(ConstantVelocity(1.0, 3)), ConstantVelocity(1.0, 3)])
