"""Functions in kernels are those of torch, to a few roundings, at every scale."""

import itertools
import math

import pytest
import torch

from torchfra.compiler import native
from torchfra.compiler.expressions import Expressions
from torchfra.compiler.program import Program, batch_first
from torchfra.compiler.source import Port, Scan


@pytest.fixture(params=[native._LONG, 0], ids=["written out", "called"], autouse=True)
def long(request, monkeypatch):
    """Steps of more expressions call the arc tangent, which is written once."""
    monkeypatch.setattr(native, "_LONG", request.param)
    return request.param


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
    found, expected = kernel("atan2", y, x), torch.atan2(y, x)
    torch.testing.assert_close(found, expected, rtol=4 * info.eps, atol=info.smallest_normal, equal_nan=True)
    known = ~expected.isnan()
    assert torch.equal(found.signbit()[known], expected.signbit()[known])


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
@pytest.mark.parametrize("name", ["exp", "log"])
def test_exponentials_and_logarithms_are_right_up_to_the_ends_of_their_ranges(name, dtype):
    info, draw = torch.finfo(dtype), torch.Generator().manual_seed(0)
    tiny, largest = math.log(info.smallest_normal) - 40, math.log(info.max)
    exponents = torch.linspace(tiny - 3, largest + 3, 4001, dtype=dtype)
    special = torch.tensor([0.0, 1.0, info.smallest_normal, info.tiny / 4, info.max, torch.inf, torch.nan], dtype=dtype)
    around = 1 + 0.5 * torch.randn(4001, dtype=dtype, generator=draw)  # logarithms near 0, and of negative numbers
    x = torch.cat([special, -special, exponents, exponents.exp(), around])
    close_to = {"rtol": 4 * info.eps, "atol": 2 * info.tiny * info.eps, "equal_nan": True}  # 2 of the smallest number
    torch.testing.assert_close(kernel(name, x), getattr(torch, name)(x), **close_to)


@pytest.mark.parametrize("narrow", [False, True])
def test_a_long_step_has_the_arc_tangent_once_and_a_short_one_at_each_use(narrow, long):
    book = Expressions()
    inputs = [book.input() for _ in range(4)]
    ends = [book.apply("atan2", *pair) for pair in itertools.permutations(inputs, 2)]
    ports = [[Port(numbers, torch.Size([len(numbers)]))] for numbers in (inputs, ends)]
    source = Scan(book, [], [], *ports).source(narrow)
    assert source.count("@one_atan2(") == (1 + len(ends) if long == 0 else 0)


def kernel(name, *tensors):
    """The function alone in a kernel."""
    book, dtype = Expressions(), tensors[0].dtype
    inputs = [book.input() for _ in tensors]
    ports = [[Port([i], torch.Size([])) for i in numbers] for numbers in (inputs, [book.apply(name, *inputs)])]
    (found,) = Program(Scan(book, [], [], *ports, dtype=dtype))(tensors[0].shape, 1, tensors)
    return batch_first(found, 1)
