"""Simulated harbours: how boats move, what each sensor has of them, and that a seed says it all."""

import json

import harbours
import pytest
import torch

from torchfra import scenarios
from torchfra.scenarios.harbour import KINDS, REACH


def gap(recording):
    """Distance of the two boats in each scan."""
    one, other = recording.truth[..., :2]
    return (one - other).norm(dim=-1)


def nearest(recording, scans):
    """Distances ``(B, S)`` from each boat to the nearest measurement of those scans."""
    off = recording.truth[:, scans, None, :2] - recording.z[scans]
    return off.norm(dim=-1).nan_to_num(torch.inf).amin(-1)


@pytest.mark.parametrize("apart", [5.0, 40.0])
def test_boats_are_as_far_apart_as_asked(apart):
    late = slice(-40, None)
    for kind in ("beside", "turning", "crossing", "overtaking"):
        distance = gap(scenarios.harbour(kind, seed=1, apart=apart))
        assert distance.min() == pytest.approx(apart, abs=2.0)
        assert (distance[late] > distance.min() + 5.0).all() == (kind != "turning")
    together = gap(scenarios.harbour("beside", seed=1, apart=apart))[:150]
    assert together.max() == pytest.approx(apart, abs=2.0)


def test_a_ship_is_one_and_turns():
    recording = scenarios.harbour("ship", seed=3)
    assert recording.truth.shape[0] == 1
    assert 20.0 <= recording.length.item() <= 40.0
    first, *_, last = recording.truth[0, :, 2:]
    assert torch.dot(first, last) / first.norm() / last.norm() < 0.7


def test_a_boat_is_measured_as_often_as_asked_and_the_lidar_sees_as_far_as_it_does():
    recordings = [scenarios.harbour("beside", seed=seed, apart=40.0, detection=0.7) for seed in range(12)]
    seen, beyond = [], []
    for r in recordings:
        seen.append((nearest(r, ~r.lidar) < r.length[:, None] / 2 + 3.0).double())
        far = (r.truth[..., :2] - r.ferry).norm(dim=-1) > REACH + 25.0
        beyond.append((nearest(r, r.lidar) < 10.0)[far[:, r.lidar]].double())
    assert torch.cat(seen).mean() == pytest.approx(0.7, abs=0.04)
    assert torch.cat(beyond).mean() < 0.01


def test_the_lidar_has_several_detections_of_a_hull_and_the_radar_one():
    ship = scenarios.harbour("ship", seed=3)
    near = (ship.truth[0, :, None, :2] - ship.z).norm(dim=-1) < ship.length / 2
    most = near.sum(-1)
    assert most[ship.lidar].max() >= 3
    assert most[~ship.lidar].double().mean() < 1.1


def test_a_seed_says_it_all():
    one, same, other = (scenarios.harbour("crossing", seed=seed) for seed in (4, 4, 5))
    assert all(torch.equal(a.nan_to_num(-1.0), b.nan_to_num(-1.0)) for a, b in zip(one, same, strict=True))
    assert not torch.equal(one.truth, other.truth)
    assert all(scenarios.harbour(kind, seed=0).time.diff().min() >= 0 for kind in KINDS)


@pytest.mark.parametrize(("kind", "options", "name"), [
    ("ships", {}, "kind"), ("ship", {"seed": -1}, "seed"), ("ship", {"apart": 0.0}, "apart"),
    ("ship", {"detection": 1.0}, "detection"),
])  # fmt: skip
def test_arguments_out_of_range_are_named(kind, options, name):
    with pytest.raises(ValueError, match=f"{name}: expected"):
        scenarios.harbour(kind, **{"seed": 0} | options)


def test_the_script_follows_ships_and_counts_scans_with_two_tracks(tmp_path, capsys):
    out = tmp_path / "harbours.json"
    options = ["--kinds", "ship", "--runs", "1", "--detection", "0.95", "--sensors", "radar", "--json", str(out)]
    assert harbours.main(options) == 0
    (row,) = json.loads(out.read_text())["rows"]
    assert (row["kind"], row["twice"]) == ("ship", 0)
    assert 0.5 < row["followed"] <= 1.0
    assert "ship" in capsys.readouterr().out
    ship = scenarios.harbour("ship", seed=0)
    own = ship.truth[:, ~ship.lidar, :2]
    more = own.clone()
    more[0, 5:9] += 10.0
    more[0, 9:] += 50.0
    more[0, :2] = torch.nan
    assert harbours.twice(torch.cat([own, more]), ship) == 7
