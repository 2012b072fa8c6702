"""Kernels divide as torch does: by numbers below the least normal one too, whose inverses are not finite."""

import pytest
import torch

from torchfra.compiler.run import Kernels
from torchfra.compiler.step import Input, Step

TINY = 1e-310


def advance(module, state, data):
    z, w = data["z"].unbind(-1)
    guarded = torch.where(z > 1e-300, z.log(), 0.0)
    return state, (w / z, guarded)


@pytest.mark.parametrize("tracks", [1, 13])
def test_quotients_and_gradients_of_tiny_numbers_are_those_of_torch(tracks):
    z = torch.tensor([[TINY, 3 * TINY], [TINY, 0.0], [0.5, 1.0]], dtype=torch.float64).expand(tracks, 3, 2).clone()
    state = (torch.ones(1, dtype=torch.float64),)
    step = Step(torch.nn.Module(), lambda *_: state, advance, {"z": Input(torch.Size([2]), True, False)}, z.dtype)
    kernels, found, expected = Kernels(step), [], []
    for run, kept in ((lambda x: kernels.run(x.shape[:1], 3, [state[0].expand(tracks, 1)], [x])[1], found),
                      (lambda x: advance(None, state, {"z": x})[1], expected)):  # fmt: skip
        x = z.clone().requires_grad_()
        quotient, logarithm = run(x)
        (gradient,) = torch.autograd.grad(logarithm.sum(), x)
        kept += [quotient.detach(), logarithm.detach(), gradient]
    assert all(x.isfinite().all() for x in expected)
    for a, b in zip(expected, found, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-13, atol=0.0)
