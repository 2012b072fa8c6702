"""Trackers of targets that come and go are compared on the same scans, those of others in processes of their own."""

import importlib.util
import json

import peers_targets
import pytest
import torch
from recorded_bench import autoferry
from test_recordings_script import harbour

SMALL = ["--targets", "3", "--clutter", "3", "--scans", "20", "--runs", "1"]


def compared(tmp_path, *arguments):
    path = tmp_path / "targets.json"
    assert peers_targets.main([*SMALL, *arguments, "--json", str(path)]) == 0
    return {row["tracker"]: row for row in json.loads(path.read_text())["rows"]}


@pytest.mark.slow
def test_filters_of_torchfra_follow_the_targets_and_the_table_says_how_well(tmp_path, capsys):
    rows = compared(tmp_path, "--trackers", "srckf,imm,gpb")
    assert list(rows) == ["srckf", "imm", "gpb"]
    for row in rows.values():
        assert row["gospa_m"] < 100  # three targets that nobody follows are 122 m
        assert row["ms_per_scan"] > 0
        assert row["gospa_m"] ** 2 <= 1.001 * sum(row[f"{part}_m2"] for part in ("localisation", "missed", "false"))
    assert "gospa m" in capsys.readouterr().out


def test_scans_hold_the_targets_and_as_many_false_measurements_as_are_asked_for(monkeypatch):
    options = peers_targets.parser().parse_args(["--runs", "20", "--clutter", "30", "--targets", "10"])
    truth, z = peers_targets.simulated(options)
    there = ~truth.isnan().any(-1)
    false = (~z.isnan().any(-1)).sum((1, 2)) - peers_targets.DETECTION * there.sum((1, 2))
    assert (false.double() / 60).mean().item() == pytest.approx(30, rel=0.03)
    gap = z[:, :, :10].transpose(1, 2) - truth[..., :2]
    assert gap[~gap.isnan()].std().item() == pytest.approx(peers_targets.STD, rel=0.03)
    assert there.any(-1).all()
    assert torch.equal(peers_targets.simulated(options)[1].nan_to_num(), z.nan_to_num())


def test_targets_are_hidden_for_as_long_and_have_hulls_as_wide_as_is_asked_for():
    options = peers_targets.parser().parse_args(["--runs", "10", "--hidden", "12", "--hull", "60"])
    truth, z = peers_targets.simulated(options)
    own = z[:, :, :40].transpose(1, 2)  # four of each of ten targets
    nobody = own.isnan().any(-1).reshape(10, 4, 10, 60).all(1)
    there = ~truth.isnan().any(-1)
    assert ((nobody & there).sum(-1) >= 12).all()
    gap = own - truth[..., :2].repeat(1, 4, 1, 1)
    along, across = (gap[..., i][~gap[..., i].isnan()].std().item() for i in (0, 1))
    assert across == pytest.approx(peers_targets.STD, rel=0.03)
    assert along**2 == pytest.approx(peers_targets.STD**2 + 60**2 / 12, rel=0.05)


def test_hidden_targets_are_kept_where_they_may_be_hidden(tmp_path):
    options = "--trackers", "srckf", "--hidden", "8", "--confirmation", "existence", "--misses", "0"
    without, hidden = (compared(tmp_path, *options, *more)["srckf"] for more in ((), ("--visible", "60", "10")))
    assert hidden["missed_m2"] < 0.8 * without["missed_m2"]


def test_a_peer_that_is_not_installed_is_named_and_runs_without_torch(tmp_path, monkeypatch, capsys):
    fake = "import sys\nassert 'torch' not in sys.modules\nraise ImportError('no stonesoup here')"
    (tmp_path / "stonesoup.py").write_text(fake)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert not compared(tmp_path, "--trackers", "stonesoup-jpda,stonesoup-mfa")
    out = capsys.readouterr().out
    assert "stonesoup-jpda: not installed (no stonesoup here)" in out
    assert "stonesoup-mfa: not installed" in out


def test_a_harbour_is_handed_over_scan_by_scan_and_tracks_are_compared_at_the_radars(tmp_path, monkeypatch):
    recording = harbour(tmp_path / "in", steps=12)
    scene, jobs = autoferry.read(recording), []

    def perfect(name, kind, job):
        jobs.append(job)
        scans = [scan for scan in scene.z if scan.time - scene.z[0].time in job["time"]]
        return [torch.stack([scan.truth for scan in scans], 1)], [0.0]

    monkeypatch.setattr(peers_targets, "elsewhere", perfect)
    rows = peers_targets.harbour(peers_targets.parser().parse_args(["--harbour", str(recording)]))
    assert [row["sensors"] for row in rows] == ["radar", "radar_lidar"]
    assert all(row["gospa"] == 0 and row["followed"] == 1 for row in rows)
    assert jobs[0]["z"].shape == (1, 12, 2, 2)
    assert jobs[1]["z"].shape == (1, 24, 2, 2)
    assert jobs[1]["sensor"] == [0, 1] * 12


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("stonesoup") is None, reason="needs stonesoup")
def test_stone_soup_follows_the_same_targets(tmp_path):
    rows = compared(tmp_path, "--trackers", "srckf,stonesoup-jpda")
    assert rows["stonesoup-jpda"]["gospa_m"] == pytest.approx(rows["srckf"]["gospa_m"], rel=0.5)
