"""Several filters learn shared values from how far they are from the best other filter."""

import json

import pytest
import torch

from torchfra import metrics, presets, scenarios
from torchfra.app import distributed
from train import checkpoints, tune
from train.regimes import regimes
from train.regret import POWER, Regrets
from train.runs import configured

TASKS = [
    {"scenario": "bearings-outliers", "options": {"outliers": "std", "initial": "truth"}, "models": "motion"},
    {"scenario": "bearings-manoeuvre", "options": {"outliers": "bursts"}, "models": "bank"},
    {"scenario": "bearings-outliers", "options": {"outliers": "none"}, "weight": 0, "models": "bank"},
]
SMALL = ("batch=2", "iterations=2", "validate_every=2", "validation_runs=2", "test_runs=2", "rivals=srckf,imm_srckf",
         "checkpoint_every=1", "compile=false")  # fmt: skip


def settings(*changes, tasks=TASKS[:2]):
    return configured("gpb", [*SMALL, f"tasks={json.dumps(tasks)}", *changes])


@pytest.fixture(scope="module")
def training():
    return Regrets(settings())


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """What two iterations leave, and the folder."""
    out = tmp_path_factory.mktemp("gpb")
    return tune.tune(settings(tasks=TASKS), out, quiet=True), out


# ---------------------------------------------------------------- what is shared


def test_filters_of_a_motion_and_of_a_bank_have_the_same_values_but_those_of_their_own(training):
    motion, bank = training.filters
    assert len(motion.bank) == 1 < len(bank.bank)
    for name in ("poor", "start"):
        assert getattr(motion, name) is getattr(bank, name)
    assert motion.qualities.sizes is bank.qualities.sizes
    assert motion.regimes.chain is not bank.regimes.chain
    owners = {name: sum(p is q for f in training.filters for q in f.parameters())
              for name, p in training.parameters.items()}  # fmt: skip
    assert {name.partition(".")[0] for name, count in owners.items() if count == 1} == set(training.config.only)
    assert set(owners.values()) == {1, 2}


def test_tasks_with_the_same_models_are_one_batch_of_one_filter():
    same = [TASKS[0], {**TASKS[0], "options": {"outliers": "none"}}, TASKS[1]]
    training = Regrets(settings("rivals=srckf", tasks=same))
    first, second, other = training.filters
    assert first is second is not other


def test_only_what_is_named_learns():
    training = Regrets(settings("learn=stay,poor", "rivals=srckf"))
    assert sorted(training.parameters) == ["poor.raw", "stay.raw"]


# ---------------------------------------------------------------- the loss


def test_an_error_is_the_mean_over_time_of_the_rmse_over_the_runs(training):
    scenario, f = scenarios.bearings_outliers("std", initial="truth"), training.filters[0]
    tracks = scenario.simulate(3, seed=5)
    with torch.no_grad():
        found = training.errors([0], training.scenarios, first=0, runs=3, seed=5).squeeze(-1)
        info = f(tracks.z, tracks.prior, u=tracks.u, dt=scenario.dt).info
    for error, belief in zip(found, (info.filtered, info.settled), strict=True):
        rmse = metrics.rmse(belief.mean, tracks.truth, scenario.position)
        torch.testing.assert_close(error, rmse.mean())


def test_steps_of_unknown_truth_do_not_count():
    flights = [{"scenario": "recorded", "options": {"sensor": "position"}, "models": "motion"}]
    training = Regrets(settings("rivals=srckf", tasks=flights))
    truth = training.scenarios[0].simulate(200, seed=0).truth
    ended = int(truth.isnan().flatten(1).any(1).nonzero()[0])  # a window that ends early
    (whole,) = training.errors([0], training.scenarios, first=ended, runs=1, seed=0)[1]
    assert whole.isfinite()
    (gradient,) = torch.autograd.grad(whole, training.parameters["poor.raw"])
    assert gradient.isfinite()
    assert gradient != 0


def test_a_rival_is_the_best_of_all_that_the_scenario_has_models_for(training):
    name, error = training.best_rival(1, held_out=False, runs=2, seed=0)
    alone = {}
    for rival in ("srckf", "imm_srckf"):
        training.config.__dict__["rivals"] = (rival,)
        alone[rival] = training.best_rival(1, held_out=False, runs=2, seed=0)[1]
    training.config.__dict__["rivals"] = ("srckf", "imm_srckf")
    assert error == min(alone.values()) == alone[name]


def test_the_gradient_is_that_of_the_weighted_ratios_to_the_fourth_power():
    training = Regrets(settings("clip=1e9", "rivals=srckf"))

    def loss():
        with torch.no_grad():
            ratios = [training.errors([i], training.scenarios, first=4, runs=2, seed=0).squeeze(-1) / training.rivals[i]
                      for i in range(2)]  # fmt: skip
        return torch.stack(ratios).pow(POWER).mean(-1) @ training.task_weights

    losses, gradient, left_out = training.gradient(4)
    torch.testing.assert_close(training.task_weights @ losses, loss())
    assert left_out == 0
    at = 0
    for parameter in training.parameters.values():
        entry, step = parameter.data.view(-1)[:1], 1e-4
        value = entry.clone()
        sides = [(entry.copy_(value + sign * step), loss())[1] for sign in (1, -1)]
        entry.copy_(value)
        expected = (sides[0] - sides[1]) / (2 * step)
        torch.testing.assert_close(gradient[at], expected, rtol=1e-4, atol=1e-7)
        at += parameter.numel()


def test_the_gradient_is_no_longer_than_the_clip(training):
    training.config.__dict__["clip"] = 1e-9
    _, gradient, _ = training.gradient(0)
    training.config.__dict__["clip"] = 1.0
    assert gradient.norm().item() == pytest.approx(1e-9)


def test_where_an_error_is_nan_nothing_changes_and_all_tracks_are_counted(training, monkeypatch):
    errors = training.errors
    monkeypatch.setattr(training, "errors", lambda *args, **kwargs: errors(*args, **kwargs) * torch.nan)
    _, gradient, left_out = training.gradient(0)
    assert left_out == 4
    assert not gradient.any()
    assert training.validation() == torch.inf


# ---------------------------------------------------------------- a run


def test_what_was_learned_goes_into_the_preset(run):
    result, _ = run
    scenario = scenarios.bearings_manoeuvre()
    learned = result["values"]["learned"]
    for kind, models in (("motion", scenario.motion), ("bank", scenario.bank)):
        f = presets.gpb(models, scenario.sensor, **result["presets"][kind])
        assert f.poor().item() == pytest.approx(learned["poor"])
        assert f.qualities.sizes()[1].item() == pytest.approx(learned["sizes[1]"])
    assert learned["poor"] != result["values"]["start"]["poor"]


def test_a_run_tells_each_tasks_best_rival_and_errors_before_and_after(run):
    result, out = run
    assert json.loads((out / "results.json").read_text()) == json.loads(json.dumps(result))
    assert [task["weight"] for task in result["tasks"]] == [1, 1, 0]
    for task in result["tasks"]:
        best = task["rival"]["rmse_position"]
        for when in ("before", "after"):
            for of in task[when].values():
                assert of["regret"] == pytest.approx(of["rmse_position"] / best - 1)
    text = tune.report_text(result)
    assert "gpb of a bank:" in text
    assert "best rival" in text


def test_a_run_that_is_interrupted_resumes_to_the_same_values(run, tmp_path, monkeypatch):
    save = checkpoints.save

    def save_and_stop(training, out):
        save(training, out)
        raise KeyboardInterrupt

    monkeypatch.setattr(checkpoints, "save", save_and_stop)
    with pytest.raises(KeyboardInterrupt):
        tune.tune(settings(tasks=TASKS), tmp_path, quiet=True)
    monkeypatch.setattr(checkpoints, "save", save)
    resumed = tune.tune(settings(tasks=TASKS), tmp_path, resume=True, quiet=True)
    assert resumed["iterations"] == 2
    assert resumed["values"] == run[0]["values"]


def test_the_named_run_has_tasks_of_several_sensors_with_bursts_and_flights_held_out():
    config = configured("gpb")
    counted = [task for task in config.tasks if task.weight > 0]
    assert {task.models for task in counted} == {"motion", "bank"}
    assert {task.options.get("sensor", "bearings") for task in counted} == {"bearings", "position", "radar"}
    assert {task.options["outliers"] for task in counted} == {"none", "covariance", "std", "bursts"}
    assert any(task.scenario == "recorded" and task.models == "bank" for task in config.tasks if task.weight == 0)


@pytest.mark.parametrize(("change", "message"), [
    ('tasks=[{"scenario":"bearings-outliers","models":"house"}]', "models: expected one of"),
    ('tasks=[{"scenario":"growth","models":"bank"}]', "models: expected 'motion'"),
    ('tasks=[{"scenario":"bearings-outliers","weight":0}]', "tasks: expected one of a weight above 0"),
    ('only={"stay":"house"}', "only: expected one of"),
])  # fmt: skip
def test_a_setting_that_makes_no_sense_is_named_before_any_work(change, message, tmp_path, capsys):
    assert tune.main(["gpb", *SMALL, change, "--out", str(tmp_path / "x")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_several_processes_are_refused_as_the_loss_is_of_all_runs_together(monkeypatch):
    monkeypatch.setattr(distributed, "size", lambda: 2)
    with pytest.raises(ValueError, match="expected another than 'regret' in 2 processes"):
        Regrets(settings())


# ---------------------------------------------------------------- known values


def test_simulated_levels_and_outliers_come_as_often_as_their_chains_say():
    tracks = regimes(chain=((0.97, 0.03), (0.1, 0.9)), qualities=((0.9, 0.1), (0.4, 0.6)), size=1e6).simulate(512, 3)
    outlier = (tracks.z - tracks.truth[..., :2]).norm(dim=-1) > 60
    assert outlier.double().mean().item() == pytest.approx(0.2, abs=0.01)
    jerk = tracks.truth[..., 4:].diff(dim=1)
    share = 0.03 / 0.13  # of the agile level in the long run
    expected = 0.01 * (100 * share + 0.1 * (1 - share))
    assert jerk[:, 50:].square().mean().item() == pytest.approx(expected, rel=0.05)


@pytest.mark.slow
def test_levels_sizes_and_chains_a_factor_three_off_are_found_again(tmp_path):
    result = tune.tune(configured("levels", ["iterations=60"]), tmp_path, quiet=True)
    learned = result["values"]["learned"]
    known = {"regimes.levels[0]": 0.1, "regimes.levels[1]": 100.0, "qualities.sizes[0]": 100.0,
             "regimes.chain[0,1]": 0.03, "regimes.chain[1,0]": 0.1, "qualities.chain[0,1]": 0.03,
             "qualities.chain[1,0]": 0.4}  # fmt: skip
    for path, value in known.items():
        assert learned[path] == pytest.approx(value, rel=0.3), path
