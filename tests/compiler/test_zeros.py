"""Which zeros of a state stay is known before a step is traced."""

import pytest
import torch
from short_tracks import SMALL_GPB

from torchfra import presets
from torchfra.compiler.step import Step, staying

FLOAT64 = torch.float64


def found(step, *zero):
    """What stays of zeros of a state with one leaf."""
    return staying(lambda draw, leaves: [step(draw, *leaves)], [torch.tensor(zero)], FLOAT64)[0].tolist()


def test_a_zero_that_is_multiplied_stays():
    assert found(lambda draw, x: x * draw(x.shape), True, True) == [True, True]


def test_a_zero_to_which_something_comes_goes_and_so_does_what_it_reaches_later():
    assert found(lambda draw, x: torch.stack([x[0], x[0] + x[1], x[2] + x[1]]), False, True, True) == [False] * 3


def test_a_zero_stays_only_if_both_sides_of_a_choice_are_zero():
    for least in (-1.0, 2.0):
        assert found(lambda draw, x: torch.where(draw([2]) > least, x, x.flip(0)), True, True) == [True, True]  # noqa: B023
        assert found(lambda draw, x: x.where(draw([2]) > least, 1.0), True, True) == [False, False]  # noqa: B023


def test_where_a_step_of_numbers_is_not_finite_the_trace_has_the_word():
    assert found(lambda draw, x: x + torch.stack([draw([]), draw([]).neg().log()]), True, True) == [True, True]


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
