"""Derivatives forwards, through kernels: those of the gradient, for all tracks and steps at once."""

import copy

import pytest
import torch
from torch.autograd import forward_ad

from torchfra.compiler.expressions import Expressions
from torchfra.compiler.tangents import _CONSTANT, _SLOPES, tangents


def along(f, name, tracks):
    """An estimate and its derivative in a hyperparameter."""
    parameters = dict(f.named_parameters())
    with torch.no_grad(), forward_ad.dual_level():
        dual = forward_ad.make_dual(parameters[name].detach(), torch.ones_like(parameters[name]))
        e = torch.func.functional_call(f, {name: dual}, (tracks.z, tracks.prior), {"u": tracks.u})
        return [forward_ad.unpack_dual(x) for x in (e.mean, e.scale_tril, e.log_likelihood)]


SOFT = {"learn": ("q", "threshold"), "temperature": 1.0}


@pytest.mark.slow
@pytest.mark.parametrize(("filter_name", "options"), [("srckf", {"learn": "all"}), ("fra", SOFT)])
def test_derivatives_forwards_are_those_backwards(filter_name, options, make, tracks):
    f = make(filter_name, **options).compile()
    e = f(tracks.z, tracks.prior, u=tracks.u)
    loss = e.log_likelihood.sum() + e.mean.square().mean() + e.scale_tril.square().sum()
    gradient = dict(zip(dict(f.named_parameters()), torch.autograd.grad(loss, list(f.parameters())), strict=True))
    for name, expected in gradient.items():
        mean, root, score = along(f, name, tracks)
        torch.testing.assert_close(mean.primal, e.mean.detach(), rtol=1e-12, atol=1e-9)
        rate = score.tangent.sum() + (2 * mean.primal * mean.tangent).mean() + (2 * root.primal * root.tangent).sum()
        torch.testing.assert_close(rate, expected, rtol=1e-8, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize(("filter_name", "options"), [("srckf", {"learn": ("q",)})])
def test_without_kernels_they_are_the_same(filter_name, options, make, tracks):
    f = make(filter_name, **options)
    for slow, fast in zip(*(along(g, "motion.q.raw", tracks) for g in (f, copy.deepcopy(f).compile())), strict=True):
        scale = slow.tangent.abs().max().item()
        torch.testing.assert_close(fast.tangent, slow.tangent, rtol=1e-8, atol=1e-9 * scale)


def test_they_are_those_of_differences_in_the_data_and_the_prior(make, tracks):
    f = make("srckf").compile()
    way = torch.randn(tracks.z.shape, dtype=torch.float64) * 1e-3

    def mean(size):
        return f(tracks.z + size * way, tracks.prior, u=tracks.u).mean

    with torch.no_grad(), forward_ad.dual_level():
        z = forward_ad.make_dual(tracks.z, way)
        rate = forward_ad.unpack_dual(f(z, tracks.prior, u=tracks.u).mean).tangent
    with torch.no_grad():
        difference = (mean(1e-3) - mean(-1e-3)) / 2e-3
    torch.testing.assert_close(rate, difference, rtol=1e-6, atol=1e-6 * difference.abs().max().item())


def test_a_call_without_directions_follows_one_with(make, tracks):
    f = make("srckf", learn=("q",)).compile()
    with torch.no_grad():
        before = f(tracks.z, tracks.prior, u=tracks.u).mean
        first = along(f, "motion.q.raw", tracks)[0].tangent
        assert torch.equal(f(tracks.z, tracks.prior, u=tracks.u).mean, before)
        assert torch.equal(along(copy.deepcopy(f), "motion.q.raw", tracks)[0].tangent, first)
    assert first.abs().max() > 0


POINTS = {"log": (0.7,), "acos": (0.3,), "pow": (1.3, 0.4), "atan2": (0.6, -0.8), "hypot": (0.6, -0.8)}


def value(book, number, known):
    """Of an expression, by torch."""
    if number in known:
        return known[number]
    if number in book.values:
        return torch.tensor(book.values[number], dtype=torch.float64)
    op, args = book.nodes[number]
    values = [value(book, i, known) for i in args]
    if op == "select":
        return torch.where(values[0].bool(), *values[1:])
    return getattr(torch, {"pow": "pow", "neg": "neg"}.get(op, op))(*values)


@pytest.mark.parametrize("op", _SLOPES)
def test_the_slope_of_every_operation_is_that_of_torch(op):
    book = Expressions()
    point = POINTS.get(op) or (0.4, 0.9)[: len(_SLOPES[op])]
    args, ways = [book.input() for _ in point], [book.input() for _ in point]
    result = book.apply(op, *args)
    rate = tangents(book, range(len(book.nodes)), dict(zip(args, ways, strict=True)))[result]
    values = [torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in point]
    exact = torch.autograd.grad(getattr(torch, op)(*values), values)
    known = dict(zip(args, values, strict=True)) | {i: torch.tensor(1.0 + k).double() for k, i in enumerate(ways)}
    expected = sum((1.0 + k) * g for k, g in enumerate(exact))
    torch.testing.assert_close(value(book, rate, known).detach(), expected, rtol=1e-12, atol=0)


def test_what_jumps_has_no_slope_and_what_has_no_rule_is_refused():
    book = Expressions()
    x, way = book.input(), book.input()
    for op in _CONSTANT - {"and", "or", "not"}:
        y = book.apply(op, *[x, book.constant(0.5)][: 2 if op in ("lt", "le", "eq") else 1])
        assert tangents(book, [x, y], {x: way})[y] == 0
    y = book.apply("lgamma", x)
    with pytest.raises(NotImplementedError, match="lgamma has no forward-mode derivative"):
        tangents(book, [x, y], {x: way})
