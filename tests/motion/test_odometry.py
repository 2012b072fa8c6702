"""A vehicle that measures its own way goes where its wheels and its compass or gyroscope say, less their errors."""

import math

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

import torchfra
from torchfra import Gaussian
from torchfra.hyper import learnable
from torchfra.motion import Augmented, GaussMarkov, Odometry
from torchfra.sensors import Biased, Position

COMPASS = Odometry(0.1, 0.02, 1e-3)
GYROSCOPE = Odometry(0.1, 0.02, 1e-3, 1e-5)


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def driven(x, dt, u, steps=20000):
    """Where small straight steps lead, midpoint by midpoint: with a gyroscope."""
    px, py, heading, log_scale, bias = x
    for _ in range(steps):
        middle = heading + (u[1] + bias) * dt / steps / 2
        px += u[0] * math.exp(log_scale) * math.cos(middle) * dt / steps
        py += u[0] * math.exp(log_scale) * math.sin(middle) * dt / steps
        heading += (u[1] + bias) * dt / steps
    return np.array([px, py, heading, log_scale, bias])


def test_with_a_measured_heading_a_step_is_straight():
    got = COMPASS(tensor(1, 2, 0.1, math.log(2)), tensor(0.5)[0], tensor(3, 0.4))
    torch.testing.assert_close(got, tensor(1 + 3 * math.cos(0.5), 2 + 3 * math.sin(0.5), 0.1, math.log(2)))


@pytest.mark.parametrize("rate", [-2.0, -0.05, 0.0, 1.5])
def test_with_a_gyroscope_a_step_is_the_arc_that_small_straight_steps_make(rate):
    x, u = [1.0, 2.0, 0.3, 0.1, 0.05], [4.0, rate]
    got = GYROSCOPE(tensor(*x), tensor(1.5)[0], tensor(*u))
    np.testing.assert_allclose(got, driven(x, 1.5, u), rtol=0, atol=1e-7)


def test_each_component_walks_with_the_density_that_is_given():
    for motion, densities in ((COMPASS, [0.1, 0.1, 0.02, 1e-3]), (GYROSCOPE, [0.1, 0.1, 0.02, 1e-3, 1e-5])):
        root = motion.process_noise(tensor(0.5, 2.0))
        torch.testing.assert_close(root @ root.mT, (tensor(*densities) * tensor(0.5, 2.0)[:, None]).diag_embed())


@pytest.mark.parametrize("motion", [COMPASS, GYROSCOPE], ids=["compass", "gyroscope"])
def test_its_gradients_are_right_where_it_turns_and_where_it_does_not(motion):
    x = torch.randn(3, motion.size, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    u = tensor([5.0, 0.3], [5.0, 0.0], [0.0, 0.0])
    assert gradcheck(motion, (x.requires_grad_(), tensor(0.5)[0].requires_grad_(), u.requires_grad_()))


def test_its_densities_can_be_learnt_as_far_as_they_are_above_zero():
    motion = learnable(Odometry(0.1, 0.02, 1e-3, 1e-5), "all")
    motion.process_noise(tensor(0.5)[0]).sum().backward()
    assert len(list(motion.parameters())) == 4
    assert all(p.grad.abs() > 0 for p in motion.parameters())


@pytest.mark.parametrize(("motion", "u", "said"), [
    (COMPASS, None, r"u: expected \(..., 2\), speed and heading, received None"),
    (GYROSCOPE, torch.zeros(3).double(), r"u: expected \(..., 2\), speed and turn rate, received \(3,\)"),
], ids=["none", "three"])  # fmt: skip
def test_a_step_without_speed_and_heading_is_an_error(motion, u, said):
    with pytest.raises(ValueError, match=said):
        motion(torch.zeros(motion.size).double(), tensor(1.0)[0], u)


@pytest.mark.parametrize("values", [(-1.0, 1, 1), (1.0, -1, 1), (1.0, 1, -1), (1.0, 1, 1, -1)])
def test_a_density_below_zero_is_an_error(values):
    with pytest.raises(ValueError, match="expected"):
        Odometry(*values)


@pytest.mark.slow
@pytest.mark.parametrize("motion", [COMPASS, GYROSCOPE], ids=["compass", "gyroscope"])
def test_it_has_no_problems_as_a_model(motion):
    report = torchfra.check_model(motion, Position(2.0), u=torch.tensor([3.0, 0.2]))
    assert report.ok, report


def test_a_wrong_scale_and_a_heading_that_is_off_are_found_from_positions():
    """Wheels that count 5 % too little and a compass 0.2 rad off, on a winding way: positions tell both."""
    generator = torch.Generator().manual_seed(5)
    steps = torch.arange(400).double()
    heading = (steps / 15).sin() + steps / 60
    u = torch.stack([torch.full_like(steps, 4.0), heading], -1)
    truth, x = [], tensor(0, 0, 0.2, math.log(1.05))
    for now in u:
        x = COMPASS(x, tensor(1.0)[0], now)
        truth.append(x)
    truth = torch.stack(truth)
    z = truth[:, :2] + 3 * torch.randn(400, 2, dtype=torch.float64, generator=generator)
    prior = Gaussian(torch.zeros(4).double(), tensor(1, 1, 0.5, 0.1).diag())
    motion, sensor = Odometry(1e-4, 1e-8, 1e-8), Position(3.0)
    estimate = torchfra.presets.srckf(motion, sensor)(z, prior, u=u)
    off = (estimate.mean[-1] - truth[-1])[2:]
    std = estimate.scale_tril[-1].square().sum(-1).sqrt()[2:]
    assert (off.abs() < 4 * std).all()
    assert (std < tensor(0.01, 0.005)).all()


def test_an_error_of_positions_that_lasts_is_told_from_those_that_do_not():
    """Positions off by 5 m for about 50 s at a time: the filter that has it in its state is sure of less, rightly."""
    generator = torch.Generator().manual_seed(6)
    steps, runs = 300, 40
    slow = GaussMarkov(5.0, 50.0, 2)
    error = 5 * torch.randn(runs, 2, dtype=torch.float64, generator=generator)
    one, errors = tensor(1.0)[0], []
    for _ in range(steps):
        noise = torch.randn(runs, 2, dtype=torch.float64, generator=generator)
        error = slow(error, one) + noise @ slow.process_noise(one).mT
        errors.append(error)
    u = torch.stack([torch.full((steps,), 3.0), (torch.arange(steps) / 9).sin()], -1).double()
    truth = torch.stack([3 * u[:, 1].cos(), 3 * u[:, 1].sin()], -1).cumsum(0)
    z = truth + torch.stack(errors, 1) + torch.randn(runs, steps, 2, dtype=torch.float64, generator=generator)
    motion, root = Odometry(1e-4, 1e-9, 1e-9), tensor(1, 1, 0.05, 0.05)
    without = torchfra.presets.srckf(motion, Position(1.0))(z, Gaussian(torch.zeros(4).double(), root.diag()), u=u)
    prior = Gaussian(torch.zeros(6).double(), torch.cat([root, tensor(5, 5)]).diag())
    within = torchfra.presets.srckf(Augmented(motion, slow), Biased(Position(1.0), [4, 5]))(z, prior, u=u)
    nees = {}
    for name, e in (("without", without), ("within", within)):
        off = e.mean[:, -1, :2] - truth[-1]
        root = torch.linalg.cholesky((e.scale_tril @ e.scale_tril.mT)[:, -1, :2, :2])
        nees[name] = torch.linalg.solve_triangular(root, off.unsqueeze(-1), upper=False).square().mean().item()
        nees[f"{name}, m"] = off.square().mean().sqrt().item()
    assert 0.6 < nees["within"] < 1.5
    assert nees["without"] > 5
    assert nees["within, m"] < nees["without, m"]
