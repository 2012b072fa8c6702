"""A bias that is considered: estimates are as they were, and covariances contain it."""

import math

import numpy as np
import pytest
import torch
from irregular import DT, F64, MOTION, PRIOR, close, measured
from oracles.lasting import lasting_errors

import torchfra
from torchfra import Gaussian, presets
from torchfra.catalogue import FILTERS
from torchfra.filters import biased_copies, considered
from torchfra.motion import ConstantVelocity, CoordinatedTurn, Odometry
from torchfra.sensors import Position

STD = torch.tensor([3.0, 5.0], **F64)


@pytest.mark.parametrize("std", [3.0, STD], ids=["one number", "each element"])
def test_covariances_are_those_of_gains_that_do_not_know_of_the_bias(std):
    f, z = presets.srckf(MOTION, Position(1.5)), measured()
    r = lasting_errors(
        z.numpy(), PRIOR.mean.numpy(), PRIOR.covariance.numpy(), [MOTION.transition(dt).numpy() for dt in DT],
        [(root @ root.mT).numpy() for root in map(MOTION.process_noise, DT)], np.eye(2, 4), 1.5**2 * np.eye(2),
        DT.numpy(), np.zeros(2), np.ones(2),
    )  # fmt: skip
    copies, variance = biased_copies(z, std), np.broadcast_to(np.asarray(std, dtype=float), 2) ** 2
    for prefix, run in (("", f), ("smoothed_", f.smooth)):
        estimate = considered(f, run(copies, PRIOR, dt=DT))
        close(estimate.mean, r[prefix + "mean"])
        bias = r[prefix + "bias"]
        close(estimate.covariance, r[prefix + "P"] + np.einsum("tim,m,tjm->tij", bias, variance, bias))


def test_errors_are_as_large_as_covariances_say_where_every_track_has_its_own_bias():
    rng = torch.Generator().manual_seed(7)
    position = torch.cumsum(0.1 * torch.randn(400, 60, 2, generator=rng, **F64), 1)
    bias = 4 * torch.randn(400, 1, 2, generator=rng, **F64)
    z = position + bias + torch.randn(400, 60, 2, generator=rng, **F64)
    f = presets.srckf(torchfra.motion.RandomWalk(0.01, 2), Position(1.0))
    prior = Gaussian(torch.zeros(2, **F64), 0.1 * torch.eye(2, **F64))
    estimates = f(biased_copies(z, 4.0), prior)
    nees = [torchfra.metrics.nees(e, position, slice(0, 2)).mean() / 2 for e in (considered(f, estimates), f(z, prior))]
    assert 0.9 < nees[0] < 1.1
    assert nees[1] > 20


@pytest.mark.parametrize("name", [n for n, entry in FILTERS.items() if not entry.scans and not entry.constant_gains])
def test_all_but_the_covariance_is_that_of_every_preset_without_a_bias(name):
    turns = [ConstantVelocity(0.3), CoordinatedTurn(0.1, 0.3), CoordinatedTurn(-0.1, 0.3)]
    bank = torchfra.motion.Bank(turns, neighbours=((1, 2), (0,), (0,)), first=(0, 1, 2))
    f, z = FILTERS[name].preset(bank if FILTERS[name].bank else MOTION, Position(1.5)), measured(2)[:, :4]
    plain = f(z, PRIOR, dt=DT[:4])
    estimate = considered(f, f(biased_copies(z, STD), PRIOR, dt=DT[:4]))
    torch.testing.assert_close(
        torchfra.tree.flatten(estimate._replace(scale_tril=None)),
        torchfra.tree.flatten(plain._replace(scale_tril=None)),
    )
    added = estimate.covariance - plain.covariance
    assert (torch.linalg.eigvalsh(added) > -1e-9).all()
    assert (added.diagonal(dim1=-2, dim2=-1)[:, 1:, :2] > 1.0).all()


def test_step_by_step_it_is_the_same():
    f, z = presets.gpb(MOTION, Position(1.5)), measured()
    estimate, state = considered(f, f(biased_copies(z, STD), PRIOR, dt=DT)), f.init(Gaussian(
        PRIOR.mean.expand(3, -1), PRIOR.scale_tril.expand(3, -1, -1)
    ))  # fmt: skip
    for k, dt in enumerate(DT):
        state, _ = f.step(state, biased_copies(z[k], STD), dt=dt)
        belief = considered(f, state.belief)
        close(belief.mean, estimate.mean[k])
        close(belief.covariance, estimate.covariance[k])


def test_a_heading_at_half_a_turn_is_not_torn_apart():
    f = presets.gpb(Odometry(1e-2, 1e-2, 1e-7), Position(1.0))
    prior = Gaussian(torch.tensor([0.0, 0, math.pi - 1e-3, 0], **F64), torch.tensor([1.0, 1, 0.3, 0.1], **F64).diag())
    z, u = torch.tensor([[-1.0, 0.0], [-2.0, 0.1]], **F64), torch.tensor([1.0, 0.0], **F64).expand(3, 2, 2)
    estimate = considered(f, f(biased_copies(z, 1.0), prior, u=u))
    assert (estimate.covariance[:, 2, 2] < 0.3).all()


def test_gradients_of_the_size_of_a_bias_are_those_of_finite_differences():
    f, z = presets.gpb(MOTION, Position(1.5)), measured()[:2]
    std = STD.clone().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda std: considered(f, f(biased_copies(z, std), PRIOR, dt=DT[:2])).covariance, (std,)
    )


def test_a_track_of_which_a_copy_fails_has_failed():
    f, z = presets.srckf(MOTION, Position(1.5)), measured()
    copies = biased_copies(z, STD)
    copies[2, 3, 1] = math.inf
    estimate = considered(f, f(copies, PRIOR, dt=DT))
    assert estimate.failure.step.item() == 3
    assert bool(estimate.failed)
    assert considered(f, f(biased_copies(z, STD), PRIOR, dt=DT)).failure.step.item() == -1


BAD = [
    (lambda: biased_copies(torch.zeros(5, 2), -1.0), r"std: expected finite values of 0 or more, received -1"),
    (lambda: biased_copies(torch.zeros(5, 2), math.nan), r"std: expected finite values of 0 or more, received nan"),
    (lambda: biased_copies(torch.zeros(5, 2), [1.0, 2, 3]), r"std: expected a number or \(2,\), received \(3,\)"),
    (lambda: considered(presets.srckf(MOTION, Position(1.5)), PRIOR), r"copies: expected the 3 of biased measurements"),
    (lambda: considered(f := presets.srckf(MOTION, Position(1.5)), f(measured(), PRIOR)), r"copies: expected the 3"),
    (
        lambda: considered(f := presets.srckf(MOTION, Position(1.5)), f(measured().expand(5, -1, -1), PRIOR)),
        r"copies: .* 3 of",
    ),
]


@pytest.mark.parametrize(("make", "message"), BAD)
def test_what_it_cannot_be_is_refused_by_name(make, message):
    with pytest.raises(ValueError, match=message):
        make()
