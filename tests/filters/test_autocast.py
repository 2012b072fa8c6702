"""Under ``torch.autocast`` a filter computes what it computes without: mixed precision ends at its door."""

import pytest
import torch
from short_tracks import SMALL_GPB

from torchfra import presets
from torchfra.filters import FixedLag
from torchfra.stream import Tracker

TYPES = [torch.float32, torch.float64]


@pytest.fixture(params=TYPES, ids=str)
def data(request, scenario, tracks):
    dtype = request.param
    prior = type(tracks.prior)(*(part.to(dtype) for part in tracks.prior))
    return tracks.z.to(dtype), prior, tracks.u.to(dtype)


def both(call):
    """What a call gives without and under autocast."""
    without = call()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        return without, call()


@pytest.mark.parametrize("name", ["srckf", "fra", "gpb"])
def test_estimates_are_the_same_to_the_bit(name, scenario, data):
    z, prior, u = data
    f = getattr(presets, name)(scenario.motion, scenario.sensor, **(SMALL_GPB if name == "gpb" else {}))
    for without, under in (both(lambda: f(z, prior, u=u)), both(lambda: f.smooth(z, prior, u=u))):
        for one, other in zip(without[:4], under[:4], strict=True):
            assert other.dtype == z.dtype
            torch.testing.assert_close(other, one, rtol=0, atol=0, equal_nan=True)


def test_so_are_single_steps(scenario, data):
    z, prior, u = data
    f = presets.rsrckf(scenario.motion, scenario.sensor)

    def step():
        return f.step(f.init(prior), z[:, 0], u=u[0])[0].belief

    without, under = both(step)
    torch.testing.assert_close(under, without, rtol=0, atol=0, equal_nan=True)


def test_so_is_a_fixed_lag(scenario, data):
    z, prior, u = data
    stream = FixedLag(presets.srckf(scenario.motion, scenario.sensor), lag=2)

    def lagged():
        state = stream.init(prior)
        for k in range(4):
            state, _ = stream.step(state, z[:, k], u=u[k])
        return state.lagged

    without, under = both(lagged)
    torch.testing.assert_close(under, without, rtol=0, atol=0, equal_nan=True)


def test_so_are_estimates_of_a_tracker_and_what_it_smooths(scenario, data):
    z, prior, u = data
    f = presets.srckf(scenario.motion, scenario.sensor)

    def beliefs():
        tracker = Tracker(f, prior, lag=10.0)
        for k in range(4):
            tracker.update(k + 1.0, z[:, k], u=u[k])
        return [tracker.belief, *(at.belief for at in tracker.smoothed())]

    without, under = both(beliefs)
    torch.testing.assert_close(under, without, rtol=0, atol=0, equal_nan=True)


def test_gradients_reach_a_network_in_front_that_runs_in_half_precision(scenario, data):
    z, prior, u = data
    f, network = presets.srckf(scenario.motion, scenario.sensor), torch.nn.Linear(2, 2).to(z.dtype)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        std = 0.01 + network(z.nan_to_num()).to(z.dtype).square()
        f(z, prior, u=u, std=std).mean[..., :2].square().mean().backward()
    assert network.weight.grad.isfinite().all()
    assert network.weight.grad.abs().sum() > 0
