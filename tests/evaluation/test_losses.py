"""Losses are what their names say, per track; a track with unknown truth or one that diverges spoils no other."""

import math

import numpy as np
import pytest
import torch

from torchfra import losses, presets
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position
from torchfra.types import Estimate, Gaussian

POSITION = slice(0, 2)


@pytest.fixture
def case():
    rng = torch.Generator().manual_seed(0)
    mean, truth = (torch.randn(5, 7, 4, dtype=torch.float64, generator=rng) for _ in range(2))
    truth[1, 3:] = torch.nan
    root = torch.randn(5, 7, 4, 4, dtype=torch.float64, generator=rng).tril()
    root = root + torch.diag_embed(4 * root.diagonal(dim1=-2, dim2=-1).sign())
    root = root * root.diagonal(dim1=-2, dim2=-1).sign().unsqueeze(-2)
    log_likelihood = torch.randn(5, 7, dtype=torch.float64, generator=rng)
    return Estimate(mean, root, log_likelihood.square(), log_likelihood, None), truth


@pytest.mark.parametrize("states", [POSITION, slice(2, 4)])
def test_mse_is_the_mean_squared_distance_over_known_steps(case, states):
    e, truth = case
    gap = (e.mean - truth)[..., states].numpy()
    expected = np.nanmean(np.where(np.isnan(gap).any(-1), np.nan, (gap**2).sum(-1)), 1)
    np.testing.assert_allclose(losses.mse(e.mean, truth, states), expected)
    robust = losses.robust_mse(e.mean, truth, states, 0.5)
    np.testing.assert_allclose(robust, np.log1p(expected / 0.25))


def test_one_diverged_track_cannot_dominate_the_robust_loss():
    truth, mean = torch.zeros(100, 5, 2).double(), torch.ones(100, 5, 2).double()
    mean[0] = 1e9
    mean.requires_grad_()
    losses.robust_mse(mean, truth, POSITION, 1.0).mean().backward()
    scaled = (mean.grad * mean).abs().sum((1, 2))  # what a relative change of each track's error does
    assert scaled[0] < 3 * scaled[1]


def test_nll_is_the_density_of_the_truth_with_its_gradient(case):
    e, truth = case
    for states in (None, POSITION, slice(1, 3), slice(0, 4, 2)):
        part = slice(None) if states is None else states
        log_p = torch.distributions.MultivariateNormal(
            e.mean[..., part], covariance_matrix=e.covariance[..., part, part]
        ).log_prob(truth[..., part].nan_to_num())
        known = ~truth.isnan().any(-1)
        expected = -(log_p * known).sum(-1) / known.sum(-1)
        torch.testing.assert_close(losses.nll(e, truth, states), expected)
    mean, root = (x.clone().requires_grad_() for x in e[:2])
    assert torch.autograd.gradcheck(
        lambda mean, root: losses.nll(Estimate(mean, root.tril(), e.nis, e.log_likelihood, None), truth, slice(1, 3)),
        (mean, root),
        atol=1e-4,
    )


def test_innovation_nll_needs_no_truth(case):
    e, _ = case
    torch.testing.assert_close(losses.innovation_nll(e), -e.log_likelihood.mean(-1))


@pytest.mark.parametrize("preset", [presets.srckf, presets.fra, presets.gpb, presets.imm_ckf])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_innovation_nll_is_the_same_for_a_track_that_is_padded(preset, dtype):
    """Mixtures have a likelihood of 1 but for rounding there."""
    motions = [ConstantVelocity(0.1), ConstantVelocity(9.0)]
    f = preset(motions if preset is presets.imm_ckf else motions[0], Position(2.0))
    z = torch.randn(2, 12, 2, generator=torch.Generator().manual_seed(0)).to(dtype)
    padded = torch.cat([z, torch.full((2, 30, 2), torch.nan, dtype=dtype)], 1)
    prior = Gaussian(torch.zeros(4, dtype=dtype), torch.eye(4, dtype=dtype))
    one, other = (losses.innovation_nll(f(x, prior)) for x in (z, padded))
    torch.testing.assert_close(one, other)


def test_calibration_is_zero_for_honest_covariances_and_the_same_for_too_large_and_too_small():
    rng = torch.Generator().manual_seed(1)
    root = torch.tensor([[2.0, 0.0, 0.0], [0.5, 1.0, 0.0], [0.1, 0.2, 3.0]], dtype=torch.float64)
    truth = torch.zeros(2000, 20, 3).double()
    mean = torch.randn(2000, 20, 3, dtype=torch.float64, generator=rng) @ root.mT
    zero = torch.zeros(2000, 20).double()

    def off(scale, states=None):
        return losses.calibration(Estimate(mean, scale * root.expand(2000, 20, 3, 3), zero, zero, None), truth, states)

    assert off(1.0) < 1e-4
    assert off(1.0, slice(1, 3)) < 1e-4
    assert off(2.0).item() == pytest.approx(math.log(4) ** 2, rel=0.02)
    assert off(0.5).item() == pytest.approx(off(2.0).item(), rel=0.02)


def test_angles_are_compared_within_half_a_turn(case):
    e, _ = case
    truth = e.mean.clone()
    turned = truth.clone()
    turned[..., 1] += 2 * math.pi
    assert losses.mse(e.mean, turned, POSITION, angles=[1]).max() < 1e-20
    assert losses.mse(e.mean, turned, POSITION).min() > 30
    torch.testing.assert_close(losses.nll(e, turned, angles=[1]), losses.nll(e, truth))


def test_a_track_without_any_truth_costs_nothing_and_passes_no_gradient():
    mean = torch.ones(2, 3, 2, dtype=torch.float64, requires_grad=True)
    truth = torch.zeros(2, 3, 2).double()
    truth[0] = torch.nan
    loss = losses.mse(mean, truth, POSITION)
    loss.sum().backward()
    assert loss[0] == 0
    assert (mean.grad[0] == 0).all()
    assert (mean.grad[1] != 0).all()


def test_every_loss_reaches_the_hyperparameters(make, tracks):
    for loss in (
        lambda e: losses.mse(e.mean, tracks.truth, POSITION).mean(),
        lambda e: losses.robust_mse(e.mean, tracks.truth, slice(2, 4), 10.0).mean(),
        lambda e: losses.nll(e, tracks.truth, POSITION).mean(),
        lambda e: losses.innovation_nll(e).mean(),
        lambda e: losses.calibration(e, tracks.truth, POSITION),
    ):
        f = make("fra", learn=("threshold", "q", "std"), temperature=1.0)
        loss(f(tracks.z, tracks.prior, u=tracks.u)).backward()
        assert all(p.grad.isfinite() and p.grad != 0 for p in f.parameters())


def test_a_scale_that_makes_no_sense_is_refused():
    with pytest.raises(ValueError, match="scale: expected a value above 0"):
        losses.robust_mse(torch.zeros(1, 2), torch.zeros(1, 2), POSITION, 0.0)
