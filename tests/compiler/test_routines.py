"""A step that is large has the code of what it does for each hypothesis once, and says the same."""

import copy
import re

import pytest
import torch
from alike import close
from gpb_cases import FEWER
from torch.autograd import forward_ad

from torchfra import Gaussian, presets
from torchfra.compiler import step
from torchfra.compiler.expressions import Expressions, Routine
from torchfra.compiler.schedule import cut
from torchfra.compiler.source import Scan
from torchfra.motion import Bank, ConstantVelocity
from torchfra.sensors import Position

PRIOR = Gaussian(torch.zeros(2).double(), torch.tensor([[5.0, 0.0], [1.0, 2.0]]).double())


@pytest.fixture
def written(monkeypatch):
    """Every step is large; the sources of kernels."""
    sources, source = [], Scan.source

    def kept(self, narrow=False):
        sources.append(source(self, narrow))
        return sources[-1]

    monkeypatch.setattr(step, "_MOST", 10)
    monkeypatch.setattr(Scan, "source", kept)
    return sources


def gpb():
    """Of two motions on a line."""
    motions = Bank([ConstantVelocity(1.0, dims=1), ConstantVelocity(30.0, dims=1)])
    return presets.gpb(motions, Position(5.0, dims=1), **FEWER)


def measured(tracks, steps=6):
    draw = torch.Generator().manual_seed(3)
    z = 10 * torch.randn(tracks, steps, 1, generator=draw).double().cumsum(-2)
    z[0, 2] = torch.nan
    return z


@pytest.mark.slow
def test_estimates_smoothed_ones_and_their_gradients_are_the_same(written):
    said = []
    for f in (gpb(), gpb().compile()):
        z = measured(tracks=100).requires_grad_()
        smoothed = f.smooth(z, PRIOR)
        (smoothed.mean.sum() + smoothed.scale_tril.square().sum()).backward()
        said.append((smoothed, z.grad))
    close(*(x[0] for x in said))
    close(*(x[1] for x in said), tolerance=1e-9)
    assert len(written) == 4
    for source in written:
        defined = re.findall(r"^define (?:internal|hidden) void @(\w+_r\d+)\(", source, re.MULTILINE)
        called = re.findall(r"^call void @(?:through\(.*@)?(\w+_r\d+)[(,]", source, re.MULTILINE)
        calls = [called.count(name) for name in defined]
        assert len(set(defined)) == len(defined) > 0
        assert min(calls) >= 1
        assert sum(calls) >= 1.5 * len(calls)


@pytest.mark.slow
def test_one_track_alone_is_the_same(written):
    with torch.no_grad():
        close(*(f.smooth(measured(tracks=1), PRIOR) for f in (gpb(), gpb().compile())))


@pytest.mark.slow
def test_derivatives_forwards_are_the_same(written):
    f, z = gpb(), measured(9)
    with torch.no_grad(), forward_ad.dual_level():
        rates = [
            forward_ad.unpack_dual(g(forward_ad.make_dual(z, torch.ones_like(z)), PRIOR).mean).tangent
            for g in (f, copy.deepcopy(f).compile())
        ]
    close(*rates)


def test_a_step_at_the_limit_can_still_be_simplified_and_differentiated(monkeypatch):
    def advance(module, state, data):
        (x,) = state
        return (torch.exp(torch.where(x > 0, data["a"], 0.5 * data["a"])),), x

    def made():
        inputs = {"a": step.Input(torch.Size([2]), False, False)}
        return step.Step(torch.nn.Module(), lambda *_: (torch.ones(2).double(),), advance, inputs, torch.float64)

    usual = made()
    known = usual.plain.book
    monkeypatch.setattr(step, "_MOST", len(known.nodes))
    at_the_limit = made()
    assert len(at_the_limit.plain.book.nodes) == len(known.nodes)
    assert not at_the_limit._large
    assert at_the_limit.forwards().source() == usual.forwards().source()
    assert len(at_the_limit.tangent(["a"]).book.nodes) > len(known.nodes)


def test_a_call_with_thousands_of_results_stays_in_one_piece():
    book = Expressions()
    inner = book.nested()
    x = inner.input()
    outputs = [inner.apply("add", x, inner.constant(k)) for k in range(1, 9001)]
    results = book.call(Routine("many_r0", inner, [x], outputs, outputs, 9000), [book.input()])
    total = book.sum(results)
    numbers = book.needed([total])
    parts = cut(book, numbers)
    assert [i for part in parts for i in part] == numbers
    first = next(part for part in parts if results[0] in part)
    assert {book.nodes[results[0]][1][0], *results} <= {*first}
    assert len(parts) > 1
