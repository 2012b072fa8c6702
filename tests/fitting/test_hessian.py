"""The Hessian of a loss has the stated error, of compiled filters too."""

import pytest
import torch

from torchfra.filters.hessian import hessian


def parameter(*values):
    return torch.tensor(values, dtype=torch.float64, requires_grad=True)


def test_it_is_that_of_a_function_whose_second_derivatives_are_known():
    x, y = parameter(0.3, -1.2), parameter(2.0)
    found = hessian(lambda: (x[0] * x[1]).sin() * y.exp().sum() + x[1] ** 4, [x, y])
    exact = torch.autograd.functional.hessian(
        lambda v: (v[0] * v[1]).sin() * v[2].exp() + v[1] ** 4, torch.cat([x, y]).detach()
    )
    torch.testing.assert_close(found.matrix, exact, rtol=1e-8, atol=1e-8)
    assert ((found.matrix - exact).abs() <= found.error + 1e-10).all()
    assert x.tolist() == [0.3, -1.2]


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_steps_are_shares_of_large_numbers_and_no_smaller_than_those_of_one(size):
    x = parameter(size)
    found = hessian(lambda: x.log1p().sum(), [x])
    assert found.matrix.item() == pytest.approx(-((1 + size) ** -2), rel=1e-7)
    assert abs(found.matrix.item() + (1 + size) ** -2) < found.error.item() + 1e-9 * (1 + size) ** -2


@pytest.mark.slow
def test_of_a_compiled_filter_it_is_that_of_the_filter(make, tracks):
    found = []
    for compiled in (False, True):
        f = make("srckf", learn="all")
        f = f.compile() if compiled else f
        parameters = list(f.parameters())
        found.append(hessian(lambda f=f: -f(tracks.z, tracks.prior, u=tracks.u).log_likelihood.sum(), parameters))
    slow, fast = found
    scale = slow.matrix.abs().max()
    assert slow.matrix.shape == (len(parameters),) * 2
    torch.testing.assert_close(fast.matrix / scale, slow.matrix / scale, rtol=0, atol=1e-7)
    assert (slow.error < 1e-4 * scale).all()


def test_a_loss_with_an_edge_says_so():
    x = parameter(1e-5)
    assert hessian(lambda: x.abs().sum(), [x]).error > 1


def test_what_it_cannot_use_is_named_and_the_values_stay():
    x = parameter(1.0)
    for loss, parameters, words in (
        (lambda: x.sum(), [x.detach()], "parameters: expected leaves"),
        (lambda: x.sum(), [], "parameters: expected at least one"),
        (lambda: x.expand(2), [x], "loss: expected one number"),
        (lambda: x.log().sum() * torch.nan, [x], "loss: expected a finite gradient"),
    ):
        with pytest.raises(ValueError, match=words):
            hessian(loss, parameters)
        assert x.item() == 1.0
