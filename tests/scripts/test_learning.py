"""The study of learned thresholds and weakenings compares ways on the same tracks and says how sure it is."""

import functools
import json

import learning
import pytest
from short_tracks import short

SMALL = ["--cells", "2-std", "--trainings", "2", "--iterations", "2", "--runs", "4", "--no-compile"]


def run(out, *arguments):
    with short():
        assert learning.main([*SMALL, *arguments, "--json", str(out)]) == 0
    return json.loads(out.read_text())["cells"]["2-std"]


@pytest.mark.slow
def test_each_way_learns_from_each_start_and_decides_hard_when_it_is_judged(tmp_path, capsys, monkeypatch):
    judged = []
    error = learning.error
    monkeypatch.setattr(learning, "error", lambda f, *given: judged.append(f.temperature) or error(f, *given))
    found = run(tmp_path / "l.json", "--ways", "hard,1-0.1", "--starts", "1.345:2,0.3:30", "--no-grid")
    assert set(judged) == {0.0}
    assert len(found["before"]) == 2
    assert list(found["trainings"]) == [
        f"{way}, from {start}" for start in ("1.345:2", "0.3:30") for way in ("hard", "1-0.1")
    ]
    for of in found["trainings"].values():
        assert len(of["after"]) == len(of["values"]) == 2
    (hard, _), (soft, _) = (found["trainings"][f"{way}, from 1.345:2"]["values"] for way in ("hard", "1-0.1"))
    assert hard != soft
    assert hard != [1.345, 2.0]
    assert "gain %" in capsys.readouterr().out


@pytest.mark.slow
def test_the_grid_and_fit_are_judged_on_the_tracks_of_the_trainings(tmp_path, monkeypatch):
    monkeypatch.setattr(learning, "THRESHOLDS", (1.0, 5.0))
    monkeypatch.setattr(learning, "WEAKENINGS", (2.0, 20.0))
    monkeypatch.setattr(learning, "sweep", functools.partial(learning.sweep, runs=6))
    monkeypatch.setattr(learning, "fit", functools.partial(learning.fit, runs=20, iterations=2, polish=False))
    found = run(tmp_path / "l.json", "--ways", "hard", "--starts", "0.3:30", "--restarts", "2")
    assert len(found["grid"]["points"]) == len(found["grid"]["losses"]) == 4
    assert found["grid"]["values"][0] in found["grid"]["near"]
    assert list(found["fits"]) == ["fit, from 0.3:30", "fit, from 2 around 0.3:30"]
    for of in found["fits"].values():
        assert len(found["grid"]["after"]) == len(of["after"]) == 2
        assert "threshold" in of["text"]


def test_a_temperature_falls_between_two_or_stays():
    assert learning.temperatures("hard") == (0.0, 0.0)
    assert learning.temperatures("1") == (1.0, 1.0)
    assert learning.temperatures("10-0.1") == (10.0, 0.1)


def test_an_interval_is_that_of_students_t():
    mean, half = learning.interval([1.0, 2.0, 3.0])
    assert mean == 2.0
    assert half == pytest.approx(4.303 / 3**0.5, rel=1e-3)
