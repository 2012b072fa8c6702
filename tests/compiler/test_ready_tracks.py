"""Short tracks through a compiled filter whose form is known cost little but the run, and keep every promise."""

import copy
import importlib
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import pytest
import torch
from conftest import STEPS
from short_tracks import SMALL_GPB, alone

from torchfra.compiler import program
from torchfra.steps.engine import INTERPRETED
from torchfra.tree import flatten
from torchfra.types import Cause, Gaussian


def close(slow, fast, tolerance=1e-10):
    for a, b in zip(flatten(slow), flatten(fast), strict=True):
        torch.testing.assert_close(b, a, rtol=tolerance, atol=tolerance)


SETTINGS = {"srckf": {}, "fra": {}, "gpb": SMALL_GPB, "hghckf1": {}}


@pytest.mark.slow
@pytest.mark.parametrize("name", SETTINGS)
def test_the_second_call_says_what_the_filter_says_without_being_prepared(name, make, tracks, prepared):
    f = make(name, **SETTINGS[name])
    fast = copy.deepcopy(f).compile()
    for given in (alone(tracks), {"z": tracks.z[:, :8], "prior": tracks.prior, "u": tracks.u[:8]}):
        slow = f(**given)
        prepared.clear()
        for _ in range(3):
            close(slow, fast(**given))
        assert len(prepared) == 1


@pytest.fixture
def ready(make, tracks):
    """A filter for which one track is ready, and its arguments."""
    f, given = make("srckf").compile(), alone(tracks)
    f(**given)
    return f, given


def test_results_are_new_each_time(ready):
    f, given = ready
    first = flatten(f(**given))
    kept = [x.clone() for x in first]
    for x in first:
        x.zero_()
    assert all(map(torch.equal, flatten(f(**given)), kept))


@pytest.mark.slow
@pytest.mark.parametrize("steps", [1, 2])
def test_one_step_says_what_the_first_of_many_says(make, tracks, steps):
    f = make("fra")
    fast, given = copy.deepcopy(f).compile(), alone(tracks, steps)
    first = fast(**given)
    for _ in range(2):
        close(f(**given), fast(**given))
    assert all(map(torch.equal, flatten(first), flatten(fast(**given))))
    for x in flatten(first):
        assert x.stride() == torch.empty_like(x).stride() or x.shape[0] == steps


def test_tensors_are_made_where_torch_has_no_short_way_too(make, tracks, monkeypatch):
    given = alone(tracks)
    expected = make("fra")(**given)
    with suppress(ImportError):  # an older torch has no short way at all
        monkeypatch.delattr(importlib.import_module("torch._C._dynamo.guards"), "_empty_strided_cpu", raising=False)
    fast = make("fra").compile()
    for _ in range(2):
        close(expected, fast(**given))


def test_values_are_read_and_changes_noticed_between_two_calls(ready, prepared):
    f, given = ready
    before = f(**given).mean
    f.motion.q.set(5.0)
    after = f(**given).mean
    assert not prepared
    f.sensor.std = copy.deepcopy(f.sensor.std)  # a part replaced
    assert torch.equal(f(**given).mean, after)
    assert prepared
    assert not torch.equal(before, after)


@pytest.mark.slow
def test_whatever_does_not_fit_is_refused_or_prepared(ready, prepared):
    f, given = ready
    expected = f(**given)
    for dt in (1, 1.0):
        close(expected, f(dt=dt, **given), 0)
    assert not prepared
    second = torch.ones(8, dtype=torch.float64)
    for _ in range(2):
        close(expected, f(dt=second, **given))
    assert len(prepared) == 1
    for dt in (-1.0, torch.nan, -second, "1"):
        with pytest.raises(ValueError, match="dt: expected"):
            f(dt=dt, **given)
    with pytest.raises(ValueError, match="prior: expected a Gaussian"):
        f(**given | {"prior": tuple(given["prior"])})
    with pytest.raises(ValueError, match=r"z: expected"):
        f(**given | {"z": given["z"][:, :1]})
    std = torch.full((8, 2), 0.02, dtype=torch.float64)
    for _ in range(2):
        f(std=std, **given)
    with pytest.raises(ValueError, match="std: expected"):
        f(std=-std, **given)


def test_a_prior_with_any_root_is_made_triangular(ready):
    f, given = ready
    mean, root = given["prior"]
    turned, _ = torch.linalg.qr(torch.randn(4, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0)))
    close(f(**given), f(**given | {"prior": Gaussian(mean, root @ turned)}), 1e-9)


def test_a_prior_that_is_not_finite_fails_its_track(ready, prepared):
    f, given = ready
    mean, root = given["prior"]
    failure = f(**given | {"prior": Gaussian(mean * torch.nan, root)}).failure
    assert (failure.step.item(), failure.cause.item()) == (0, Cause.PRIOR)
    assert not prepared


def test_a_gradient_flows_through_tracks_that_are_ready_without_one(ready):
    f, given = ready
    z = given["z"].clone().requires_grad_()
    slopes = []
    for _ in range(2):
        slopes.append(torch.autograd.grad(f(**given | {"z": z}).mean.sum(), z)[0])
        f.engine = INTERPRETED
    close(*[(slope,) for slope in slopes])


@pytest.mark.slow
def test_the_past_and_what_is_settled_late_are_those_of_the_filter(make, tracks):
    f, given = make("gpb", **SMALL_GPB), alone(tracks)
    fast = copy.deepcopy(f).compile()
    for _ in range(2):
        close(f(past=True, **given), fast(past=True, **given), 1e-9)
        close(f(**given).info, fast(**given).info, 1e-9)


def test_each_form_is_remembered_by_itself(ready, tracks, prepared):
    f, given = ready
    shorter = alone(tracks, 5)
    f(**shorter)
    prepared.clear()
    assert f(**given).mean.shape == (8, 4)
    assert f(**shorter).mean.shape == (5, 4)
    assert not prepared


@pytest.mark.slow
def test_both_ends_of_a_track_are_part_of_the_kernel_where_nothing_of_the_past_is_kept(make, tracks, monkeypatch):
    for name in ("srckf", "fra", "gpb"):
        f, given = make(name, **SETTINGS[name]).compile(), alone(tracks)
        first = f(**given)
        monkeypatch.setattr(type(f), "begin", None)
        monkeypatch.setattr(type(f), "finish", None)
        close(first, f(**given))
        monkeypatch.undo()


@pytest.mark.slow
def test_priors_of_a_batch_of_one_in_single_precision_and_from_several_threads(make, tracks):
    f = make("fra")
    fast = copy.deepcopy(f).compile()
    mean, root = (x.float() for x in (tracks.prior.mean[:1], tracks.prior.scale_tril))
    given = {"z": tracks.z[:1, :8].float(), "prior": Gaussian(mean, root[None]), "u": tracks.u[:8].float()}
    slow = f(**given)
    close(slow, fast(**given), 2e-3)
    with ThreadPoolExecutor(4) as pool:
        for estimate in pool.map(lambda _: fast(**given), range(50)):
            close(slow, estimate, 2e-3)


def test_rows_that_lie_on_lines_of_the_cache_are_written_where_they_lie(make, tracks, monkeypatch):
    monkeypatch.setattr(program, "PAST", 1)
    fast, batch = make("srckf").compile(), (67,)
    given = alone(tracks, 3) | {"z": tracks.z[0, :3].expand(*batch, 3, 2).contiguous()}
    first = fast(**given)
    for _ in range(20):
        close(first, fast(**given), 0)
    close(first.mean[:1], fast(**alone(tracks, 3)).mean[None])


def test_a_filter_whose_finish_does_more_than_to_end_what_is_late_is_ready_all_the_same(make, tracks, prepared):
    f, given = make("srckf"), alone(tracks)
    moved = type("Moved", (type(f),), {"finish": lambda self, state, belief, info: (tree_moved(belief), info)})
    f.__class__ = moved
    expected, fast = f(**given), copy.deepcopy(f).compile()
    for _ in range(2):
        close(expected, fast(**given))
    assert len(prepared) == 1


@pytest.fixture
def two_threads():
    """Both kernels and their ends on two threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.mark.slow
def test_many_tracks_are_ready_once_they_have_come_often(make, tracks, prepared, two_threads):
    f, given = make("fra"), alone(tracks)
    noise = 0.01 * torch.randn(601, STEPS, 2, dtype=torch.float64)  # no multiple of the lanes of a register
    given["z"] = tracks.z[0] + noise
    fast = copy.deepcopy(f).compile()
    first = fast(**given)
    close(f(**given), first)
    for _ in range(15):
        close(first, fast(**given), 0)
    assert len(prepared) == 8
    wild = given["z"].clone()
    wild[200, 7] = torch.inf
    failure = fast(**given | {"z": wild}).failure
    assert len(prepared) == 8
    assert failure.step.tolist() == [7 if k == 200 else -1 for k in range(601)]
    assert failure.cause[200] == Cause.MEASUREMENT


def test_a_form_that_is_remembered_holds_no_memory_of_results(make, tracks):
    fast, given = make("srckf").compile(), alone(tracks)
    fast(**given)
    (known,) = fast.engine._versions[0].tracks.known.values()
    assert all(x.is_meta for x in known[0]._kernel._ready.like)


def tree_moved(belief):
    """A belief elsewhere."""
    return belief._replace(mean=belief.mean + 1)
