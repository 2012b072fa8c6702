"""Tracks whose gradient is wanted again and again get ready too: gradients stay the same."""

import copy
import weakref

import pytest
import torch
from short_tracks import alone
from torch.autograd.graph import saved_tensors_hooks
from torch.utils.checkpoint import checkpoint

from torchfra.compiler import forms, ready, run
from torchfra.filters import SRCKF
from torchfra.tree import flatten
from torchfra.types import Gaussian

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(forms.hooked(), reason="this torch does not tell of hooks, so that nothing gets ready"),
]


@pytest.fixture
def soon(monkeypatch):
    """The second call with a gradient is ready."""
    monkeypatch.setattr(ready, "_LEARNING", 1)


def means(e):
    return e.mean.square().mean()


def scores(e):
    return -e.log_likelihood.sum()


def everything(e):
    return sum((x * torch.arange(x.numel()).reshape(x.shape).cos()).sum() for x in e[:4])


def last(e):
    return e.mean[..., -1, :].square().sum() + e.scale_tril[..., -1, :, :].sum()


def slopes(f, loss, given, learns=("values",)):
    """Gradients of a loss in the values, in the measurements, in the rest of what is given."""
    f.zero_grad()
    (z, (mean, root), u), dt = (given[name] for name in ("z", "prior", "u")), torch.ones((), dtype=torch.float64)
    z, mean, root, u = (x.clone().requires_grad_(part in learns) for x, part in
                        ((z, "measurements"), (mean, "rest"), (root, "rest"), (u, "rest")))  # fmt: skip
    dt.requires_grad_("rest" in learns)
    loss(f(z, Gaussian(mean, root), u=u, dt=dt)).backward()
    return [x.grad for x in (z, mean, root, u, dt, *f.parameters())]


@pytest.mark.parametrize(("name", "options", "learns", "losses"), [
    ("srckf", {}, ["values"], [means, scores, everything, last]),
    ("fra", {}, ["values", "measurements", "rest"], [everything]),
    ("fra", {"temperature": 1.0}, ["values", "rest"], [last]),
    ("iaukf", {}, ["rest"], [everything]),
])  # fmt: skip
def test_gradients_of_ready_tracks_are_those_of_the_filter(name, options, learns, losses, make, tracks, prepared, soon):
    f = make(name, learn="all", **options)
    fast, given = copy.deepcopy(f).compile(), {"z": tracks.z[:, :8], "prior": tracks.prior, "u": tracks.u[:8]}
    for loss in losses:
        slow = slopes(f, loss, given, learns)
        for _ in range(3):
            for a, b in zip(slow, slopes(fast, loss, given, learns), strict=True):
                a, b = (torch.zeros((), dtype=torch.float64) if x is None else x for x in (a, b))
                scale = a.abs().max().item()
                torch.testing.assert_close(*torch.broadcast_tensors(b, a), rtol=1e-9, atol=1e-9 * scale)
    assert len(prepared) == 1


def test_gradients_are_of_the_precision_of_what_they_are_for(make, tracks, soon):
    f = make("fra", learn="all")
    z, prior, u = tracks.z[:, :8].float(), Gaussian(*(x.float() for x in tracks.prior)), tracks.u[:8].float()
    found = []
    fast = f.compile()
    for _ in range(3):
        f.zero_grad()
        z = z.detach().requires_grad_()
        fast(z, prior, u=u).mean.square().mean().backward()
        found.append([z.grad, *(x.grad for x in f.parameters())])
    assert [x.dtype for x in found[0]] == [x.dtype for x in found[2]]
    for a, b in zip(found[0], found[2], strict=True):
        torch.testing.assert_close(b, a, rtol=1e-3, atol=1e-3 * a.abs().max().item())


def test_measurements_of_inference_mode_are_taken_as_others(make, tracks, soon):
    f = make("srckf", learn="all")
    with torch.inference_mode():
        given = alone(tracks)
        own = given | {"z": given["z"].clone()}
    slow, *fast = ([*torch.autograd.grad(g(**own).mean.square().sum(), [*g.parameters()])]
                   for g in (f, *[copy.deepcopy(f).compile()] * 3))  # fmt: skip
    for found in fast:
        for a, b in zip(slow, found, strict=True):
            torch.testing.assert_close(b, a, rtol=1e-9, atol=1e-9 * a.abs().max().item())


@pytest.mark.parametrize("options", [{"truncate": 4}, {"checkpoint": 3}])
def test_a_backward_pass_of_its_own_kind_is_not_that_of_ready_tracks(options, make, tracks, prepared, soon):
    fast, given = make("srckf", learn="all").compile(), alone(tracks)
    plain, other = ([torch.autograd.grad(fast(**given, **more).mean.square().sum(), [*fast.parameters()])[0]
                     for _ in range(3)] for more in ({}, options))  # fmt: skip
    assert torch.equal(other[0], other[2])
    assert torch.allclose(plain[0], other[0], rtol=1e-11, atol=0) == ("checkpoint" in options)
    assert len(prepared) == 4


def test_results_of_ready_tracks_that_learn_may_be_changed_and_used_twice(make, tracks, soon):
    fast, given = make("fra", learn="all").compile(), alone(tracks)
    found = []
    for _ in range(3):
        estimate = fast(**given)
        estimate.mean.mul_(2.0)
        loss = estimate.mean.sum()
        found.append([torch.autograd.grad(loss, [*fast.parameters()], retain_graph=True, allow_unused=True)
                      for _ in range(2)])  # fmt: skip
    for a, b in zip(flatten(tuple(map(tuple, found[0]))), flatten(tuple(map(tuple, found[2]))), strict=True):
        torch.testing.assert_close(b, a, rtol=1e-9, atol=1e-12)


def test_a_track_that_fails_says_so_beside_a_gradient(make, tracks, soon):
    fast, given = make("srckf", learn="all").compile(), {"z": tracks.z[:, :8], "prior": tracks.prior, "u": tracks.u[:8]}
    given["z"] = given["z"].clone()
    given["z"][1, 2, 0] = torch.inf
    for _ in range(3):
        fast.zero_grad()
        estimate = fast(**given)
        assert estimate.failure.step.tolist() == [-1, 2, -1, -1]
        estimate.mean[0].sum().backward()


class Named(SRCKF):
    """Learns a factor of the first mean, by the name of what it is of."""

    def __init__(self, motion, sensor):
        super().__init__(motion, sensor)
        self.mean = torch.nn.Parameter(torch.tensor([0.3], dtype=torch.float64))

    def begin(self, belief):
        return super().begin(belief._replace(mean=belief.mean * (1 + self.mean)))


def test_values_may_have_any_name(scenario, tracks, soon):
    f = Named(scenario.motion, scenario.sensor)
    fast, given = copy.deepcopy(f).compile(), {"z": tracks.z[:, :8], "prior": tracks.prior, "u": tracks.u[:8]}
    slow = slopes(f, last, given, ["values", "rest"])
    for _ in range(3):
        for a, b in zip(slow, slopes(fast, last, given, ["values", "rest"]), strict=True):
            assert (a is None) == (b is None)
            assert a is None or torch.allclose(a, b, rtol=1e-9)


def two_batches(tracks):
    """Two by two tracks."""
    prior = Gaussian(tracks.prior.mean.expand(4, 4).unflatten(0, (2, 2)), tracks.prior.scale_tril)
    return {"z": tracks.z[:, :8].unflatten(0, (2, 2)), "prior": prior, "u": tracks.u[:8]}


def test_gradients_may_lie_in_memory_in_any_way(make, tracks, soon):
    f, given = make("fra", learn=("threshold",)), two_batches(tracks)
    fast = copy.deepcopy(f).compile()
    expected = f(**given).mean
    (slow,) = torch.autograd.grad((expected.sum(-2) * expected[..., -1, :].detach()).sum(), [*f.parameters()])
    for _ in range(3):
        mean = fast(**given).mean
        (slope,) = torch.autograd.grad((mean.sum(-2) * mean[..., -1, :].detach()).sum(), [*fast.parameters()])
        torch.testing.assert_close(slope, slow, rtol=1e-9, atol=0.0)


def test_what_is_saved_may_be_stored_elsewhere_or_computed_anew(make, tracks, prepared, soon):
    f, given = make("fra", learn=("threshold",)).compile(), {"z": tracks.z.mT.contiguous().mT, "prior": tracks.prior}
    slopes = []

    def loss():
        return f(**given, u=tracks.u).mean.square().sum()

    for _ in range(3):
        slopes += torch.autograd.grad(loss(), [*f.parameters()])
        with saved_tensors_hooks(lambda x: x.contiguous().clone(memory_format=torch.contiguous_format), lambda x: x):
            slopes += torch.autograd.grad(loss(), [*f.parameters()])
        slopes += torch.autograd.grad(checkpoint(loss, use_reentrant=False), [*f.parameters()])
    for slope in slopes:
        torch.testing.assert_close(slope, slopes[0], rtol=1e-9, atol=0.0)


def test_many_tracks_whose_rows_are_padded_learn_too(make, scenario, soon):
    t = scenario.simulate(300, 0)
    given = {"z": t.z[:, :40], "prior": t.prior, "u": t.u[:40]}
    f = make("fra", learn=("threshold",))
    (slow,) = torch.autograd.grad(f(**given).mean.square().mean(), [*f.parameters()])
    f.compile()
    for _ in range(3):
        (slope,) = torch.autograd.grad(f(**given).mean.square().mean(), [*f.parameters()])
        torch.testing.assert_close(slope, slow, rtol=1e-8, atol=0.0)


def test_a_beginning_whose_gradient_kernels_cannot_compute_is_no_error(make, tracks, prepared, soon, monkeypatch):
    def refuse(*arguments):
        raise NotImplementedError("compile: kernels do not have it")

    monkeypatch.setattr(run, "begin_back", refuse)
    f, given = make("srckf", learn="all"), alone(tracks)
    slow = slopes(f, means, given)
    f.compile()
    for _ in range(3):
        for a, b in zip(slow, slopes(f, means, given), strict=True):
            assert a is None or torch.allclose(a, b, rtol=1e-9)
    assert len(prepared) == 3


def test_nothing_of_a_call_is_held(make, tracks, soon):
    fast, given = make("fra", learn="all").compile(), alone(tracks)
    for _ in range(3):
        z = given["z"].clone()
        estimate = fast(**given | {"z": z})
        estimate.mean.sum().backward()
    held = [weakref.ref(x) for x in (z, estimate.mean)]
    del z, estimate
    assert [x() for x in held] == [None, None]
