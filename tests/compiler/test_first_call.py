"""What the first call of a compiled filter makes, in which order and by which thread."""

import threading

import pytest
import torch
from conftest import without_acceleration
from short_tracks import SMALL_GPB

from torchfra import presets, scenarios
from torchfra.compiler import run, step
from torchfra.compiler.engine import Compiled
from torchfra.compiler.source import Scan


@pytest.fixture
def scenario():
    return scenarios.bearings_outliers()


@pytest.fixture
def events(monkeypatch):
    """What happens in a call, by name and in order, with the thread that does it."""
    happened = []

    def before(name, function):
        return lambda *args, **kwargs: happened.append((name, threading.current_thread())) or function(*args, **kwargs)

    def after(name, function):
        def call(*args, **kwargs):
            result = function(*args, **kwargs)
            happened.append((name, threading.current_thread()))
            return result

        return call

    monkeypatch.setattr(Scan, "source", after("steps written", Scan.source))
    monkeypatch.setattr(Compiled, "_make_backward", before("backward pass begun", Compiled._make_backward))
    monkeypatch.setattr(run, "load", after("ends made", run.load))
    return happened


def test_the_backward_pass_is_traced_once_the_steps_are_written(scenario, events):
    scenario = without_acceleration(scenario)
    tracks = scenario.simulate(2, 0)
    with torch.no_grad():
        presets.imm_srckf(scenario.bank, scenario.sensor).compile().smooth(tracks.z, tracks.prior, u=tracks.u)
    order = [name for name, _ in events if name != "ends made"]  # by a third thread, at any time after the steps
    assert order[:2] == ["steps written", "backward pass begun"]


def test_another_thread_makes_what_is_around_the_steps_while_they_are_compiled_and_makes_it_once(scenario, events):
    tracks, f = scenario.simulate(2, 0), presets.srckf(scenario.motion, scenario.sensor).compile()
    for _ in range(2):
        with torch.no_grad():
            f(tracks.z, tracks.prior, u=tracks.u)
    assert [name for name, _ in events] == ["steps written", "ends made"]
    assert events[1][1] is not threading.main_thread()


@pytest.mark.parametrize("name", ["srckf", "fra", "gpb", "rmckf"])
def test_one_trace_is_enough(name, scenario, monkeypatch):
    scenario, traces, trace = without_acceleration(scenario), [], step.Step._trace
    monkeypatch.setattr(step.Step, "_trace", lambda *args, **more: traces.append(1) or trace(*args, **more))
    f = getattr(presets, name)(scenario.motion, scenario.sensor, **(SMALL_GPB if name == "gpb" else {})).compile()
    tracks = scenario.simulate(1, 0)
    f(tracks.z[:, :2], tracks.prior, u=tracks.u[:2])
    assert len(traces) == 1


def test_a_step_that_random_numbers_stop_is_traced_all_the_same(scenario, monkeypatch):
    def refused(*_):
        raise ArithmeticError

    scenario = without_acceleration(scenario)
    tracks, f = scenario.simulate(1, 0), presets.fra(scenario.motion, scenario.sensor)
    eager = f(tracks.z[:, :2], tracks.prior, u=tracks.u[:2])
    monkeypatch.setattr("torchfra.compiler.step.staying", refused)
    torch.testing.assert_close(f.compile()(tracks.z[:, :2], tracks.prior, u=tracks.u[:2]).mean, eager.mean)
