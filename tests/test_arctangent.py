"""The arc tangent of kernels is that of torch, to a few roundings, signs of zeros included."""

import pytest
import torch

from torchfra.kernel.expressions import Expressions
from torchfra.kernel.program import Program, batch_first
from torchfra.kernel.source import Port, Scan


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
def test_the_arc_tangent_is_right_in_every_direction_and_at_every_scale(dtype):
    info, draw = torch.finfo(dtype), torch.Generator().manual_seed(0)
    special = torch.tensor([0.0, info.smallest_normal, info.tiny / 4, 1e-30, 1.0, 1e30, info.max, torch.inf, torch.nan])
    special = torch.cat([special, -special]).to(dtype)
    angles = torch.linspace(-torch.pi, torch.pi, 4001, dtype=dtype)
    scales = torch.tensor([1e-36, 1e-3, 1.0, 1e35], dtype=dtype)
    around = [torch.outer(scales, f(angles)).flatten() for f in (torch.sin, torch.cos)]
    anywhere = torch.randn(2, 4001, dtype=dtype, generator=draw).unbind()
    y, x = (
        torch.cat(parts)
        for parts in zip(torch.cartesian_prod(special, special).unbind(-1), around, anywhere, strict=True)
    )
    found, expected = kernel(y, x), torch.atan2(y, x)
    torch.testing.assert_close(found, expected, rtol=4 * info.eps, atol=info.smallest_normal, equal_nan=True)
    known = ~expected.isnan()
    assert torch.equal(found.signbit()[known], expected.signbit()[known])


def kernel(y, x):
    """The function alone in a kernel."""
    book = Expressions()
    inputs = [book.input(), book.input()]
    result = book.apply("atan2", *inputs)
    scan = Scan(
        book, [], [], [Port([i], torch.Size([])) for i in inputs], [Port([result], torch.Size([]))], dtype=y.dtype
    )
    (found,) = Program(scan)(y.shape, 1, [y, x])
    return batch_first(found, 1)
