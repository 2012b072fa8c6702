"""A step of a compiled filter whose form is known does little but run, and keeps every promise of the first."""

import copy

import pytest
import torch

from torchfra.compiler import forms
from torchfra.compiler.engine import Compiled
from torchfra.steps.engine import INTERPRETED
from torchfra.tree import flatten
from torchfra.types import Gaussian


@pytest.fixture
def prepared(monkeypatch):
    """How often steps had to be prepared."""
    seen = []
    prepare = Compiled._prepare
    monkeypatch.setattr(Compiled, "_prepare", staticmethod(lambda *given: seen.append(1) or prepare(*given)))
    return seen


def stream(f, tracks, dtype=torch.float64, **more):
    """The first track, step by step: what each has said."""
    state = f.init(Gaussian(tracks.prior.mean[0].to(dtype), tracks.prior.scale_tril.to(dtype)))
    said = []
    for z, u in zip(tracks.z[0].to(dtype), tracks.u.to(dtype), strict=True):
        state, innovation = f.step(state, z, u=u, **more)
        said += flatten((state, innovation))
    return said


def close(slow, fast, tolerance=1e-10):
    for a, b in zip(slow, fast, strict=True):
        torch.testing.assert_close(b, a, rtol=tolerance, atol=tolerance)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["srckf", "fra"])
def test_a_stream_is_prepared_once_and_says_what_the_filter_says(name, make, tracks, prepared):
    f = make(name)
    fast = copy.deepcopy(f).compile()
    slow = stream(f, tracks)
    close(slow, stream(fast, tracks))
    steps = len(prepared)
    assert steps <= 2  # what init makes may hold a tensor twice
    close(slow, stream(fast, tracks))
    assert len(prepared) <= steps + 1


def test_a_batch_of_streams_is_ready_as_well(make, tracks, prepared):
    f = make("srckf")
    fast = copy.deepcopy(f).compile()
    state, other = f.init(tracks.prior), fast.init(tracks.prior)
    for k in range(4):
        state, slow = f.step(state, tracks.z[:, k], u=tracks.u[k])
        other, quick = fast.step(other, tracks.z[:, k], u=tracks.u[k])
        close([*flatten(state), *slow], [*flatten(other), *quick])
    assert len(prepared) == 2  # of what init makes, and of what a step makes


@pytest.mark.slow
def test_single_precision_reads_values_of_double_precision_as_they_are(make, tracks, prepared):
    f = make("srckf", learn=("q",))
    fast = copy.deepcopy(f).compile()
    with torch.no_grad():
        close(stream(f, tracks, torch.float32), stream(fast, tracks, torch.float32), 1e-3)
    assert len(prepared) == 1
    slopes = [torch.autograd.grad(stream(g, tracks, torch.float32)[-1], g.motion.q.raw)[0] for g in (f, fast)]
    assert slopes[1].dtype == torch.float64
    close(slopes[:1], slopes[1:], 1e-2)


@pytest.fixture
def ready(make, tracks):
    """A filter whose step is ready, a state and its arguments."""
    f = make("srckf").compile()
    state = f.init(Gaussian(tracks.prior.mean[0], tracks.prior.scale_tril))
    state, _ = f.step(state, tracks.z[0, 0], u=tracks.u[0])
    f.step(state, tracks.z[0, 1], u=tracks.u[1])
    return f, state, {"z": tracks.z[0, 1], "u": tracks.u[1]}


def test_results_are_new_each_time(ready):
    f, state, given = ready
    first = [*flatten(f.step(state, **given))]
    kept = [x.clone() for x in first]
    for x in first:
        x.fill_(0.0)
    again = flatten(f.step(state, **given))
    assert all(map(torch.equal, again, kept))
    assert len({x.untyped_storage().data_ptr() for x in (*first, *again, *flatten(state))}) == 14


def test_values_are_read_and_changes_noticed_between_two_steps(ready, prepared):
    f, state, given = ready
    before = f.step(state, **given)[0].belief.mean
    f.motion.q.set(5.0)
    after = f.step(state, **given)[0].belief.mean
    assert not prepared
    f.motion.q.raw.data = f.motion.q.raw.new_tensor(f.motion.q.raw.item())  # other memory
    assert torch.equal(f.step(state, **given)[0].belief.mean, after)
    assert not torch.equal(before, after)
    f.sensor.std = copy.deepcopy(f.sensor.std)  # a part replaced
    assert torch.equal(f.step(state, **given)[0].belief.mean, after)
    assert prepared


def test_whatever_does_not_fit_a_ready_step_is_refused_or_prepared(ready, prepared):
    f, state, given = ready
    expected = flatten(f.step(state, **given))
    second = torch.tensor(1.0, dtype=torch.float64)
    for dt in (second, second.expand(1)[0], 1, 1.0):
        close(expected, flatten(f.step(state, dt=dt, **given)), 0)
    assert not prepared
    for dt in (-second, torch.tensor(torch.nan), -1.0, "1"):
        with pytest.raises(ValueError, match="dt: expected"):
            f.step(state, dt=dt, **given)
    with pytest.raises(ValueError, match="z: expected"):
        f.step(state, given["z"][:1], u=given["u"])
    with pytest.raises(ValueError, match="state"):
        f.step(state.belief, **given)
    std = torch.full((2,), 0.02, dtype=torch.float64)
    for _ in range(2):
        f.step(state, std=std, **given)
    with pytest.raises(ValueError, match="std: expected"):
        f.step(state, std=-std, **given)


def test_memory_of_another_layout_and_lazy_negatives_give_the_same(ready):
    f, state, given = ready
    expected = flatten(f.step(state, **given))
    wide = torch.stack([given["u"], given["u"]], -1)[:, 0]
    assert not wide.is_contiguous()
    negative = torch.complex(torch.zeros_like(given["z"]), -given["z"]).conj().imag
    root = state.belief.scale_tril.mT.contiguous().mT
    other = state._replace(belief=Gaussian(state.belief.mean, root))
    for _ in range(2):
        close(expected, flatten(f.step(other, negative, u=wide)), 0)


@pytest.mark.slow
def test_a_gradient_flows_through_a_step_that_is_ready_without_one(ready):
    f, state, given = ready
    z = given["z"].clone().requires_grad_()
    slope = torch.autograd.grad(f.step(state, z, u=given["u"])[0].belief.mean.sum(), z)[0]
    f.engine = INTERPRETED
    close([torch.autograd.grad(f.step(state, z, u=given["u"])[0].belief.mean.sum(), z)[0]], [slope])


@pytest.mark.slow
def test_a_step_of_inference_mode_does_not_spoil_a_later_gradient(make, tracks):
    f = make("fra", temperature=0.5, learn=("threshold",)).compile()
    belief = Gaussian(tracks.prior.mean[0], tracks.prior.scale_tril)
    given = {"z": tracks.z[0, 0], "u": tracks.u[0], "dt": 0.875}  # neither has been seen before
    with torch.inference_mode():
        f.step(f.init(belief), **given)
    state, innovation = f.step(f.init(belief), **given)
    (slope,) = torch.autograd.grad(state.belief.mean.sum() + innovation.nis, f.robust.threshold.raw)
    assert slope.isfinite()


@pytest.mark.parametrize("private", [True, False], ids=["by torch", "by ourselves"])
def test_tensors_of_another_form_are_told_apart_with_and_without_torchs_own_check(private, monkeypatch):
    if not private:
        monkeypatch.setattr(forms.importlib, "import_module", lambda name: object())
    x = torch.zeros(2, 3)
    fits = forms.guard([x, x[0]])
    assert fits(torch.ones(2, 3), torch.ones(3))
    wrong = [torch.zeros(3, 2), torch.zeros(3, 2).mT, x.double(), torch.zeros(2, 3, requires_grad=True)]
    for other in (*wrong, torch.zeros(2, 3)._neg_view(), torch.nn.Parameter(x)):
        assert not fits(other, x[0])
