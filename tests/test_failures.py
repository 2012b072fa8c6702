"""A track that fails says at which step and why, eager and compiled alike; a gradient that can be finite is."""

import copy

import pytest
import torch

from torchfra import Cause, Gaussian, learnable, presets
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position

PRIOR = Gaussian(torch.zeros(5, 4).double(), torch.eye(4).double())
Z = torch.zeros(5, 6, 2).double()


class Carried(Position):
    """Measures relative to a ship at ``u``."""

    def forward(self, x, u=None):
        return super().forward(x) - u


class Exploding(Position):
    """Measures numbers that no precision holds."""

    def forward(self, x, u=None):
        return super().forward(x) * torch.exp(1e3 + x[..., :1].abs())


@pytest.mark.parametrize("compiled", [False, True])
def test_the_step_and_the_cause_of_a_failure_are_told(compiled):
    f = presets.srckf(ConstantVelocity(1.0), Carried(2.0))
    f = f.compile() if compiled else f
    z, mean, u = Z.clone(), PRIOR.mean.clone(), torch.zeros_like(Z)
    mean[0, 1], z[1, 4, 0], u[2, 3, 1], mean[3] = torch.inf, -torch.inf, torch.nan, 1e300
    failure = f(z, Gaussian(mean, PRIOR.scale_tril), u=u).failure
    assert failure.step.tolist() == [0, 4, 3, -1, -1]
    assert failure.cause.tolist() == [Cause.PRIOR, Cause.MEASUREMENT, Cause.INPUT, Cause.NONE, Cause.NONE]
    told = ["prior, step 0", "measurement, step 4", "input, step 3"]
    assert failure.describe() == [f"track ({i},): {text}" for i, text in enumerate(told)]
    assert f(Z, PRIOR, u=torch.zeros_like(Z)).failure.describe() == []


@pytest.mark.parametrize("compiled", [False, True])
def test_numbers_that_leave_their_range_and_values_that_are_nan_are_told_apart(compiled):
    f = presets.srckf(ConstantVelocity(1.0), Exploding(2.0))
    f = f.compile() if compiled else f
    assert set(f(Z, PRIOR).failure.cause.tolist()) == {Cause.ARITHMETIC}
    f = presets.srckf(ConstantVelocity(1.0), Position(2.0))
    f.motion.q.raw.fill_(torch.nan)
    f = f.compile() if compiled else f
    failure = f(Z, PRIOR).failure
    assert (set(failure.step.tolist()), set(failure.cause.tolist())) == ({0}, {Cause.VALUE})


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("how", ["forward", "smooth"])
def test_gradients_of_shared_values_are_those_of_the_tracks_that_have_not_failed(how, compiled):
    rng = torch.Generator().manual_seed(0)
    z, dt = torch.randn(3, 6, 2, generator=rng).double(), torch.rand(3, 6, generator=rng).double() + 0.5
    bad = z.index_put((torch.tensor(1), torch.tensor(3)), torch.tensor(torch.inf).double())
    prior = Gaussian(torch.zeros(3, 4).double(), PRIOR.scale_tril)
    found = []
    for data, step, rows in ((bad, dt, [0, 2]), (z[[0, 2]], dt[[0, 2]], [0, 1])):
        f = presets.srckf(ConstantVelocity(1.0), Position(2.0), learn=["q", "std"])
        f = f.compile() if compiled else f
        data = data.clone().requires_grad_()
        of = Gaussian(prior.mean[: len(data)], prior.scale_tril)
        estimate = getattr(f, how)(data, of, dt=step)
        assert estimate.mean[1].isnan().any() == (len(data) == 3)
        (estimate.mean[rows].square().sum() + estimate.log_likelihood[rows].sum()).backward()
        found.append([estimate.mean.detach()[rows], data.grad[rows], *(p.grad for p in f.parameters())])
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other)


def test_failures_are_told_inside_transforms():
    f = presets.srckf(ConstantVelocity(1.0), Position(2.0))
    z = Z.clone()
    z[1, 4, 0] = torch.inf
    steps = torch.func.vmap(lambda z, mean: f(z, Gaussian(mean, PRIOR.scale_tril)).failure.step)(z, PRIOR.mean)
    assert steps.tolist() == [-1, 4, -1, -1, -1]


@pytest.mark.parametrize("unit", [1e-8, 1.0, 1e9, 1e12])
def test_gradients_of_fading_factors_are_finite_in_any_unit(unit):
    motion, sensor = ConstantVelocity(unit**2), Position(unit)
    f = learnable(presets.asrckf(motion, sensor), "all")
    z = (unit * torch.randn(3, 6, 2, generator=torch.Generator().manual_seed(0))).requires_grad_()
    z_far = z + unit * 1e3 * torch.nn.functional.one_hot(torch.tensor(3), 6).unsqueeze(-1)
    estimate = f(z_far, Gaussian(torch.zeros(4), unit * torch.eye(4)))
    assert not estimate.failed.any()
    ((estimate.mean / unit).square().sum() + estimate.log_likelihood.sum()).backward()
    assert z.grad.isfinite().all()
    assert all(p.grad.isfinite().all() for p in f.parameters() if p.grad is not None)


@pytest.mark.slow
def test_a_copy_of_a_failing_filter_fails_alike():
    f = presets.fra(ConstantVelocity(1.0), Position(2.0))
    z = Z.clone()
    z[1, 4, 0] = torch.inf
    slow, fast = f(z, PRIOR), copy.deepcopy(f).compile()(z, PRIOR)
    assert torch.equal(slow.failed, slow.failure.step >= 0)
    assert all(torch.equal(a, b) for a, b in zip(slow.failure, fast.failure, strict=True))
