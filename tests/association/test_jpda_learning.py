"""Gradients through the association are exact, and the likelihood of scans identifies how they come about."""

import math

import pytest
import torch
from joint import PAPER, flat_prior, make, plane

from torchfra import losses
from torchfra.association import Clutter
from torchfra.motion import ConstantVelocity


def test_a_cold_gate_is_a_hard_one(crossing, scans):
    hard = make("iaukf_jpda", crossing, **PAPER)(scans.z, scans.prior)
    cold = make("iaukf_jpda", crossing, **PAPER, temperature=1e-6)(scans.z, scans.prior)
    torch.testing.assert_close(cold.mean, hard.mean, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_the_likelihood_of_the_scans_finds_how_often_targets_are_measured():
    """From 0.7 back to 0.9, from scans alone; false measurements are Poisson, as the model says."""
    f = plane(detection=0.7, clutter=Clutter(1e4, rate=3.0), learn=("detection",))
    rng = torch.Generator().manual_seed(0)
    z, prior = scenes(rng, 200, 12, 0.9, 3)
    optimiser = torch.optim.Adam(f.parameters(), lr=0.2)
    for _ in range(25):
        optimiser.zero_grad()
        losses.innovation_nll(f(z, prior)).mean().backward()
        optimiser.step()
    assert f.detection().item() == pytest.approx(0.9, abs=0.02)


def scenes(rng, runs, steps, detection, false):
    """Two targets that move as assumed, and about so many false measurements in a square of 100 m."""
    motion = ConstantVelocity(0.5, 2)
    one = torch.tensor(1.0).double()
    F, root = motion.transition(one), motion.process_noise(one)
    prior = flat_prior((-20.0, 0.0), (-20.0, 15.0))
    state = prior.mean + (prior.scale_tril @ torch.randn(runs, 2, 4, 1, generator=rng).double()).squeeze(-1)
    scans = []
    for _ in range(steps):
        state = (F @ state.unsqueeze(-1)).squeeze(-1)
        state = state + (root @ torch.randn(runs, 2, 2, 1, generator=rng).double()).squeeze(-1)
        z = state[..., :2] + 2.0 * torch.randn(runs, 2, 2, generator=rng).double()
        z = torch.where((torch.rand(runs, 2, 1, generator=rng) < detection), z, math.nan)
        clutter = 100 * torch.rand(runs, 9, 2, generator=rng).double() - 50
        clutter = torch.where(torch.rand(runs, 9, 1, generator=rng) < false / 9, clutter, math.nan)
        scans.append(torch.cat([z, clutter], 1))
    return torch.stack(scans, 1), prior
