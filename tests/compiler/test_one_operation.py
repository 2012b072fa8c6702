"""A compiled filter inside of ``torch.compile`` is one operation: no break in a graph, and no unrolled loop."""

import copy
import gc
import weakref

import pytest
import torch
from one_graph import needs_one_graph
from torch import nn

from torchfra import Gaussian
from torchfra.compiler import one_operation
from torchfra.tree import flatten

pytestmark = [needs_one_graph, pytest.mark.slow]
STEPS = 6


class Network(nn.Module):
    """A network that says how accurate each bearing is, and a filter behind it."""

    def __init__(self, f, **options):
        super().__init__()
        self.network, self.filter, self.options = nn.Linear(2, 2).double(), f, options

    def forward(self, z, prior, u):
        std = 0.02 * self.network(z.nan_to_num(0.0, 0.0)).exp()
        return self.filter(z, prior, u=u, std=std, **self.options)


@pytest.fixture
def data(tracks):
    return tracks.z[:, :STEPS], tracks.prior, tracks.u[:STEPS]


def graph_of(function, **options):
    """A function under ``torch.compile`` as one graph, and the operations of that, once it has been called."""
    torch._dynamo.reset()
    seen = []

    def backend(graph, _):
        seen.append([str(node.target) for node in graph.graph.nodes if node.op == "call_function"])
        return graph

    return torch.compile(function, backend=backend, fullgraph=True, **options), seen


def the_same(one, other):
    assert type(one) is type(other)
    for x, y in zip(flatten(one), flatten(other), strict=True):
        torch.testing.assert_close(x, y, rtol=1e-12, atol=1e-12, equal_nan=True)


@pytest.mark.parametrize(("name", "options"), [("fra", {}), ("iaukf", {})])
def test_the_whole_estimate_comes_out_as_without(name, options, make, data):
    model = Network(make(name, **options).compile())
    graph, seen = graph_of(model)
    the_same(graph(*data), model(*data))
    (operations,) = seen
    assert operations.count("torchfra.whole_tracks.default") == 1
    assert len(operations) < 30


def test_so_does_a_smoothed_one(make, data):
    f = make("rsrckf").compile()
    z, prior, u = data
    for options in ({}, {"lag": 2}):
        graph, seen = graph_of(lambda z, o=options: f.smooth(z, prior, u=u, **o))
        the_same(graph(z), f.smooth(z, prior, u=u, **options))
        assert seen[0].count("torchfra.whole_tracks.default") == 1


def test_gradients_of_the_network_and_of_the_filter_are_the_same(make, data):
    model = Network(make("fra", learn=("threshold", "q")).compile(), truncate=4)
    graph, _ = graph_of(model)

    def gradients(function):
        model.zero_grad()
        estimate = function(*data)
        (estimate.mean[..., :2].square().mean() - estimate.log_likelihood.mean()).backward()
        return [x.grad.clone() for x in model.parameters()]

    expected = gradients(model)
    assert all(x.abs().sum() > 0 for x in expected)
    torch.testing.assert_close(gradients(graph), expected, rtol=1e-9, atol=1e-9)


def test_the_operations_are_what_torch_asks_of_operations(make, data):
    f = make("srckf", learn=("q",)).compile()
    z, prior, u = data[0][:2, :4], Gaussian(data[1].mean[:2], data[1].scale_tril), data[2][:4]
    graph, _ = graph_of(lambda z: f(z, prior, u=u).mean)
    graph(z)
    ((name, call),) = vars(f.engine.calls).items()
    values = dict(f.named_parameters()) | dict(f.named_buffers())
    tensors = [z.clone().requires_grad_(), *prior, torch.ones(()).double(), u]
    given = name, tensors, [values[path] for path in call.values]
    torch.library.opcheck(one_operation.whole_tracks, given)
    assert torch.autograd.gradcheck(
        lambda x: one_operation.whole_tracks(name, [x, *tensors[1:]], given[2])[0], tensors[0]
    )


def test_other_numbers_of_tracks_and_steps_and_other_values_need_no_graph_of_their_own(make, data):
    f = make("srckf").compile()
    z, prior, u = data
    graph, seen = graph_of(lambda z, prior, u: f(z, prior, u=u), dynamic=True)
    graph(z[:3, :5], Gaussian(prior.mean[:3], prior.scale_tril), u[:5])  # sizes that are alike become one symbol
    f.motion.q.set(0.5)
    the_same(graph(z, prior, u), f(z, prior, u=u))
    assert len(seen) == 1


def test_a_filter_that_is_compiled_meanwhile_is_one_operation_too(make, data):
    model = Network(make("srckf").compile(wait=False))
    graph, seen = graph_of(model)
    the_same(graph(*data), model(*data))
    assert seen[0].count("torchfra.whole_tracks.default") == 1


def test_values_that_a_network_gives_reach_the_kernels(make, data):
    f = make("rsrckf").compile()
    z, prior, u = data
    raw = torch.linspace(-1.0, 1.0, len(z)).double().requires_grad_()

    def call(raw):
        return torch.func.functional_call(f, {"robust.threshold.raw": raw}, (z, prior), {"u": u}).mean

    graph, seen = graph_of(call)
    torch.testing.assert_close(graph(raw), call(raw), rtol=1e-12, atol=1e-12)
    assert seen[0].count("torchfra.whole_tracks.default") == 1
    torch.testing.assert_close(*(torch.autograd.grad(x(raw).square().sum(), raw)[0] for x in (graph, call)))


def test_a_copy_has_a_graph_of_its_own(make, data):
    f = make("srckf").compile()
    other = copy.deepcopy(f)
    other.motion.q.set(100.0)
    z, prior, u = data
    for g in (f, other):
        graph, _ = graph_of(lambda z, g=g: g(z, prior, u=u))
        the_same(graph(z), g(z, prior, u=u))


def test_a_filter_that_nobody_needs_is_gone(make, data):
    f = make("srckf").compile()
    z, prior, u = data
    graph_of(f)[0](z, prior, u=u)
    calls, gone = {*vars(f.engine.calls)}, weakref.ref(f)
    assert calls <= {*one_operation._CALLS}  # beside those of other filters, of which some may go as well
    del f
    torch._dynamo.reset()
    gc.collect()
    assert gone() is None
    assert not calls & {*one_operation._CALLS}


def test_a_shape_that_does_not_fit_is_named(make, data):
    f = make("srckf").compile()
    _, prior, u = data
    graph, _ = graph_of(lambda z: f(z, prior, u=u).mean)
    with pytest.raises(RuntimeError, match=r"z: expected \(\.\.\., T, 2\), received"):
        graph(torch.zeros(4, STEPS, 3).double())


def test_bad_values_are_named_when_it_runs(make, data):
    f = make("srckf").compile()
    z, prior, u = data
    graph, _ = graph_of(lambda std: f(z, prior, u=u, std=std).mean)
    with pytest.raises(ValueError, match="std: expected finite numbers above 0"):
        graph(-torch.ones_like(z))


def test_a_track_that_fails_is_told_and_leaves_gradients_of_the_others_alone(make, data):
    model = Network(make("srckf").compile())
    z, prior, u = data
    z = z.clone()
    z[3, 2, 0] = torch.inf
    graph, _ = graph_of(model)
    estimate = graph(z, prior, u)
    assert estimate.failure.describe() == ["track (3,): measurement, step 2"]
    estimate.mean[:3].square().mean().backward()
    assert model.network.bias.grad.isfinite().all()


def test_inside_a_transform_the_filter_is_traced_as_before(make, data):
    f = make("srckf").compile()
    z, prior, u = data
    mapped = torch.func.vmap(lambda x: f(x, prior, u=u[:1]).mean)
    graph, seen = graph_of(mapped)
    torch.testing.assert_close(graph(z[:, :1]), mapped(z[:, :1]), rtol=1e-9, atol=1e-9)
    assert "torchfra.whole_tracks.default" not in seen[0]
