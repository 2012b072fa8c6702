"""Scripts do what they do by default, with all their filters, cells, ways and kinds, at the smallest sizes."""

import json

import bearings
import benchmark
import clean_check
import gradients
import layer
import learning
import lorenz
import okf
import peers_targets
import pytest
import reproduce
import short_tracks
import targets

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("rough_figures", "short_tracks")]


@pytest.fixture(autouse=True)
def two_steps(monkeypatch):
    """Simulated tracks are shorter still."""
    monkeypatch.setattr(short_tracks, "STEPS", 2)


@pytest.fixture
def run(tmp_path):
    """What a script writes."""

    def run(script, *options, quiet=("--quiet",)):
        out = tmp_path / "r.json"
        assert script.main([*options, *quiet, "--json", str(out)]) == 0
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
    monkeypatch.setattr(learning, "of_fits", lambda *arguments: {})  # both: test_learning.py
    monkeypatch.setattr(learning, "table", None)
    cells = run(learning, "--trainings", "2", "--iterations", "1", "--runs", "2", "--no-compile")["cells"]
    assert list(cells) == list(learning.CELLS)
    assert all(len(of["trainings"]) == len(learning.WAYS.split(",")) for of in cells.values())


def test_reproduce_has_every_filter_of_reentry(run):
    found = run(reproduce, "reentry", "--runs", "2")
    assert list(found["filters"]) == list(reproduce.EXPERIMENTS["reentry"].defaults)


def test_reproduce_has_every_filter_of_clutter(run):
    found = run(reproduce, "clutter-crossing", "--runs", "2")["filters"]
    assert all(any(of.startswith(name) for of in found) for name in reproduce.EXPERIMENTS["clutter-crossing"].defaults)


def test_lorenz_has_every_filter_in_every_setting(run, monkeypatch):
    settings = {name: of._replace(steps=20 if of.published else 2) for name, of in lorenz.SETTINGS.items()}
    monkeypatch.setattr(lorenz, "SETTINGS", settings)
    monkeypatch.setattr(lorenz, "LEARNED_FROM", 2)
    monkeypatch.setattr(lorenz, "BATCH", 2)
    monkeypatch.setattr(lorenz, "fitted", lambda f, tracks, loss: f)  # fits themselves are tested by test_lorenz.py
    errors = run(lorenz, "--runs", "2", "--network", "1", "--variances", "1")["errors"]
    assert list(errors) == list(settings)
    fitted = {f"{name}, {words}" for name in lorenz.FITTED.split(",") for words in lorenz.LOSSES}
    for of in errors.values():
        assert all({*lorenz.FILTERS.split(","), *fitted, "KalmanNet, small"} <= found.keys() for found in of.values())


def test_okf_has_every_way_of_the_lidar(run):
    found = run(okf, "--draws", "1", "--tracks", "20", "--iterations", "0", "--no-compile")["found"]
    assert list(found) == ["lidar"]
    assert list(found["lidar"]) == list(okf.PROBLEMS["lidar"].ways)


def test_targets_counts_runs_that_end_before_any_target_is_there(run):
    found = run(targets, "--runs", "1", "--what", "many", quiet=())["many"]
    assert found["share of a target's life in which it is followed"] == 0


def test_benchmark_times_every_filter_without_kernels(run):
    rows = run(benchmark, "--batch", "1", "--passes", "1", "--modes", "eager", quiet=())["rows"]
    assert [row["system"] for row in rows] == [f"{name}, eager" for name in benchmark.FILTERS.split(",")]


def test_peers_targets_has_every_tracker_that_is_installed(run):
    rows = run(peers_targets, "--targets", "2", "--clutter", "2", "--scans", "10", "--runs", "1", quiet=())["rows"]
    assert {row["tracker"] for row in rows} >= set(peers_targets.OURS)


def test_clean_check_has_every_kind(run):
    few = ["--flights", "1", "--runs", "1", "--steps", "12", "--periods", "5", "--noises", "15"]
    cases = run(clean_check, *few, quiet=())["cases"]
    assert {case["kind"] for case in cases} == set(clean_check.KINDS) - {"ranges"}  # which are recorded
