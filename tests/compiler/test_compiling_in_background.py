"""A filter that does not wait for its kernels answers at once, interpreted, and later by the kernels."""

import copy
import gc
import os
import subprocess
import sys
import threading
import time

import pytest
import torch
from alike import close

from torchfra import presets, scenarios, tree
from torchfra.compiler import jit, program
from torchfra.compiler.program import Making, building
from torchfra.compiler.step import Step
from torchfra.motion import RandomWalk
from torchfra.sensors import Position
from torchfra.types import CompileError, Gaussian


@pytest.fixture
def tracks():
    return scenarios.bearings_outliers().simulate(runs=3, seed=0)


@pytest.fixture
def gate(monkeypatch):
    """Lets kernels be compiled when it is set."""
    opened, load = threading.Event(), jit.load

    def wait(source):
        assert opened.wait(60)
        return load(source)

    monkeypatch.setattr(jit, "load", wait)
    yield opened
    opened.set()


def filters(**options):
    scenario = scenarios.bearings_outliers()
    f = presets.srckf(scenario.motion, scenario.sensor, **options)
    return f, copy.deepcopy(f).compile(wait=False)


def finished(f):
    """Waits for the threads that compile."""
    for made in f.engine._made.values():
        made.exception(60)


@torch.no_grad()
def test_it_answers_interpreted_first_and_compiled_later(tracks, gate):
    plain, f = filters()
    expected = plain(tracks.z, tracks.prior, u=tracks.u)
    first = f(tracks.z, tracks.prior, u=tracks.u)
    assert torch.equal(first.mean, expected.mean)
    gate.set()
    finished(f)
    later = f(tracks.z, tracks.prior, u=tracks.u)
    close(later, expected)
    assert not torch.equal(later.mean, expected.mean)  # another order of sums


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
@torch.no_grad()
def test_the_backward_pass_is_made_while_the_filter_compiles(dtype, scenario, monkeypatch):
    tracks, load, both, loaded = scenario.simulate(3, 0), jit.load, threading.Barrier(2), []

    def at_once(source):
        loaded.append(source)
        both.wait(300)  # breaks where one is compiled after the other
        return load(source)

    monkeypatch.setattr(jit, "load", at_once)
    plain = presets.imm_srckf(scenario.bank, scenario.sensor)
    f = copy.deepcopy(plain).compile()
    z, prior, u = tree.map_tensors(lambda x: x.to(dtype), (tracks.z[:, :5], tracks.prior, tracks.u[:5]))
    tolerance = 1e-8 if dtype == torch.float64 else 0.1  # models amplify rounding
    close(f.smooth(z, prior, u=u), plain.smooth(z, prior, u=u), tolerance)
    assert len({*loaded}) == len(loaded) == 2


@torch.no_grad()
def test_the_backward_pass_of_one_track_whose_state_has_a_number_is_made_too(monkeypatch):
    raised, options = [], {"outlier_durations": (10.0, 10.0), "manoeuvres": "none"}
    monkeypatch.setattr(threading, "excepthook", raised.append)
    plain = presets.gpb(RandomWalk(1.0, 1), Position(1.0, dims=1), **options)  # its state counts seconds
    f = copy.deepcopy(plain).compile()
    z, prior = torch.zeros(3, 1).double(), Gaussian(torch.zeros(1).double(), torch.eye(1).double())
    close(f.smooth(z, prior), plain.smooth(z, prior))
    assert not raised


@torch.no_grad()
def test_a_step_neither_waits_nor_sees_what_becomes_of_its_tensors(tracks, gate):
    plain, f = filters()
    state, z = f.init(tracks.prior), tracks.z[:, 0].clone()
    expected = plain.step(state, z, u=tracks.u[0])
    started = time.monotonic()
    assert torch.equal(f.step(state, z, u=tracks.u[0])[0].belief.mean, expected[0].belief.mean)
    assert time.monotonic() - started < 30  # it would wait a minute
    z.fill_(torch.nan)
    gate.set()
    finished(f)
    close(f.step(state, tracks.z[:, 0], u=tracks.u[0]), expected)


def test_gradients_wait(tracks):
    plain, f = filters(learn=("q",))
    for one in (plain, f):
        one(tracks.z, tracks.prior, u=tracks.u).log_likelihood.sum().backward()
    assert not f.engine._made
    close(*([p.grad for p in one.parameters()] for one in (plain, f)), tolerance=1e-9)


@torch.no_grad()
def test_what_the_thread_raises_is_raised_by_the_next_call(tracks, monkeypatch):
    def refuse(source):
        raise CompileError("compile: not today")

    monkeypatch.setattr(jit, "load", refuse)
    _, f = filters()
    assert f(tracks.z, tracks.prior, u=tracks.u).mean.isfinite().all()
    finished(f)
    with pytest.raises(CompileError, match="not today"):
        f(tracks.z, tracks.prior, u=tracks.u)


def test_copies_have_no_kernels_yet(tracks):
    _, f = filters()
    with torch.no_grad():
        f(tracks.z, tracks.prior, u=tracks.u)
    again = copy.deepcopy(f)
    assert type(again.engine) is type(f.engine)
    assert not again.engine._made
    finished(f)


@pytest.mark.parametrize("collects", [True, False])
def test_the_search_for_unreachable_cycles_rests_while_a_step_is_traced_and_is_then_as_it_was(
    collects, tracks, monkeypatch
):
    seen, trace = [], Step._trace
    monkeypatch.setattr(Step, "_trace", lambda *given, **more: seen.append(gc.isenabled()) or trace(*given, **more))
    before = gc.isenabled()
    (gc.enable if collects else gc.disable)()
    try:
        f = filters()[0].compile()
        with pytest.raises(NotImplementedError), building():
            raise NotImplementedError
        f.step(f.init(tracks.prior), tracks.z[:, 0], u=tracks.u[0])
        after = gc.isenabled()
    finally:
        (gc.enable if before else gc.disable)()
    assert seen
    assert not any(seen)
    assert after == collects


@pytest.mark.skipif(not hasattr(os, "fork"), reason="Windows starts processes anew")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@torch.no_grad()
def test_a_child_of_a_process_that_compiles_has_the_kernels(tracks, gate):
    """It would wait for ever for the locks of a thread that it does not have."""
    _, f = filters()
    f(tracks.z, tracks.prior, u=tracks.u)
    threading.Timer(0.2, gate.set).start()
    child = os.fork()
    if child == 0:
        os._exit(0 if all(made.done() for made in f.engine._made.values()) else 1)
    assert os.waitpid(child, 0)[1] == 0


def test_a_fork_waits_for_a_thread_that_another_has_started_since():
    """As the thread that compiles a filter starts one that traces its backward pass."""
    looked, done = threading.Event(), []

    class Started(Making):
        def join(self, timeout=None):
            looked.set()
            super().join(timeout)

    second = Making(target=lambda: [time.sleep(0.2), done.append("second")])
    Started(target=lambda: [looked.wait(60), second.start(), done.append("first")]).start()
    program._wait()
    assert {*done} == {"first", "second"}


@pytest.mark.slow
def test_a_process_that_ends_while_it_compiles_ends_well():
    """Torch aborts one whose threads are stopped in the midst of it."""
    code = """
import time
import torch
from torchfra import presets, scenarios
from torchfra.compiler import jit
load = jit.load
jit.load = lambda source: (time.sleep(0.3), load(source), print("made"))[1]
scenario = scenarios.bearings_outliers()
tracks = scenario.simulate(runs=1, seed=0)
with torch.no_grad():
    presets.srckf(scenario.motion, scenario.sensor).compile(wait=False)(tracks.z[:, :2], tracks.prior, u=tracks.u[:2])
print("ends")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout.split()) == (0, ["ends", "made"]), done.stderr
