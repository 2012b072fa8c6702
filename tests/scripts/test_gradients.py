"""Gradients through many steps: what the script measures of them, and its command."""

import json

import gradients
import pytest
import torch

SMALL = ["--runs", "2", "--steps", "1,4", "--filters", "srckf"]


@pytest.fixture(autouse=True)
def few(monkeypatch):
    """Systems that have hardly run before the first step, and few tracks for the gate."""
    monkeypatch.setattr(gradients, "BEFORE", 20)
    monkeypatch.setattr(gradients, "GATE_TRACKS", 1)
    monkeypatch.setattr(gradients, "CUTS", (1, 2))


@pytest.fixture
def tracks():
    return gradients.started(28.0, 4, 6, 0)


def test_a_large_rho_parts_neighbours_that_a_small_one_brings_together():
    gaps = {}
    for system, rho in gradients.SYSTEMS.items():
        path = gradients.started(rho, 1, 1, 0).truth[:, 0]
        motion, _ = gradients.models(gradients.Setting(rho=rho), 1.0)
        states, dt = torch.cat([path, path + 1e-4]), torch.full((2,), gradients.DT).double()
        for _ in range(600):
            states = motion(states, dt)
        gaps[system] = float((states[0] - states[1]).norm())
    assert gaps["stable"] < 1e-5
    assert gaps["chaotic"] > 1e-2


def test_how_far_back_an_estimate_looks_is_how_much_a_change_of_the_start_changes_it(tracks):
    f, h = gradients.made("srckf", 28.0, gradients.VALUES), 1e-5
    found = gradients.reach_of(f, tracks, 6, 3)
    slopes = []
    for i in range(3):
        ends = []
        for sign in (-h, h):
            mean = tracks.prior.mean.clone()
            mean[:, i] += sign
            moved = tracks._replace(prior=tracks.prior._replace(mean=mean))
            ends.append(gradients.estimated(f, moved, 6, 3)[0].mean[:, -1].sum(-1).detach())
        slopes.append((ends[1] - ends[0]) / (2 * h))
    norm = torch.stack(slopes).norm(dim=0)
    assert found["median"] == pytest.approx(float(norm.median()), rel=1e-6)
    assert found["largest"] == pytest.approx(float(norm.max()), rel=1e-6)


def test_each_track_has_the_gradient_that_differences_of_its_loss_have(tracks, monkeypatch):
    monkeypatch.setattr(gradients, "STEP", 1e-5)
    f = gradients.made("rsrckf", 28.0, gradients.VALUES)
    _, found = gradients.of_tracks(f, tracks, 6, 2)
    torch.testing.assert_close(found, gradients.differences(f, tracks, 6, 2), rtol=1e-5, atol=1e-8)


def test_a_cut_after_the_last_step_changes_nothing_and_one_within_takes_something_away(tracks):
    f = gradients.made("srckf", 28.0, gradients.VALUES)
    whole, long, short = (gradients.of_tracks(f, tracks, 6, truncate=k)[1] for k in (None, 6, 2))
    assert long.equal(whole)
    assert not torch.allclose(short, whole)


def test_spread_and_halves_are_what_they_say():
    gradient = torch.tensor([[1.0, 0.0], [1.0, 0.0], [0.0, 3.0], [0.0, 3.0]]).double()
    found = gradients.spread(gradient)
    assert found["mean"] == pytest.approx((0.5**2 + 1.5**2) ** 0.5)
    assert found["std"] == pytest.approx((1 / 3 + 3.0) ** 0.5)
    assert found["largest"] == 3.0
    assert gradients.halves(gradient) == 0.0
    assert gradients.halves(gradient[:2]) == pytest.approx(1.0)


def test_checkpoints_keep_less_and_leave_the_gradient(tracks):
    found = gradients.kept(gradients.made("srckf", 28.0, gradients.VALUES), tracks, 6)
    assert found["checkpoint=2"]["difference"] < 1e-12
    assert found["checkpoint=2"]["between"] + found["checkpoint=2"]["at once"] < found["none"]["between"]


@pytest.mark.slow
@pytest.mark.usefixtures("rough_figures")
def test_tables_json_and_figure_have_both_systems(tmp_path, capsys):
    out, drawn = tmp_path / "g.json", tmp_path / "g.png"
    assert gradients.main([*SMALL, "--json", str(out), "--figure", str(drawn)]) == 0
    found = json.loads(out.read_text())["found"]
    for system in gradients.SYSTEMS:
        assert found[system]["reach"].keys() == gradients.EVERY.keys()
        assert {"hard, by differences", "temperature 1"} <= found[system]["gate"].keys()
        assert found[system]["cures"]["at every step"]["differences"]["right"] == pytest.approx(1.0)
    printed = capsys.readouterr().out
    assert "chaotic: how far back, median / largest" in printed
    assert "MB kept" in printed
    assert drawn.read_bytes().startswith(b"\x89PNG")
