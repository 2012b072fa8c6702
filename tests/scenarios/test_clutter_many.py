"""Aircraft that come and go: who is there, what is measured of it, and the false measurements around it."""

import pytest
import torch

from torchfra import metrics, presets, scenarios
from torchfra.association import ChiSquare
from torchfra.targets import SPRT, Deletion, Merging, Targets, TwoPoint


def test_aircraft_come_once_and_go_once():
    tracks = scenarios.clutter_many(count=7).simulate(20, 1)
    there = ~tracks.truth.isnan().any(-1)
    assert tracks.truth.shape == (20, 7, 100, 6)
    changes = (there[..., 1:] != there[..., :-1]).sum(-1)
    assert (changes <= 2).all()
    assert (changes == 2).float().mean() > 0.5
    assert there[..., 30:70].all()
    assert 0.5 < there.float().mean() < 0.95


def test_scans_hold_the_measurements_of_those_that_are_there():
    scenario = scenarios.clutter_many(count=3, clutter=6, detection=0.9)
    tracks = scenario.simulate(20, 2)
    assert tracks.z.shape == (20, 100, 9, 3)
    there = (~tracks.truth.isnan().any(-1)).sum(1)
    measured = (~tracks.z.isnan().any(-1)).sum(-1)
    assert (measured <= there + 6).all()
    assert (measured - 6).sum() / there.sum() == pytest.approx(0.9, abs=0.01)


@pytest.mark.slow
def test_a_manager_of_targets_follows_them_all_without_a_switch():
    scenario = scenarios.clutter_many(count=4, clutter=12)
    tracks = scenario.simulate(2, 5)
    f = presets.jpda(scenario.motion, scenario.sensor, clutter=scenario.clutter, detection=scenario.detection,
                     gate=ChiSquare(0.99999))  # fmt: skip
    targets = Targets(f, birth=TwoPoint(80.0), confirmation=SPRT(), deletion=Deletion(4), merging=Merging())
    with torch.no_grad():
        estimate = scenario.cartesian(targets(tracks.z[:, :60]))
    lives = metrics.lives(estimate.mean, tracks.truth[..., :60, :], scenario.truth_position)
    assert lives.switches.sum() == lives.missed_targets.sum() == 0
    assert (lives.followed / lives.length).min() > 0.8


@pytest.mark.parametrize(("options", "name"), [
    ({"count": 0}, "count"), ({"count": 2.5}, "count"), ({"clutter": 0}, "clutter"), ({"detection": 1.5}, "detection"),
])  # fmt: skip
def test_arguments_out_of_range_are_named(options, name):
    with pytest.raises(ValueError, match=f"{name}: expected"):
        scenarios.clutter_many(**options)
