"""Training learns, survives what goes wrong, and several processes do what one does."""

import csv
import dataclasses
import json
import os
import signal
import sys

import pytest
import torch
from short_tracks import short
from two_processes import forked, run_in_two

import torchfra
from torchfra import losses, presets, readers, scenarios
from torchfra.cli import main as cli
from torchfra.fitting.descent import Descent
from train import tune
from train.batches import simulate
from train.runs import RUNS, configured
from train.training import Training

pytestmark = pytest.mark.usefixtures("rough_figures")

SMALL = (
    "batch=8",
    "iterations=4",
    "validate_every=2",
    "validation_runs=8",
    "test_runs=8",
    "skip=0",
    "lr=0.05",
    "scale=100",
)
SHORT = 'tasks=[{"scenario":"growth","options":{"outliers":"std"}}]'
"""Of a single state: kernels that are written in no time."""


def train(out, *arguments):
    with short():
        return tune.main(["fra_bearings", *SMALL, SHORT, *arguments, "--out", str(out), "--quiet"])


def prepare(name, *changes):
    return Training(configured(name, changes))


def descent_of(training, score=torch.inf):
    """A descent of which nothing is done yet."""
    return Descent(training, training.filter, torch.tensor(score).double(), dataclasses.asdict(training.config))


def learned(out):
    return torch.load(out / "state_dict.pt", weights_only=True)


def log_of(out):
    return list(csv.DictReader((out / "log.csv").read_text().splitlines()))


def equal(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[key], b[key]) for key in a)


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    out = tmp_path_factory.mktemp("unbroken")
    assert train(out) == 0
    return out


# ---------------------------------------------------------------- what a run leaves


@pytest.mark.slow
def test_a_run_writes_its_settings_its_log_its_values_and_a_figure(unbroken):
    assert {path.name for path in unbroken.iterdir()} >= {
        "config.json", "log.csv", "state_dict.pt", "checkpoint.pt", "checkpoint-previous.pt", "learning.png",
        "results.json",
    }  # fmt: skip
    rows = log_of(unbroken)
    assert [int(row["iteration"]) for row in rows] == [1, 2, 3, 4]
    assert all(float(row["loss"]) > 0 and row["left out"] == "0" for row in rows)
    assert [bool(row["validation"]) for row in rows] == [False, True] * 2
    assert json.loads((unbroken / "config.json").read_text())["iterations"] == 4
    result = json.loads((unbroken / "results.json").read_text())
    assert result["values"]["start"].keys() == result["values"]["learned"].keys()
    assert result["versions"]["torch"] == torch.__version__
    assert result["tasks"][0]["before"]["rmse_position"] > 0


@pytest.mark.slow
def test_the_learned_values_load_into_a_fixed_filter(unbroken):
    scenario = scenarios.growth()
    f = presets.fra(scenario.motion, scenario.sensor)
    f.load_state_dict(learned(unbroken))
    reported = json.loads((unbroken / "results.json").read_text())["values"]["learned"]
    assert f.gate().item() == pytest.approx(reported["gate"])
    assert f.motion.q().item() == pytest.approx(reported["motion.q"])


# ---------------------------------------------------------------- interruptions


def train_until_killed(out):
    """Ends this process like ``kill -9`` in the fourth iteration, where the last checkpoint is that of the second."""
    step = Training.step

    def killed_in_the_fourth(training, iteration):
        if iteration == 3:
            os.kill(os.getpid(), signal.SIGKILL)
        return step(training, iteration)

    Training.step = killed_in_the_fourth
    return train(out)


@pytest.mark.slow
def test_a_run_that_is_killed_resumes_to_the_same_values(unbroken, tmp_path):
    process = forked(train_until_killed, tmp_path)
    process.join(300)
    assert process.exitcode == -signal.SIGKILL
    assert train(tmp_path, "--resume") == 0
    assert equal(learned(tmp_path), learned(unbroken))
    assert [int(row["iteration"]) for row in log_of(tmp_path)] == [1, 2, 3, 4]


def test_when_no_checkpoint_can_be_read_the_run_says_so_and_changes_nothing(tmp_path, capsys):
    for name in ("checkpoint.pt", "checkpoint-previous.pt"):
        (tmp_path / name).write_bytes(b"PK broken")
    assert train(tmp_path, "--resume") == 2
    assert "no checkpoint" in capsys.readouterr().err
    assert (tmp_path / "checkpoint.pt").read_bytes() == b"PK broken"


def test_a_run_is_not_overwritten_nor_resumed_with_other_settings(unbroken, capsys):
    before = (unbroken / "checkpoint.pt").read_bytes()
    assert train(unbroken) == 2
    assert "holds a run already" in capsys.readouterr().err
    assert train(unbroken, "--resume", "lr=0.2") == 2
    assert "these differ: lr" in capsys.readouterr().err
    assert (unbroken / "checkpoint.pt").read_bytes() == before


# ---------------------------------------------------------------- what it promises


def test_a_track_that_diverges_to_nan_is_left_out_and_counted():
    training = prepare("fra_bearings", *SMALL, SHORT)
    batch = simulate(training.scenarios, first=0, runs=8, seed=0)
    mean = batch.prior.mean.clone()
    mean[3] = torch.nan
    loss, gradient, left_out = training.task_means(batch._replace(prior=batch.prior._replace(mean=mean)))
    expected_loss, expected_gradient, _ = training.task_means(batch.rows(torch.tensor([0, 1, 2, 4, 5, 6, 7])))
    assert left_out == 1
    assert gradient.isfinite().all()
    torch.testing.assert_close(gradient, expected_gradient, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(loss, expected_loss)


@pytest.mark.slow
def test_the_gradient_of_a_batch_is_that_of_its_mean_loss():
    training = prepare("fra_bearings", *SMALL, "clip=1e9")
    batch = simulate(training.scenarios, first=0, runs=4, seed=0)
    loss, gradient, _ = training.task_means(batch)
    f, first = training.filter, training.scenarios[0]
    estimate = f(batch.z, batch.prior, u=batch.u, dt=batch.dt)
    each = losses.robust_mse(estimate.mean, batch.truth, first.truth_position, training.config.scale)
    each = each.unflatten(0, (len(training.scenarios), 4))
    expected = torch.autograd.grad(training.task_weights @ each.mean(1), list(training.parameters.values()))
    torch.testing.assert_close(training.task_weights @ gradient, torch.stack(expected), rtol=1e-8, atol=1e-10)
    torch.testing.assert_close(loss, each.detach().mean(1))


def test_the_gradient_of_one_track_moves_the_values_no_further_than_the_clip():
    training = prepare("fra_bearings", *SMALL, SHORT, "clip=1e-3")
    _, gradient, _ = training.task_means(simulate(training.scenarios, first=0, runs=8, seed=0))
    assert 0 < gradient.norm() <= 1e-3


@pytest.mark.slow
def test_training_stops_when_validation_no_longer_improves(tmp_path, monkeypatch):
    scores = iter([1.0, 0.9, 0.95, 0.96, 0.5])
    monkeypatch.setattr(Training, "validation", lambda training: torch.tensor(next(scores)).double())
    assert train(tmp_path, "validate_every=1", "patience=2", "iterations=20", "test_runs=0") == 0
    result = json.loads((tmp_path / "results.json").read_text())
    assert (result["iterations"], result["best"]) == (4, 2)


def test_shorter_tracks_of_another_task_end_in_missing_data():
    short, long = scenarios.bearings_outliers(), scenarios.bearings_manoeuvre()
    cut = short.__class__(**{**vars(short), "steps": 60, "block": lambda rng, n: _cut(short.block(rng, n))})
    batch = simulate([cut, long], first=0, runs=3, seed=0)
    assert batch.z.shape == (6, 100, 2)
    assert batch.z[:3, 60:].isnan().all()
    assert batch.truth[:3, 60:].isnan().all()
    assert not batch.z[3:].isnan().any()


def _cut(tracks):
    return tracks._replace(truth=tracks.truth[:, :60], z=tracks.z[:, :60], u=tracks.u[:60])


@pytest.mark.parametrize(("change", "message"), [
    ("rate=1", "expected KEY=VALUE with a key of"),
    ("lr", "expected KEY=VALUE"),
    ("lr=fast", "lr: expected float, received 'fast'"),
    ("lr=-1", "lr: expected a value above 0"),
    ("batch=0", "batch: expected at least 1"),
    ("tasks=[1]", "tasks: expected JSON"),
    ("validation_seed=0", "three different"),
    ("loss=love", "loss: expected one of"),
    ("learn=phase", "learn: expected 'all' or some of"),
    ("filter=kalman", "filter: expected one of"),
    ('search={"gate":0.6}', "search: expected values that fra takes"),
    ('search={"unlikely":[0.6]}', "search: expected values that fra takes"),
    ("cold=2", "cold: expected above 0 and at most 1.0"),
])  # fmt: skip
def test_a_setting_that_makes_no_sense_is_named_before_any_work(change, message, tmp_path, capsys):
    assert tune.main(["fra_bearings", change, "--out", str(tmp_path / "x")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_an_unknown_run_is_answered_with_the_known_ones(capsys):
    assert tune.main(["fra_sonar"]) == 2
    message = capsys.readouterr().err
    assert all(name in message for name in RUNS)


def test_every_named_run_is_tried():
    assert set(RUNS) == {*STEPPED, "fra_bearings", "switching", "noise", "recover", "gpb", "recover_gpb"}


UNMENDED = 'tasks=[{"scenario":"recorded","options":{"repair":false}}]'
FIVE = f"files={','.join(map(str, readers.samples('gliders')[:5]))}"
STEPPED = {"fra_recorded": [UNMENDED, FIVE], "contaminated": [], "association": []}
"""Runs of which a step is tried, and what is changed to save time; others learn below, and in
test_train_gpb.py; a step of fra_bearings is a command line of a document."""


@pytest.mark.slow
@pytest.mark.parametrize("name", STEPPED)
def test_a_named_run_takes_a_step(name):
    with short():
        training = prepare(name, "batch=4", "iterations=1", "validation_runs=1", "compile=false", *STEPPED[name])
        before = training.natural()
        row = descent_of(training).advance()
    assert row["left out"] == 0
    after, searched = training.natural(), set(training.config.search)
    assert all(after[path] != value for path, value in before.items() if path.rpartition(".")[2] not in searched)


def test_what_no_gradient_reaches_is_searched_on_validation_tracks(monkeypatch):
    training = prepare("switching", "batch=1", "validation_runs=1", "compile=false")
    descent = descent_of(training, score=10.0)

    def score(training):
        f = training.filter
        return (f.subset.unlikely() - 0.1).abs() + (f.subset.principal() - 0.3).abs()

    monkeypatch.setattr(Training, "validation", score)
    tune.search(training, descent)
    training.filter.load_state_dict(descent.best)
    assert training.filter.subset.unlikely().item() == pytest.approx(0.1)
    assert training.filter.subset.principal().item() == pytest.approx(0.3)
    assert descent.scores.item() == pytest.approx(0.0, abs=1e-12)


def all_learned(result):
    """Whether no track was left out, and every value that a gradient reaches has moved."""
    start, after = result["values"]["start"], result["values"]["learned"]
    searched = set(result["config"]["search"])
    return result["left_out"] == 0 and all(
        after[path] != value for path, value in start.items() if path.rpartition(".")[2] not in searched
    )


@pytest.mark.slow
def test_learned_switching_errs_less_than_all_five_models_with_fixed_values(tmp_path):
    """At the cost of three: 12.4 and 13.9 m for all five, unseen runs, from sample 21 on."""
    one_task = 'tasks=[{"scenario":"adsb-turns"}]'
    fewer = ["iterations=8", "lr=0.4", "batch=16", "validation_runs=16", "test_runs=50", "search={}"]
    result = tune.tune(configured("switching", [one_task, *fewer]), tmp_path, quiet=True)
    assert all_learned(result)
    after = result["tasks"][0]["after"]
    assert after["rmse_x"] < 11.5
    assert after["rmse_y"] < 12.0
    f = presets.vsimm_srckf(scenarios.adsb_models(), scenarios.adsb_turns().sensor)
    f.load_state_dict(learned(tmp_path))


def test_a_filter_for_other_measurements_is_refused():
    with pytest.raises(ValueError, match=r"filter: expected one of .*'ukf_jpda'.* received 'fra'"):
        prepare("association", "filter=fra")
    with pytest.raises(ValueError, match=r"filter: expected one of .*'fra'.* received 'iaukf_jpda'"):
        prepare("noise", "filter=iaukf_jpda")


# ---------------------------------------------------------------- several processes


@pytest.mark.slow
def test_two_processes_train_as_one_does(unbroken, tmp_path):
    with short():
        run_in_two(tune.main, ["fra_bearings", *SMALL, SHORT, "test_runs=0", "--quiet", "--out", str(tmp_path)])
    one, two = (log_of(out) for out in (unbroken, tmp_path))
    assert len(one) == len(two)
    for a, b in zip(one, two, strict=True):
        for key in a.keys() - {"seconds"}:
            assert (not a[key] and not b[key]) or float(a[key]) == pytest.approx(float(b[key]), rel=1e-10), key


@pytest.mark.slow
def test_two_processes_compare_as_one_does(tmp_path):
    arguments = ["compare", "--scenario", "bearings-outliers", "--outliers", "std", "--runs", "5", "--filters",
                 "srckf", "--quiet", "--figure", str(tmp_path / "f.png"), "--json"]  # fmt: skip
    one, two = tmp_path / "1.json", tmp_path / "2.json"
    with short():
        assert cli.main([*arguments, str(one)]) == 0
        run_in_two(cli.main, [*arguments, str(two)])
    results = [json.loads(path.read_text().replace("null", "NaN"))["filters"] for path in (one, two)]
    for name, figures in results[0].items():
        for key in figures.keys() - {"microseconds", "relative_time"}:
            assert figures[key] == pytest.approx(results[1][name][key], rel=1e-10, nan_ok=True), key


# ---------------------------------------------------------------- known values


@pytest.mark.slow
def test_noise_levels_a_factor_three_off_are_found_again(tmp_path):
    result = tune.tune(configured("noise", ["iterations=60", "batch=32"]), tmp_path, quiet=True)
    assert result["values"]["learned"]["motion.q"] == pytest.approx(0.04, rel=0.15)
    assert result["values"]["learned"]["sensor.std"] == pytest.approx(0.0175, rel=0.15)


@pytest.mark.slow
def test_threshold_weakening_and_q_a_factor_three_off_are_found_again(tmp_path):
    one_task = 'tasks=[{"scenario":"bearings-outliers","options":{"outliers":"std","truth_noise":0.03}}]'
    fewer = ["batch=8", "validation_runs=8", "iterations=50", "lr=0.15", "validate_every=50"]
    result = tune.tune(configured("recover", [one_task, *fewer]), tmp_path, quiet=True)
    for path, known in result["values"]["known"].items():
        assert result["values"]["learned"][path] == pytest.approx(known, rel=0.15), path
    assert torchfra.__version__ == result["versions"]["torchfra"]


@pytest.mark.slow
def test_without_a_compiler_it_says_how_to_train_without(tmp_path, capsys, no_compiler):
    assert train(tmp_path) == 2
    assert "compile=false trains without" in capsys.readouterr().err
    assert train(tmp_path, "compile=false", "iterations=1", "test_runs=0") == 0


def test_a_tensorboard_that_is_not_there_is_asked_for(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    assert train(tmp_path, "tensorboard=true") == 2
    assert "pip install 'torchfra[tensorboard]'" in capsys.readouterr().err
