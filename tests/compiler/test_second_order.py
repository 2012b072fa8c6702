"""Gradients that there are not are said to be 0, or refused by name."""

import pytest
import torch

from torchfra import Gaussian, presets
from torchfra.filters.hessian import hessian
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position

PRIOR = Gaussian(torch.zeros(4).double(), torch.eye(4).double())
Z = torch.randn(5, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def made(preset, engine, **learn):
    f = preset(ConstantVelocity(1.0), Position(2.0), **learn)
    return f if engine == "eager" else f.compile()


@pytest.mark.parametrize("engine", ["eager", "compiled"])
@pytest.mark.parametrize("learn", ["threshold", "gate"])
def test_what_no_step_depends_on_has_a_gradient_of_zero(engine, learn):
    f = made(presets.fra, engine, learn=(learn,))
    for run in (f, f.smooth):
        estimate = run(0 * Z, PRIOR)
        (estimate.mean.square().sum() + estimate.log_likelihood.sum()).backward()
        assert [x.grad.item() for x in f.parameters()] == [0.0]
        f.zero_grad()


def test_a_second_derivative_of_a_compiled_filter_is_refused_and_says_what_there_is():
    f = made(presets.srckf, "compiled", learn=("q",))
    values = list(f.parameters())
    for _ in range(2):  # the second call is ready
        (gradient,) = torch.autograd.grad(f(Z, PRIOR).log_likelihood.sum(), values, create_graph=True)
        for ask in (lambda of: torch.autograd.grad(of, values), torch.Tensor.backward):
            with pytest.raises(
                NotImplementedError, match=r"first order.* torchfra.filters.hessian.hessian, or .* compile"
            ):
                ask(gradient.sum())
    (once,) = torch.autograd.grad(f(Z, PRIOR).log_likelihood.sum(), values)
    assert torch.equal(once, gradient)
    curvature = hessian(lambda: f(Z, PRIOR).log_likelihood.sum(), values)
    again = made(presets.srckf, "eager", learn=("q",))
    (of_eager,) = torch.autograd.grad(again(Z, PRIOR).log_likelihood.sum(), list(again.parameters()), create_graph=True)
    (expected,) = torch.autograd.grad(of_eager, list(again.parameters()))
    torch.testing.assert_close(curvature.matrix.squeeze(), expected, rtol=1e-6, atol=0)
