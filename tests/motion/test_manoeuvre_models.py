"""Motions whose acceleration forgets, and the common form with an acceleration, are what their papers say."""

import math

import pytest
import torch

from torchfra.motion import (
    ConstantAcceleration,
    ConstantVelocity,
    CoordinatedTurn,
    CurrentStatistical,
    Singer,
    WhiteJerk,
)

T = torch.tensor(2.0, dtype=torch.float64)


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def test_the_current_statistical_model_has_its_known_values():
    motion = CurrentStatistical(1 / 20, 1.0, dims=1)
    torch.testing.assert_close(
        motion.transition(T),
        tensor([1, 2, 1.9349672144], [0, 1, 1.9032516393], [0, 0, 0.904837418]), rtol=0, atol=1e-9,
    )  # fmt: skip
    root = motion.process_noise(T)
    spread = (4 - math.pi) / math.pi * 2 / 20
    q = tensor([1.5141988817, 1.8720490604, 1.2070532593], [1.8720490604, 2.4756762634, 1.8111834012],
               [1.2070532593, 1.8111834012, 1.8126924692])  # fmt: skip
    torch.testing.assert_close(root @ root.mT / spread, q, rtol=0, atol=1e-9)
    shift, _ = motion.adaptation(T)(tensor(0, 0, 1), None, root)
    torch.testing.assert_close(shift, tensor(0.0650327856, 0.0967483607, 0.095162582), rtol=0, atol=1e-9)


def test_an_acceleration_that_never_forgets_is_constant():
    for motion in (Singer(1.0, 0.0), Singer(1.0, 1e-9)):
        expected = ConstantAcceleration(1.0).transition(T)
        torch.testing.assert_close(motion.transition(T), expected, rtol=0, atol=1e-8)
    assert (Singer(1.0, 0.0).process_noise(T) == 0).all()


def test_the_mean_goes_on_as_at_constant_acceleration_and_the_noise_shrinks_towards_the_limit():
    motion = CurrentStatistical(0.3, 2.0, negative_limit=4.0)
    mean = tensor([1, 2, 3, 4, 1.0, -1.0], [1, 2, 3, 4, 2.5, -5.0], [0, 0, 0, 0, 0, 0])
    shift, noise = motion.adaptation(T)(mean, None, motion.process_noise(T))
    moved = mean @ motion.transition(T).mT + shift
    torch.testing.assert_close(moved, mean @ ConstantAcceleration(1.0).transition(T).mT)
    power = (noise @ noise.mT).diagonal(dim1=-2, dim2=-1)
    at_rest = power[2, 4]
    torch.testing.assert_close(
        power[0, 4:] / at_rest, tensor(0.25, (3 / 2) ** 2)
    )  # room 1 of 2, and 3 where 2 is scale
    torch.testing.assert_close(power[1, 4:], tensor(0, 0))


@pytest.mark.parametrize("rate", [0.0, 0.3, -0.02])
@pytest.mark.parametrize("dims", [2, 3])
def test_a_turn_with_an_acceleration_has_that_of_the_turn(rate, dims):
    narrow, wide = CoordinatedTurn(rate, 0.5, dims), CoordinatedTurn(rate, 0.5, dims, orders=3)
    n = 2 * dims
    x = torch.randn(3 * dims, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    moved = wide.transition(T) @ x
    torch.testing.assert_close(moved[:n], narrow.transition(T) @ x[:n])
    velocity = moved[dims:n]
    expected = torch.zeros(dims, dtype=torch.float64)
    expected[:2] = rate * torch.stack([-velocity[1], velocity[0]])
    torch.testing.assert_close(moved[n:], expected)
    root = wide.process_noise(T)
    torch.testing.assert_close(root[:n], narrow.process_noise(T))
    torch.testing.assert_close(root[n : n + 2], rate * torch.stack([-root[dims + 1], root[dims]]))


def test_constant_velocity_with_an_acceleration_sets_it_to_zero():
    narrow, wide = ConstantVelocity(0.5), ConstantVelocity(0.5, orders=3)
    x = tensor(1, 2, 3, 4, 5, 6)
    torch.testing.assert_close(wide.transition(T) @ x, torch.cat([narrow.transition(T) @ x[:4], tensor(0, 0)]))
    torch.testing.assert_close(wide.process_noise(T), torch.cat([narrow.process_noise(T), torch.zeros(2, 2).double()]))


@pytest.mark.parametrize("dt", [1e-3, 2.0, 60.0])
def test_white_jerk_has_its_textbook_covariance(dt):
    root = WhiteJerk(0.7, dims=1).process_noise(torch.tensor(dt, dtype=torch.float64))
    q = tensor([dt**5 / 20, dt**4 / 8, dt**3 / 6], [dt**4 / 8, dt**3 / 3, dt**2 / 2], [dt**3 / 6, dt**2 / 2, dt])
    torch.testing.assert_close(root @ root.mT, 0.7 * q, rtol=1e-12, atol=0)


def test_values_out_of_range_are_named():
    with pytest.raises(ValueError, match="orders: expected 2 or 3, received 4"):
        ConstantVelocity(1.0, orders=4)
    with pytest.raises(ValueError, match="alpha: expected a value of 0 or more"):
        Singer(1.0, -0.1)
    with pytest.raises(ValueError, match="limit: expected a value above 0"):
        CurrentStatistical(0.1, 0.0)
