"""The script of many targets runs, and its worlds are what they say."""

import json

import numpy as np
import pytest
import targets as script
import torch

from torchfra.readers import Recording


def flight(name, start, seconds, north):
    """A straight flight eastwards, a fix every ten seconds."""
    time = start + np.arange(0.0, seconds + 1, 10)
    return Recording(name, time, np.stack([200 * (time - start), north + 20 * (time - start), 0 * time], -1), None, {})


FLIGHTS = [
    flight("a", 0, 1000, 0),
    flight("b", 300, 400, 2e5),
    flight("c", 900, 1000, -2e5),
    flight("d", 2000, 500, 1e5),
]


def test_recorded_flights_are_there_when_they_were():
    world = script.recorded(FLIGHTS, 0, 5.0, 100, folded=False)  # from 1000 s to 1500 s
    assert world.truth.shape == (1, 100, 2)  # the first one ends just then
    assert world.truth[0, 10, 0].item() == pytest.approx(200 * 150.0, abs=1.0)
    folded = script.recorded(FLIGHTS, 0, 5.0, 100, folded=True)
    assert len(folded.truth) == 4
    assert all(len(scan) > 200 for scan in folded.scans)


def test_a_crowd_is_followed_and_timed():
    found, mean = script.streamed(script.crowd(0, 12, count=6, width=1e5))
    assert found["targets"] == found["targets at once"] == 6
    assert found["missed targets"] == found["switches"] == 0
    assert mean.shape[1:] == (12, 4)
    assert 0 < found["ms per scan, median"] <= found["ms per scan, largest"]


def test_too_few_scans_for_any_flight_are_refused_before_anything_runs(monkeypatch, capsys):
    monkeypatch.setattr(script, "swiss_traffic", lambda: [FLIGHTS[0], FLIGHTS[3]])  # none in the middle
    monkeypatch.setattr(script, "many", lambda *_: pytest.fail("many ran"))
    assert script.main(["--scans", "2", "--what", "many,recorded"]) == 2
    assert "scans: expected so many, 5 s apart, that a flight is there in two of them, " in capsys.readouterr().err


@pytest.mark.usefixtures("rough_figures")
def test_the_script_prints_and_writes(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(script, "swiss_traffic", lambda: FLIGHTS)
    out = ["--json", str(tmp_path / "r.json"), "--picture", str(tmp_path / "r.png")]
    assert script.main(["--runs", "1", "--scans", "20", "--what", "folded", *out]) == 0
    result = json.loads((tmp_path / "r.json").read_text())
    assert result["folded"]["targets"] >= 2
    assert (tmp_path / "r.png").stat().st_size > 10_000
    assert "runs without a switch" in capsys.readouterr().out


def test_the_picture_takes_any_number_of_targets():
    world = script.crowd(0, 3, count=2, width=1e4)
    assert script.picture(world, torch.zeros(0, 3, 4)).axes[1].get_title().startswith("0 targets found")
