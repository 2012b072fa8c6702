"""Several filters learn shared values from how far they are from the best other filter."""

import json

import pytest
import torch
from short_tracks import STEPS, short

from torchfra import metrics, presets, scenarios
from torchfra.running import distributed
from train import tune
from train.batches import simulate
from train.gpb.evolution import Evolution
from train.gpb.regimes import regimes
from train.gpb.regret import POWER, Cases, Regrets
from train.runs import configured

pytestmark = pytest.mark.usefixtures("rough_figures")

TASKS = [
    {"scenario": "bearings-outliers", "options": {"outliers": "std", "initial": "truth"}, "models": "motion"},
    {"scenario": "bearings-manoeuvre", "options": {"outliers": "bursts"}, "models": "bank", "allowed": 0.04},
    {"scenario": "bearings-outliers", "options": {"outliers": "none"}, "weight": 0, "models": "bank"},
]
PLAIN = [{**task, "models": "motion"} for task in TASKS]
"""The same for filters of one motion, which take less time."""
SMALL = ("batch=2", "iterations=2", "validate_every=1", "validation_runs=2", "test_runs=2", "rivals=srckf,imm_srckf",
         "compile=false", "population=4")  # fmt: skip


def settings(*changes, tasks=TASKS[:2]):
    return configured("gpb", [*SMALL, f"tasks={json.dumps(tasks)}", *changes])


@pytest.fixture(scope="module")
def training():
    with short():
        return Regrets(settings())


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """What two iterations leave, and the folder."""
    out = tmp_path_factory.mktemp("gpb")
    with short():
        return tune.tune(settings(tasks=PLAIN[::2]), out, quiet=True), out


# ---------------------------------------------------------------- what is shared


def test_filters_of_a_motion_and_of_a_bank_have_the_same_values(training):
    motion, bank = training.filters
    assert len(motion.bank) == 1 < len(bank.bank)
    for f in (motion, bank):
        assert f.prior_outlier is training.filter["prior_outlier"]
        assert f.regimes.self_transition is training.filter["self_transition"]
        assert f.outliers.outlier_transition is training.filter["outlier_transition"]
        assert sum(p is q for p in f.parameters() for q in training.parameters.values()) == len(training.config.start)


@pytest.fixture
def no_cases(monkeypatch):
    """No tracks are simulated and no rivals run: of what the filters of the tasks are."""
    monkeypatch.setattr(Regrets, "_cases", lambda *given, **named: None)


@pytest.mark.usefixtures("short_tracks", "no_cases")
def test_tasks_with_the_same_models_have_one_filter():
    same = [TASKS[0], {**TASKS[0], "options": {"outliers": "none"}}, TASKS[1]]
    first, second, other = Regrets(settings("rivals=srckf", tasks=same)).filters
    assert first is second is not other


@pytest.mark.slow
@pytest.mark.usefixtures("short_tracks")
def test_models_with_other_values_share_a_filter_and_are_run_with_their_own():
    tasks = [
        {"scenario": "as-stated", "options": {"q": q, "dt": dt, "outliers": "none"}} for q, dt in ((1, 1), (9, 10))
    ]
    training = Regrets(settings("rivals=srckf", tasks=tasks))
    assert training.filters[0] is training.filters[1]
    for _ in range(2):
        for i, scenario in enumerate(training.scenarios):
            ((_, batch),) = (group for group in training.cases.groups if group[0] == [i])
            with torch.no_grad():
                alone = presets.gpb(scenario.motion, scenario.sensor, **training.preset())(
                    batch.z, batch.prior, dt=scenario.dt
                )
                found = training.errors([i], batch)[0, 0]
            torch.testing.assert_close(found, metrics.rmse(alone.mean, batch.truth, scenario.position).mean())


@pytest.mark.usefixtures("short_tracks", "no_cases")
def test_tasks_with_other_places_of_the_sensor_have_another_filter():
    tasks = [{"scenario": "ranges-outliers", "options": {"anchors": anchors}} for anchors in ("together", "around")]
    one, other = Regrets(settings("rivals=srckf", tasks=tasks)).filters
    assert one is not other


@pytest.mark.slow
@pytest.mark.usefixtures("short_tracks")
def test_only_what_is_named_learns():
    training = Regrets(settings("learn=self_transition,prior_outlier", "rivals=srckf"))
    assert sorted(training.parameters) == ["prior_outlier.raw", "self_transition.raw"]
    before = training.preset()
    training.iterate(0)
    assert {name for name, value in training.preset().items() if value != before[name]} == {
        "self_transition",
        "prior_outlier",
    }


@pytest.mark.slow
@pytest.mark.usefixtures("short_tracks")
def test_a_level_of_one_stays_one():
    training = Regrets(settings("rivals=srckf", tasks=TASKS[:1]))
    training.iterate(0)
    levels, start = training.preset()["noise_levels"], training.config.start["noise_levels"]
    assert levels[1] == pytest.approx(1.0, rel=1e-12)
    assert all(levels[i] != pytest.approx(start[i], rel=1e-6) for i in (0, 2, 3))


# ---------------------------------------------------------------- the loss


def tracks_of(training, task, runs=3):
    return simulate([training.scenarios[task]], first=0, runs=runs, seed=5)


def test_an_error_is_the_mean_over_time_of_the_rmse_over_the_runs(training):
    scenario = training.scenarios[0]
    tracks = scenario.simulate(3, seed=5)
    with torch.no_grad():
        found = training.errors([0], tracks_of(training, 0)).squeeze(-1)
        info = training.filters[0](tracks.z, tracks.prior, u=tracks.u, dt=scenario.dt).info
    for error, belief in zip(found, (info.filtered, info.lagged), strict=True):
        torch.testing.assert_close(error, metrics.rmse(belief.mean, tracks.truth, scenario.position).mean())


def test_steps_of_unknown_truth_do_not_count_but_an_estimate_that_is_nan_does(training):
    tracks = tracks_of(training, 0)
    ended = tracks.truth.index_fill(1, torch.arange(15, STEPS), torch.nan)
    with torch.no_grad():
        part = training.errors([0], tracks._replace(truth=ended))
        lost = training.errors([0], tracks._replace(prior=tracks.prior._replace(mean=tracks.prior.mean * torch.nan)))
        info = training.filters[0](tracks.z, tracks.prior, u=tracks.u, dt=tracks.dt).info
    first = metrics.rmse(info.filtered.mean[:, :15], tracks.truth[:, :15], slice(0, 2)).mean()
    torch.testing.assert_close(part[0, 0], first)
    assert lost.isnan().all()


def test_a_loss_is_a_power_of_the_ratios_to_what_is_allowed_within_bounds(training, monkeypatch):
    cases = Cases([([0], None), ([1], None)], torch.tensor([2.0, 5.0], dtype=torch.float64))
    ratios = torch.tensor([[1.1], [0.1]], dtype=torch.float64)
    monkeypatch.setattr(training, "errors", lambda tasks, batch: ratios * cases.rivals[tasks])
    first, second = training.losses_of(cases)
    assert first == pytest.approx((1.1**POWER + 0.7**POWER) / 2)
    assert second == pytest.approx(((1.1 / 1.04) ** POWER + (0.7 / 1.04) ** POWER) / 2)
    monkeypatch.setattr(training, "errors", lambda tasks, batch: torch.full((2, 1), torch.nan))
    assert training.losses_of(cases)[0] == 12.0**POWER


@pytest.mark.usefixtures("short_tracks")
def test_rivals_have_the_same_runs_as_the_filters(training):
    for cases, runs in (
        (training.cases, training.config.batch),
        (training.validation_cases, training.config.validation_runs),
    ):
        assert all(len(batch.z) == runs * len(tasks) for tasks, batch in cases.groups)
    rival = training.best_rival(
        0, held_out=True, runs=training.config.validation_runs, seed=training.config.validation_seed
    )[1]
    assert training.validation_cases.rivals[0] == rival


@pytest.mark.slow
@pytest.mark.usefixtures("short_tracks")
def test_a_rival_is_the_best_of_all_that_the_scenario_has_models_for(training):
    name, error = training.best_rival(1, held_out=False, runs=2, seed=0)
    alone = {rival: Regrets(settings(f"rivals={rival}")).best_rival(1, held_out=False, runs=2, seed=0)[1]
             for rival in ("srckf", "imm_srckf")}  # fmt: skip
    assert error == min(alone.values()) == alone[name]


# ---------------------------------------------------------------- the search


def test_the_search_finds_the_least_of_a_quadratic_whose_axes_differ_a_hundredfold():
    scales = torch.logspace(0, 2, 10, dtype=torch.float64)
    search = Evolution(torch.ones(10, dtype=torch.float64), step=0.3, population=10, seed=0)
    for _ in range(400):
        search.tell((search.ask() * scales).square().sum(-1))
    assert (search.mean * scales).square().sum() < 1e-8
    spread = search.variances.sqrt() * scales
    assert spread.max() / spread.min() < 10


def test_candidates_without_a_loss_are_the_worst():
    search = Evolution(torch.zeros(2, dtype=torch.float64), step=1.0, population=6, seed=0)
    candidates = search.ask()
    losses = torch.tensor([torch.nan, 1.0, torch.inf, 2.0, 3.0, torch.nan])
    search.tell(losses)
    torch.testing.assert_close(search.mean, search.weights @ candidates[[1, 3, 4]])


def test_a_search_goes_on_from_its_state():
    one, two = (Evolution(torch.ones(3, dtype=torch.float64), step=0.3, population=4, seed=1) for _ in range(2))
    for _ in range(3):
        one.tell(one.ask().square().sum(-1))
    two.load_state_dict(one.state_dict())
    assert torch.equal(two.ask(), one.ask())


# ---------------------------------------------------------------- a run


@pytest.mark.slow
def test_what_was_learned_goes_into_the_preset(run):
    result, _ = run
    scenario = scenarios.bearings_manoeuvre()
    learned = result["values"]["learned"]
    for models in (scenario.motion, scenario.bank):
        f = presets.gpb(models, scenario.sensor, **result["preset"])
        assert f.prior_outlier().item() == pytest.approx(learned["prior_outlier"])
        assert f.outliers.outlier_sizes()[1].item() == pytest.approx(learned["outlier_sizes[1]"])
    assert learned.keys() == result["values"]["start"].keys()


@pytest.mark.slow
def test_a_run_tells_each_tasks_best_rival_and_errors_before_and_after(run):
    result, out = run
    assert json.loads((out / "results.json").read_text()) == json.loads(json.dumps(result))
    assert [task["weight"] for task in result["tasks"]] == [1, 0]
    for task in result["tasks"]:
        best = task["rival"]["rmse_position"]
        for when in ("before", "after"):
            for of in task[when].values():
                assert of["regret"] == pytest.approx(of["rmse_position"] / best - 1)
    text = tune.report_text(result)
    assert "noise_levels = (" in text
    assert "best rival" in text


@pytest.mark.parametrize(("change", "message"), [
    ('tasks=[{"scenario":"bearings-outliers","models":"house"}]', "models: expected one of"),
    ('tasks=[{"scenario":"growth","models":"bank"}]', "models: expected 'motion'"),
    ('tasks=[{"scenario":"bearings-outliers","weight":0}]', "tasks: expected one of a weight above 0"),
    ("population=2", "population: expected at least 4"),
    ('fixed={"noise_levels":[9]}', "fixed, noise_levels: expected indices below 4, received"),
])  # fmt: skip
def test_a_setting_that_makes_no_sense_is_named_before_any_work(change, message, tmp_path, capsys):
    few = f"tasks={json.dumps(TASKS[:1])}"  # unless the change is of these
    assert tune.main(["gpb", *SMALL, few, change, "--out", str(tmp_path / "x")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_several_processes_are_refused_as_the_loss_is_of_all_runs_together(monkeypatch):
    monkeypatch.setattr(distributed, "size", lambda: 2)
    with pytest.raises(ValueError, match="expected another than 'regret' in 2 processes"):
        Regrets(settings())


# ---------------------------------------------------------------- known values


def test_simulated_levels_and_outliers_come_as_often_as_their_chains_say():
    model = {
        "noise_levels": (0.1, 100.0),
        "self_transition": (0.94, 0.8),
        "restart": (0.5, 0.5),
        "outlier_transition": ((0.9, 0.1), (0.4, 0.6)),
        "size": 1e6,
    }
    tracks = regimes(**model).simulate(512, 3)
    outlier = (tracks.z - tracks.truth[..., :2]).norm(dim=-1) > 6
    assert outlier.double().mean().item() == pytest.approx(0.1 / 0.5, abs=0.01)
    share = 0.03 / 0.13  # of the agile level in the long run
    push = tracks.truth[..., 4:].diff(dim=1)[:, 50:]
    assert push.square().mean().item() == pytest.approx(0.01 * (100 * share + 0.1 * (1 - share)), rel=0.05)


@pytest.mark.slow
def test_levels_chains_and_sizes_a_factor_three_off_are_found_again(tmp_path, monkeypatch):
    """All but the calm level, which the agile one outweighs when both are merged."""
    fewer = ["batch=8", "iterations=60", "lr=0.8", "validate_every=60"]
    values = tune.tune(configured("recover_gpb", fewer), tmp_path, quiet=True)["values"]
    learned, known = values["learned"], values["known"]
    for path in (
        "regimes.noise_levels[1]",
        "outliers.outlier_sizes[0]",
        "outliers.outlier_transition[0,1]",
        "outliers.outlier_transition[1,0]",
    ):
        assert abs(values["start"][path] / known[path] - 1) > 0.6, path
        assert learned[path] == pytest.approx(known[path], rel=0.15), path
    for path in ("regimes.self_transition[0]", "regimes.self_transition[1]"):
        assert 1 - learned[path] == pytest.approx(1 - known[path], rel=0.15), path
