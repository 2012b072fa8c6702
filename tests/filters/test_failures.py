"""A track that fails says at which step and why, eager and compiled alike; a gradient that can be finite is."""

import pytest
import torch
from conftest import PRESETS

from torchfra import Cause, Gaussian, learnable, presets
from torchfra.adaptive import SageHusa
from torchfra.filters import SRCKF
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


ABSURD = [("fra", {}), ("fra", {"plain": 0.0}), ("fra_srckf", {}), ("fra", {"temperature": 1.0}), ("rsrckf", {})]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("name", "options"), ABSURD)
def test_gradients_of_a_measurement_whose_square_no_number_holds_are_finite_beside_it_and_in_its_own_track(
    name, options, dtype
):
    absurd = torch.finfo(dtype).max ** 0.6
    f = getattr(presets, name)(ConstantVelocity(1.0), Position(2.0), learn="all", **options)
    z = torch.randn(3, 8, 2, generator=torch.Generator().manual_seed(0)).to(dtype)
    z[1, 4, 0] = absurd
    estimate = f(z.requires_grad_(), Gaussian(torch.zeros(4, dtype=dtype), torch.eye(4, dtype=dtype)))
    assert not estimate.failed[[0, 2]].any()
    for loss in (estimate.mean.nansum(), estimate.log_likelihood.nansum(), estimate.mean[[0, 2]].sum()):
        grads = torch.autograd.grad(loss, [z, *f.parameters()], retain_graph=True, allow_unused=True)
        assert all(x is None or x.isfinite().all() for x in grads)


@pytest.mark.parametrize("compiled", [False, True])
def test_fading_goes_on_after_a_measurement_whose_square_no_number_holds(compiled):
    f = presets.fra(ConstantVelocity(1e-4), Position(2.0), memory="plain")
    f = f.compile() if compiled else f
    z = torch.zeros(2, 12, 2).double()
    z[:, 8:, 0] = 40.0 * torch.arange(4)  # a manoeuvre
    z[0, 3], z[1, 3] = torch.nan, 1e200
    first, second = f(z, Gaussian(torch.zeros(4).double(), torch.eye(4).double())).info.fading[:, 8:]
    assert first.max() > 1
    assert ((first > 1) == (second > 1)).all()


@pytest.mark.parametrize("adapt", ["innovation", "residual"])
def test_an_estimate_of_the_noise_that_stands_at_its_bound_has_finite_gradients(adapt):
    noise = SageHusa([[0, 1]], adapt=adapt, warmup=0)
    f = learnable(SRCKF(ConstantVelocity(1.0), Position(2.0), noise=noise), "all")
    z = Z.clone()
    z[1, 3, 0] = 1e160
    f(z, PRIOR).mean[[0, 2, 3, 4]].square().sum().backward()
    assert all(p.grad.isfinite().all() for p in f.parameters())


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


@pytest.mark.parametrize("name", PRESETS)
def test_no_initial_uncertainty_has_finite_gradients(name, make, tracks):
    f = make(name, learn=("q", "std"))
    prior = Gaussian(tracks.prior.mean, torch.zeros_like(tracks.prior.scale_tril))
    e = f(tracks.z, prior, u=tracks.u)
    assert not e.failed.any()
    e.mean.square().mean().backward()
    assert all(p.grad.isfinite().all() for p in f.parameters())
