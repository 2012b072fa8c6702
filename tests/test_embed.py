"""A filter is a layer: a network in front of it learns through it."""

import embed
import pytest
import torch

from torchfra import presets


def test_gradients_reach_the_first_layer_of_the_network():
    torch.manual_seed(0)
    model, data = embed.Trusting(4), embed.simulate(4, 10, 0)
    model(data.z, data.prior, data.features).square().mean().backward()
    assert (model.network[0].weight.grad != 0).all()
    assert model.network[0].weight.grad.isfinite().all()


@pytest.mark.slow
def test_the_network_learns_what_a_glint_is_and_beats_the_fixed_filter():
    model = embed.learn(iterations=60, tracks=16, steps=25, seed=0)
    data = embed.simulate(100, 25, 999)
    with torch.no_grad():
        factor = model.std(data.features) / embed.STD
        fixed = presets.srckf(embed.MOTION, embed.SENSOR)(data.z, data.prior).mean
        ours = model(data.z, data.prior, data.features)
    assert factor[data.glint].median() > 4
    assert factor[~data.glint].median() < 2
    error, error_fixed = ((x - data.truth)[..., :2].square().sum(-1).mean().sqrt() for x in (ours, fixed))
    assert error < 0.6 * error_fixed


def test_the_example_runs(capsys):
    assert embed.main(["--iterations", "2", "--tracks", "4", "--steps", "10"]) == 0
    assert "std by network" in capsys.readouterr().out
