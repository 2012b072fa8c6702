"""The script to copy learns, and survives an interruption and a bad batch."""

import re

import pytest
import torch
from short_tracks import short

from torchfra import scenarios
from train import simple


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Few short tracks, of which an iteration takes a moment."""
    with short():
        monkeypatch.setattr(simple, "SCENARIO", scenarios.bearings_outliers("std"))
    for name, value in {"BATCH": 4, "VALIDATE_EVERY": 2, "VALIDATION_RUNS": 8, "TEST_RUNS": 8}.items():
        monkeypatch.setattr(simple, name, value)


def learn(out, *arguments):
    """What is in the checkpoint after a run."""
    simple.main(["--out", str(out), "--no-compile", "--iterations", "6", *arguments])
    return torch.load(out, weights_only=True)


def test_it_learns_the_named_values_and_says_the_error_before_and_after(tmp_path, capsys):
    kept = learn(tmp_path / "a.pt")
    assert kept["run"]["iteration"] == 6
    raw = [kept["values"][f"{path}.raw"] for path in ("robust.threshold", "fading.weakening")]
    said = capsys.readouterr().out
    assert re.search(r"threshold\): Hyper\(1\.345, a value above 0, learnable\)", said)  # before
    assert re.findall(r"iteration (\d)", said) == ["2", "4", "6"]
    assert re.search(r"8 unseen tracks: [\d.]+ m before, [\d.]+ m after", said)
    fixed = simple.presets.fra(simple.SCENARIO.motion, simple.SCENARIO.sensor, learn=simple.LEARN)
    assert all(a != b for a, b in zip(raw, fixed.parameters(), strict=True))


@pytest.mark.slow
def test_an_interrupted_run_goes_on_to_the_same_values(tmp_path, monkeypatch):
    whole, fresh = learn(tmp_path / "whole.pt"), simple.fresh

    def cut(runs, seed, first=0):
        if first == 5 * simple.BATCH:
            raise KeyboardInterrupt
        return fresh(runs, seed, first)

    with monkeypatch.context() as patched:
        patched.setattr(simple, "fresh", cut)
        with pytest.raises(KeyboardInterrupt):
            learn(tmp_path / "cut.pt")
    assert torch.load(tmp_path / "cut.pt", weights_only=True)["run"]["iteration"] == 4
    resumed = learn(tmp_path / "cut.pt", "--resume")
    assert resumed["run"] == whole["run"]
    for part in ("values", "best"):
        torch.testing.assert_close(resumed[part], whole[part], rtol=0, atol=0)


def test_a_batch_whose_gradient_is_not_finite_changes_nothing(tmp_path, monkeypatch):
    loss_of = simple.loss_of
    monkeypatch.setattr(simple, "loss_of", lambda f, tracks: loss_of(f, tracks) * torch.nan)
    kept = learn(tmp_path / "a.pt")
    fixed = simple.presets.fra(simple.SCENARIO.motion, simple.SCENARIO.sensor, learn=simple.LEARN)
    torch.testing.assert_close(kept["values"], dict(fixed.state_dict()), rtol=0, atol=0)
