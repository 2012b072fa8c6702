"""A step is traced once, also where random numbers stop the search for zeros of a state that stay."""

import pytest
import torch
from short_tracks import SMALL_GPB

from torchfra import presets
from torchfra.compiler.step import Step


@pytest.mark.parametrize("name", ["srckf", "fra", "gpb", "rmckf"])
def test_one_trace_is_enough(name, scenario, monkeypatch):
    traces, trace = [], Step._trace
    monkeypatch.setattr(Step, "_trace", lambda *args, **more: traces.append(1) or trace(*args, **more))
    f = getattr(presets, name)(scenario.motion, scenario.sensor, **(SMALL_GPB if name == "gpb" else {})).compile()
    tracks = scenario.simulate(1, 0)
    f(tracks.z[:, :2], tracks.prior, u=tracks.u[:2])
    assert len(traces) == 1


def test_a_step_that_random_numbers_stop_is_traced_all_the_same(scenario, monkeypatch):
    def refused(*_):
        raise ArithmeticError

    tracks, f = scenario.simulate(1, 0), presets.fra(scenario.motion, scenario.sensor)
    eager = f(tracks.z[:, :2], tracks.prior, u=tracks.u[:2])
    monkeypatch.setattr("torchfra.compiler.step.staying", refused)
    torch.testing.assert_close(f.compile()(tracks.z[:, :2], tracks.prior, u=tracks.u[:2]).mean, eager.mean)
