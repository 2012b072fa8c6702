"""Scripts do what they do by default, with all their filters, cells, ways and kinds, at the smallest sizes."""

import json

import bearings
import gradients
import layer
import learning
import pytest
import reproduce
import short_tracks

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("rough_figures", "short_tracks")]


@pytest.fixture(autouse=True)
def two_steps(monkeypatch):
    """Simulated tracks are shorter still."""
    monkeypatch.setattr(short_tracks, "STEPS", 2)


@pytest.fixture
def run(tmp_path):
    """What a script writes."""

    def run(script, *options):
        out = tmp_path / "r.json"
        assert script.main([*options, "--quiet", "--json", str(out)]) == 0
        return json.loads(out.read_text())

    return run


def test_bearings_has_every_filter_in_every_column(run):
    columns = run(bearings, "--runs", "1")["columns"]
    assert list(columns) == list(bearings.COLUMNS)
    assert all(list(of) == list(bearings.FILTERS) for of in columns.values())


def test_gradients_has_every_filter_of_both_systems(run, monkeypatch):
    monkeypatch.setattr(gradients, "BEFORE", 1)
    monkeypatch.setattr(gradients, "GATE_TRACKS", 1)
    found = run(gradients, "--runs", "2", "--steps", "1,2", "--no-compile")["found"]
    assert found.keys() == {*gradients.SYSTEMS, "kept"}


def test_layer_has_every_teacher_of_both_networks(run):
    errors = run(layer, "--steps", "1", "--tracks", "2")["errors"]
    assert len(errors) == 2 + 2 * len(layer.TEACHERS)


def test_learning_has_every_way_in_every_cell(run, monkeypatch):
    monkeypatch.setattr(learning, "BATCH", 2)
    monkeypatch.setattr(learning, "of_grid", lambda *arguments: {"grid": {}})
    monkeypatch.setattr(learning, "table", None)
    cells = run(learning, "--trainings", "2", "--iterations", "1", "--runs", "2", "--no-compile")["cells"]
    assert list(cells) == list(learning.CELLS)
    assert all(len(of["trainings"]) == len(learning.WAYS.split(",")) for of in cells.values())


def test_reproduce_has_every_filter_of_scenario_2(run):
    found = run(reproduce, "bearings-manoeuvre", "--runs", "2")
    assert list(found["filters"]) == list(reproduce.EXPERIMENTS["bearings-manoeuvre"].defaults)
