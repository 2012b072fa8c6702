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


def whole(f, z, prior, u):
    return f(z, prior, u=u)[:4], f.smooth(z, prior, u=u)[:4]


def step_by_step(f, z, prior, u):
    return f.step(f.init(prior), z[:, 0], u=u[0])[0].belief


def fixed_lag(f, z, prior, u):
    stream = FixedLag(f, lag=2)
    state = stream.init(prior)
    for k in range(4):
        state, _ = stream.step(state, z[:, k], u=u[k])
    return state.lagged


def tracker(f, z, prior, u):
    stream = Tracker(f, prior, lag=10.0)
    for k in range(4):
        stream.update(k + 1.0, z[:, k], u=u[k])
    return [stream.belief, *(at.belief for at in stream.smoothed())]


@pytest.mark.parametrize(("name", "way"), [
    ("srckf", whole), ("fra", whole), ("gpb", whole), ("rsrckf", step_by_step), ("srckf", fixed_lag), ("srckf", tracker)
])  # fmt: skip
def test_estimates_are_the_same_to_the_bit(name, way, scenario, data):
    f = getattr(presets, name)(scenario.motion, scenario.sensor, **(SMALL_GPB if name == "gpb" else {}))
    without = way(f, *data)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        torch.testing.assert_close(way(f, *data), without, rtol=0, atol=0, equal_nan=True)


def test_gradients_reach_a_network_in_front_that_runs_in_half_precision(scenario, data):
    z, prior, u = data
    f, network = presets.srckf(scenario.motion, scenario.sensor), torch.nn.Linear(2, 2).to(z.dtype)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        std = 0.01 + network(z.nan_to_num()).to(z.dtype).square()
        f(z, prior, u=u, std=std).mean[..., :2].square().mean().backward()
    assert network.weight.grad.isfinite().all()
    assert network.weight.grad.abs().sum() > 0
