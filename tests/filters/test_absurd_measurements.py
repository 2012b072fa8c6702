"""A measurement whose square no number holds is an outlier like any other, in either precision, eager and compiled."""

import pytest
import torch

from torchfra import Gaussian, presets
from torchfra.gaussian.mixture import nearest
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position

SENSOR = Position(2.0)
BANK = [ConstantVelocity(1.0), ConstantVelocity(100.0)]
FILTERS = {
    "gpb": lambda: presets.gpb(ConstantVelocity(1.0), SENSOR),
    "gpb of hard manoeuvres": lambda: presets.gpb(ConstantVelocity(1.0), SENSOR, manoeuvres="hard"),
    "gpb of a bank": lambda: presets.gpb(BANK, SENSOR),
    "gpb with a second target": lambda: presets.gpb(ConstantVelocity(1.0), SENSOR, same_offset=0.5),
    "imm_fra": lambda: presets.imm_fra(BANK, SENSOR),
}
LARGE = {torch.float64: (1e150, [1e154, 1e160, 1e300]), torch.float32: (1e17, [1e19, 1e20, 9.97e36])}
"""Of each precision a number whose square fits, and some whose square does not."""


def tracks(dtype, absurd):
    z = torch.randn(30, 2, generator=torch.Generator().manual_seed(0)).to(dtype).repeat(len(absurd), 1, 1)
    z[:, 10, 0] = torch.tensor(absurd, dtype=dtype)
    return z, Gaussian(torch.zeros(4, dtype=dtype), torch.eye(4, dtype=dtype))


@pytest.mark.parametrize("dtype", LARGE)
@pytest.mark.parametrize("name", FILTERS)
def test_estimates_are_those_beside_a_large_measurement_whose_square_fits(name, dtype):
    large, absurd = LARGE[dtype]
    estimate = FILTERS[name]()(*tracks(dtype, [large, *absurd]))
    assert not estimate.failed.any()
    tol = 1e3 * torch.finfo(dtype).eps
    torch.testing.assert_close(estimate.mean[1:], estimate.mean[:1].expand_as(estimate.mean[1:]), rtol=tol, atol=tol)


def test_the_compiled_filter_does_what_the_interpreted_one_does():
    f = FILTERS["gpb"]()
    arguments = tracks(torch.float64, [1e160, 1e300])
    slow, fast = f(*arguments), f.compile()(*arguments)
    for one, other in zip(slow[:4], fast[:4], strict=True):
        torch.testing.assert_close(one, other)


def test_the_likelihood_falls_with_the_logarithm_of_an_outlier_whether_its_square_fits_or_not():
    sizes = torch.logspace(150, 300, 6, dtype=torch.float64)
    logs = FILTERS["gpb"]()(*tracks(torch.float64, sizes.tolist())).log_likelihood[:, 10]
    torch.testing.assert_close(logs.diff(), (-2 * sizes.log()).diff(), rtol=1e-9, atol=0)


def test_gradients_beside_an_absurd_measurement_are_finite():
    z, prior = tracks(torch.float64, [1e160])
    estimate = FILTERS["gpb"]()(z.requires_grad_(), prior)
    estimate.mean.square().sum().backward()
    assert z.grad.isfinite().all()


@pytest.mark.parametrize("dtype", LARGE)
def test_the_nearest_of_several_plain_models_follows_it_and_probabilities_sum_to_one(dtype):
    estimate = presets.imm(BANK, SENSOR)(*tracks(dtype, LARGE[dtype][1][:2]))
    assert not estimate.failed.any()
    assert (estimate.info.probabilities[:, 10] == torch.tensor([0.0, 1.0])).all()
    torch.testing.assert_close(estimate.info.probabilities.sum(-1), torch.ones(2, 30, dtype=dtype))


def test_the_nearest_is_so_by_its_distance_and_not_by_the_sign_of_a_residual():
    none, far = torch.full((3,), -torch.inf), torch.tensor([[1e25, 1e25], [-3e25, 0.0], [2e25, torch.nan]])
    assert nearest(none, far).tolist() == [0.0, -torch.inf, -torch.inf]
    known = torch.tensor([-torch.inf, -5.0, -torch.inf])
    assert nearest(known, far).tolist() == known.tolist()
