"""The frontier of gpb's values: each search allows another regret where the stated model holds."""

import json

import pytest
from test_train_gpb import SMALL

from train import frontier

pytestmark = pytest.mark.usefixtures("rough_figures", "short_tracks")

TASKS = [
    {"scenario": "as-stated", "options": {"index": 0.1, "outliers": "none"}},
    {"scenario": "as-stated", "options": {"index": 0.1, "outliers": "none", "q": 10.0}},
    {"scenario": "bearings-outliers", "options": {"outliers": "std"}, "models": "motion"},
    {"scenario": "bearings-outliers", "options": {"outliers": "none"}, "models": "motion", "weight": 0},
]


def result(regrets):
    """What a search found, of the tasks above."""
    tasks = [
        {"scenario": task["scenario"], **task["options"], "weight": task.get("weight", 1), "models": "any",
         "after": {"filtered": {"regret": regret}}}
        for task, regret in zip(TASKS, regrets, strict=True)
    ]  # fmt: skip
    return {"tasks": tasks}


def test_worst_regrets_are_of_tracks_as_stated_and_of_scenarios_that_count():
    found = frontier.worst(result([0.01, 0.5, 0.04, 0.9]))
    assert {kind: of["regret"] for kind, of in found.items()} == {"holds": 0.01, "scenarios": 0.04}
    assert frontier.worst(result([0.01, 0.5, float("nan"), 0.9]))["scenarios"]["regret"] != 0.04


@pytest.mark.slow
def test_searches_are_made_once_and_drawn(tmp_path, capsys):
    out = ["--out", str(tmp_path), "--json", str(tmp_path / "f.json"), "--figure", str(tmp_path / "f.png")]
    arguments = ["--holds", "0.01,0.1", *SMALL, f"tasks={json.dumps(TASKS)}", *out]
    assert frontier.main(arguments) == 0
    points = json.loads((tmp_path / "f.json").read_text())["points"]
    assert [point["allowed"] for point in points] == [0.01, 0.1]
    assert (tmp_path / "f.png").stat().st_size > 0
    before = (tmp_path / "0.1" / "results.json").stat().st_mtime_ns
    assert frontier.main(arguments) == 0
    assert (tmp_path / "0.1" / "results.json").stat().st_mtime_ns == before
    assert "worst where the model holds" in capsys.readouterr().out


@pytest.mark.parametrize("holds", ["", "a", "-0.1", "inf"])
def test_regrets_that_make_no_sense_are_refused(holds, capsys):
    assert frontier.main([f"--holds={holds}"]) == 2
    assert "holds: expected numbers of 0 or more" in capsys.readouterr().err
