"""The regret table: errors, ratios and intervals are those of plain loops, and the command says what it compared."""

import json
import math
from fnmatch import fnmatchcase
from types import SimpleNamespace

import bounds
import numpy as np
import pytest
import regret
import short_tracks
import torch
from regrets import cells, figures, ratios, smoothed, tuning
from short_tracks import short

from torchfra import metrics, presets, scenarios
from torchfra.catalogue import filters_for, learned_filter, make_scenario
from torchfra.evaluation import evaluate
from torchfra.readers.recording import Recording

pytestmark = pytest.mark.usefixtures("rough_figures")

RUNS, STEPS = 7, 5
FEW = ["--cells", "2-std", "--runs", "3", "--no-compile"]


def table_of(errors, weights, chunk=3):
    """An ``Errors`` that has seen them in blocks."""
    found = ratios.Errors(len(errors))
    for first in range(0, len(errors), chunk):
        found.add(torch.from_numpy(errors[first : first + chunk]), weights[:, first : first + chunk])
    return found


def drawn_runs(weights):
    """For each resample the numbers of its runs."""
    return [[i for i, count in enumerate(counts) for _ in range(count)] for counts in weights.tolist()]


def mean_rmse(errors, runs):
    """Mean over time of the root mean square over these runs, some of them several times; NaN does not count."""
    over_time = []
    for k in range(errors.shape[1]):
        squares = [errors[i, k] ** 2 for i in runs if not math.isnan(errors[i, k])]
        if squares:
            over_time.append(math.sqrt(sum(squares) / len(squares)))
    return sum(over_time) / len(over_time)


@pytest.fixture(scope="module")
def noisy():
    """Errors of two filters, with unknown truth at some steps of both."""
    rng = np.random.default_rng(1)
    one = rng.exponential(10.0, (RUNS, STEPS))
    one[2, 3:] = one[5, 1] = np.nan
    return {"one": one, "other": one * rng.uniform(0.9, 1.7, one.shape)}


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """The JSON of a small run, and the picture it made."""
    folder = tmp_path_factory.mktemp("regret")
    files = ["--json", str(folder / "r.json"), "--figure", str(folder / "r.png")]
    with short():
        assert regret.main(["--filters", "fra,rsrckf", *FEW, "--quiet", *files]) == 0
    assert (folder / "r.png").stat().st_size > 1000
    return json.loads((folder / "r.json").read_text())


# ---------------------------------------------------------------- errors, ratios, intervals


def test_errors_of_blocks_are_those_of_loops_over_all_runs_and_over_each_resample(noisy):
    weights = ratios.draws(RUNS, seed=5, resamples=20)
    found = table_of(noisy["one"], weights).rmse()
    runs = drawn_runs(weights)
    assert runs[0] == list(range(RUNS))
    np.testing.assert_allclose(found, [mean_rmse(noisy["one"], drawn) for drawn in runs], rtol=1e-12)


def test_a_resample_draws_as_many_runs_as_there_are_and_a_seed_always_the_same():
    weights = ratios.draws(50, seed=4)
    assert weights.shape == (1 + ratios.RESAMPLES, 50)
    assert (weights[0] == 1).all()
    assert (weights.sum(-1) == 50).all()
    assert (weights[1:] == 0).double().mean().item() == pytest.approx((1 - 1 / 50) ** 50, abs=0.01)
    assert torch.equal(weights, ratios.draws(50, seed=4))
    assert not torch.equal(weights, ratios.draws(50, seed=5))


def test_the_interval_holds_the_middle_95_percent_of_ratios_over_the_same_runs(noisy):
    weights = ratios.draws(RUNS, seed=5, resamples=200)
    of = ratios.ratios({name: table_of(errors, weights) for name, errors in noisy.items()}, ["other"], 15.0)
    expected = [mean_rmse(noisy["other"], runs) / mean_rmse(noisy["one"], runs) for runs in drawn_runs(weights)]
    other, ordered = of["filters"]["other"], sorted(expected[1:])
    assert of["best"] == "one"
    assert other["ratio"] == pytest.approx(expected[0])
    assert other["interval"] == pytest.approx([ordered[4], ordered[194]])  # the 5th and the 195th of 200
    assert of["filters"]["one"]["interval"] == [1.0, 1.0]
    lost = sum(math.sqrt(np.nanmean(errors**2)) > 15.0 for errors in noisy["other"]) / RUNS
    assert other["lost"] == pytest.approx(lost)
    assert 0 < lost < 1


def test_the_best_is_never_one_of_those_compared(noisy):
    weights = ratios.draws(RUNS, seed=0, resamples=10)
    found = {name: table_of(errors, weights) for name, errors in noisy.items()}
    of = ratios.ratios(found, ["one"], 15.0)
    assert of["best"] == "other"
    assert of["filters"]["one"]["ratio"] < 1


def test_a_run_without_an_estimate_is_infinitely_far_off_in_the_resamples_that_draw_it(noisy):
    weights = ratios.draws(RUNS, seed=2, resamples=30)
    errors = noisy["one"].copy()
    errors[4, 2] = np.inf
    found = table_of(errors, weights).rmse()
    assert found[0] == np.inf
    assert (np.isinf(found) == (weights[:, 4] > 0).numpy()).all()
    of = ratios.ratios({"failed": table_of(errors, weights), "one": table_of(noisy["one"], weights)}, ["failed"], 15.0)
    assert of["filters"]["failed"]["interval"][1] == of["filters"]["failed"]["ratio"] == np.inf
    assert table_of(errors, weights).lost(1e6) == pytest.approx(1 / RUNS)


def test_the_error_of_a_single_run_is_the_root_mean_square_over_time_without_an_interval():
    error = np.array([[3.0, 4.0, np.nan, 5.0]])
    found = {"a": table_of(error, ratios.draws(1, 0, 0)), "b": table_of(2 * error, ratios.draws(1, 0, 0))}
    of = ratios.ratios(found, ["b"], 5.0)["filters"]
    assert of["a"] == {"rmse": pytest.approx(math.sqrt(50 / 3)), "lost": 0.0, "ratio": 1.0, "interval": None}
    assert of["b"]["ratio"] == pytest.approx(2.0)
    assert of["b"]["lost"] == 1.0


def test_estimates_are_told_apart_by_what_the_info_holds():
    mean, other, third = torch.zeros(3, 1)
    for info, filtered, lagged in (
        (None, mean, None),
        (SimpleNamespace(lagged=None), mean, None),
        (SimpleNamespace(provisional=SimpleNamespace(mean=other)), other, mean),
        (SimpleNamespace(filtered=SimpleNamespace(mean=other), lagged=None), other, mean),
        (SimpleNamespace(lagged=SimpleNamespace(mean=other)), mean, other),
        (SimpleNamespace(filtered=SimpleNamespace(mean=other), lagged=SimpleNamespace(mean=third)), other, third),
    ):
        found = ratios.estimates_of(SimpleNamespace(mean=mean, info=info))
        assert found.pop("filtered") is filtered
        assert found.get("lagged") is lagged


# ---------------------------------------------------------------- the command


def test_a_file_holds_every_filter_of_a_cell_and_what_it_was_compared_with(result):
    assert result.keys() == {"runs", "seed", "resamples", "versions", "compared", "learned", "own_models", "summary",
                             "cells"}  # fmt: skip
    assert (result["runs"], result["seed"], result["compared"]) == (3, 3, ["fra", "rsrckf"])
    assert {"torchfra", "torch", "numpy", "python"} <= result["versions"].keys()
    (cell,) = result["cells"].values()
    scenario = make_scenario("bearings-manoeuvre", outliers="std")
    assert (cell["scenario"], cell["runs"], cell["settings"]["limit"]) == (scenario.name, 3, 2000.0)
    assert cell["settings"]["outliers"] == "std"
    assert cell["with_lag"] == ["gpb", "fra_srckf", "fra"]
    for kind in ("filtered", "lagged"):
        of = cell[kind]["filters"]
        assert of.keys() == set(filters_for(scenario))
        best = min((name for name in of if name not in ("fra", "rsrckf")), key=lambda name: of[name]["rmse"])
        assert cell[kind]["best"] == best
        for one in of.values():
            assert one["ratio"] == pytest.approx(one["rmse"] / of[best]["rmse"])
            low, high = one["interval"]
            assert low <= high
        assert result["summary"][kind]["fra"]["worst"] == pytest.approx(of["fra"]["ratio"] - 1)


@pytest.mark.usefixtures("short_tracks")
def test_errors_are_those_of_evaluate_and_the_provisional_estimates_are_the_filtered_ones(result):
    scenario = make_scenario("bearings-manoeuvre", outliers="std")
    expected = evaluate(scenario, ["srckf", "fra", "imm_srckf"], runs=3, seed=3)
    (cell,) = result["cells"].values()
    for name, of in expected.items():
        one = cell["lagged"]["filters"][name]
        assert one["rmse"] == pytest.approx(of["mean_rmse_position"], rel=1e-9)
        assert one["lost"] == pytest.approx(of["divergence_rate"])
    assert cell["filtered"]["filters"]["srckf"]["rmse"] == cell["lagged"]["filters"]["srckf"]["rmse"]
    tracks = scenario.simulate(3, 3)
    info = presets.fra(scenario.motion, scenario.sensor)(tracks.z, tracks.prior, u=tracks.u).info
    provisional = metrics.rmse(info.provisional.mean, tracks.truth, scenario.position).mean().item()
    assert cell["filtered"]["filters"]["fra"]["rmse"] == pytest.approx(provisional, rel=1e-9)


@pytest.mark.usefixtures("short_tracks")
def test_tables_have_a_line_for_each_compared_filter_and_a_summary(capsys):
    assert regret.main(["--filters", "fra,srckf", *FEW]) == 0
    filtered, lagged = (block.splitlines() for block in capsys.readouterr().out.strip().split("\n\n"))
    for kind, lines in (("filtered", filtered), ("lagged", lagged)):
        assert lines[0].split("  ")[0] == f"{kind}: cell"
        assert [line.split()[3] for line in lines[1:3]] == ["fra", "srckf"]
        assert [line.split(",")[0] for line in lines[3:]] == ["fra", "srckf"]
        assert all(f", {kind}: median regret " in line for line in lines[3:])


@pytest.mark.slow
@pytest.mark.usefixtures("short_tracks")
def test_learned_values_are_compared_and_are_no_candidates_for_the_best(tmp_path, capsys):
    scenario = scenarios.bearings_manoeuvre()
    same, other = tmp_path / "same" / "state_dict.pt", tmp_path / "other" / "state_dict.pt"
    for file, q in ((same, 0.01), (other, 0.5)):
        file.parent.mkdir()
        f = presets.rsrckf(scenario.motion, scenario.sensor, learn=("q",))
        f.motion.q.set(q)
        torch.save(f.state_dict(), file)
    learned = [f"rsrckf={same}", f"rsrckf={other}"]
    few = [*FEW, "--others", "srckf,rsrckf"]
    assert regret.main(["--filters", "fra", *learned, *few, "--json", str(tmp_path / "r.json")]) == 0
    (cell,) = json.loads((tmp_path / "r.json").read_text())["cells"].values()
    of = cell["filtered"]["filters"]
    assert of[str(same)]["rmse"] == pytest.approx(of["rsrckf"]["rmse"])
    assert of[str(other)]["rmse"] != pytest.approx(of["rsrckf"]["rmse"], rel=1e-3)
    assert cell["filtered"]["best"] not in (str(same), str(other), "fra")
    assert [line.split()[3] for line in capsys.readouterr().out.splitlines()[1:4]] == ["fra", "same", "other"]
    assert (
        regret.main(["--filters", "rsrckf", str(other), "--own-models", *few, "--json", str(tmp_path / "o.json")]) == 0
    )
    (cell,) = json.loads((tmp_path / "o.json").read_text())["cells"].values()
    assert cell["filtered"]["filters"][str(other)]["rmse"] == pytest.approx(of["rsrckf"]["rmse"])


def test_values_learned_with_another_sensor_fit_where_models_stay_a_cells_own(tmp_path):
    scenario = scenarios.adsb_turns()
    file = tmp_path / "state_dict.pt"
    torch.save(presets.rsrckf(scenario.motion, scenario.sensor, threshold=0.5).state_dict(), file)
    bearings = scenarios.bearings_outliers()
    f = learned_filter(file, bearings, "rsrckf", models=False)
    assert f.robust.threshold().item() == pytest.approx(0.5)
    assert f.sensor.std().item() == pytest.approx(bearings.sensor.std().item())
    assert f.motion.q().item() == pytest.approx(bearings.motion.q().item())


@pytest.mark.slow
def test_recorded_ranges_are_cells_of_one_run(tmp_path):
    rng, time = np.random.default_rng(0), 0.1 * np.arange(30)
    path = np.stack([time, 0.2 * time**2], 1)
    anchors = np.array([[-5.0, -5.0], [9.0, -4.0], [2.0, 9.0]])
    for place in ("a", "b"):
        (tmp_path / "ranges" / place).mkdir(parents=True)
        rows = [f"{t:.1f},{x},{y}" for t, (x, y) in zip(time, path, strict=True)]
        (tmp_path / "ranges" / place / "path.csv").write_text("\n".join(["t,x,y", *rows]))
        for i, (x, y) in enumerate(anchors):
            distance = np.linalg.norm(path - (x, y), axis=1) + 0.1 * rng.standard_normal(30)
            rows = [f"{t:.1f},{r},{x},{y}" for t, r in zip(time, distance, strict=True)]
            (tmp_path / "ranges" / place / f"{i}.csv").write_text("\n".join(["t,range,x,y", *rows]))
    known = cells.all_cells(ranges=[tmp_path / "ranges"])
    places = [str(tmp_path / "ranges" / place) for place in ("a", "b")]
    assert [name for name, cell in known.items() if cell.runs == 1] == places
    arguments = ["--ranges", str(tmp_path / "ranges"), "--cells", f"{tmp_path}*", "--filters", "fra", "--quiet"]
    arguments += ["--others", "srckf"]
    assert regret.main([*arguments, "--json", str(tmp_path / "r.json")]) == 0
    found = json.loads((tmp_path / "r.json").read_text())["cells"]
    assert list(found) == places
    for cell in found.values():
        assert (cell["runs"], cell["settings"]["limit"]) == (1, 20.0)
        srckf = cell["filtered"]["filters"]["srckf"]
        assert 0.01 < srckf["rmse"] < 1
        assert srckf["interval"] is None


def test_cells_are_chosen_by_names_and_patterns():
    known = cells.all_cells()
    assert len(known) == 6 * len(cells.OUTLIERS) + 1 + len(cells.as_stated())
    assert known["stated-velocity-0.1-std-q10"].make().settings["q"] == 10
    for patterns in (["*"], ["2-std"], ["1-*", "flights-radar-none"], ["*-bursts"]):
        chosen = list(cells.chosen_cells(known, patterns))
        assert chosen == [name for name in known if any(fnmatchcase(name, pattern) for pattern in patterns)]
        assert chosen
    for name in ("1-paper-std", "2-bursts", "ranges"):
        scenario = known[name].make()
        assert scenario.settings["outliers"] in (name.rpartition("-")[2], "short")


@pytest.mark.parametrize(("arguments", "message"), [
    (["--cells", "3-std"], "cells: expected names or patterns among 1-paper-none, "),
    (["--filters", "kalman"], "filters: expected some of "),
    (["--filters", ""], "filters: expected some of "),
    (["--filters", "jpda"], "filters: expected some of "),
    (["--filters", "alphabeta", *FEW], "filters: expected some that go with 2-std, received alphabeta"),
    (["--filters", "fra", "--others", "fra", *FEW], "others: expected some that go with 2-std beside those compared"),
    (["--filters", "fra", "missing.pt", *FEW], "file not found: missing.pt"),
    (["--filters", "fra", "kalman=missing.pt", *FEW], "expected some of "),
    (["--filters", "fra", "--ranges", "missing", *FEW], "missing: expected CSV or JSON files there or below"),
    (["--filters", "fra", *FEW, "--runs", "0"], "runs"),
])  # fmt: skip
def test_a_wrong_argument_is_one_line_that_names_it(arguments, message, capsys):
    assert regret.main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("regret: error: ")
    assert message in error
    assert error.count("\n") == 1


@pytest.fixture
def one_of_each_kind(monkeypatch):
    """Cells that differ in their models: two steps, no outliers, one index, a short flight; seven resamples."""
    time = 5.0 * np.arange(25)
    flight = Recording("a", time, np.stack([100 * time, 0 * time, 0 * time], 1), None, {})
    monkeypatch.setattr(short_tracks, "STEPS", 2)
    monkeypatch.setattr(cells, "INDICES", (0.1,))
    monkeypatch.setattr(cells, "OUTLIERS", ("none",))
    monkeypatch.setattr(cells, "_recordings", lambda files: [flight])
    for module in (regret, ratios):
        monkeypatch.setattr(module, "RESAMPLES", 7)


@pytest.mark.slow
@pytest.mark.usefixtures("short_tracks", "one_of_each_kind")
@pytest.mark.parametrize("kind", [["--others", "srckf"], ["--smooth", "--filters", "fra,srckf"]])
def test_every_cell_is_run_by_default(kind, tmp_path):
    assert regret.main([*kind, "--runs", "2", "--no-compile", "--quiet", "--json", str(tmp_path / "r.json")]) == 0
    found = json.loads((tmp_path / "r.json").read_text())["cells"]
    assert list(found) == list(cells.all_cells())


def test_what_cannot_be_done_in_a_late_cell_is_said_before_the_first_run(monkeypatch, capsys):
    monkeypatch.setattr(regret, "errors", None)  # as a run would call it
    assert regret.main(["--filters", "alphabeta", "--cells", "stated-velocity-0.1-none,stated-turn-0.1-none"]) == 2
    assert "filters: expected some that go with stated-turn-0.1-none, received alphabeta" in capsys.readouterr().err
    monkeypatch.setattr(smoothed, "errors", None)
    late = "stated-velocity-0.1-none,stated-ranges-0.1-none"
    assert regret.main(["--smooth", "--filters", "vsimm_srckf", "--cells", late]) == 2
    assert "some that go with stated-velocity-0.1-none, received vsimm_srckf" in capsys.readouterr().err
    assert regret.main(["--smooth", "--filters", "alphabeta", "--cells", "stated-velocity-0.1-none"]) == 2
    assert "constant gains have no process noise" in capsys.readouterr().err


@pytest.mark.usefixtures("short_tracks")
def test_a_cell_without_a_bound_is_left_out_of_the_table_of_bounds(tmp_path, capsys):
    path, small = tmp_path / "b.json", ["--filters", "srckf", "--runs", "2", "--jobs", "1", "--quiet"]
    assert bounds.main(["--cells", "stated-bank-0.1-none,stated-turn-0.1-none", *small, "--json", str(path)]) == 0
    assert list(json.loads(path.read_text())["cells"]) == ["stated-turn-0.1-none"]
    assert bounds.main(["--cells", "stated-bank-0.1-none", *small]) == 2
    assert "cells, filters: expected a cell that has a bound" in capsys.readouterr().err


# ---------------------------------------------------------------- the picture


def test_the_picture_has_every_ratio_in_its_place_and_leaves_what_is_missing_empty():
    panels = {"filtered": (["a", "b"], [[1.0, 0.87], [math.nan, 123.4]]), "lagged": (["a"], [[math.inf], [4567890.0]])}
    figure = figures.ratios(panels, ["first", "second"], "title")
    filtered, lagged, _ = figure.axes
    written = {(text.get_position(), text.get_text()) for text in filtered.texts}
    assert written == {((0, 0), "1.00"), ((1, 0), "0.87"), ((1, 1), "123")}
    assert [text.get_text() for text in lagged.texts] == [r"$\infty$", "$10^{7}$"]
    assert [label.get_text() for label in filtered.get_yticklabels()] == ["first", "second"]
    assert [label.get_text() for label in filtered.get_xticklabels()] == ["a", "b"]


@pytest.mark.slow
def test_filters_tuned_to_a_cell_err_less_there_and_say_by_how_much_they_changed(tmp_path):
    scenario = scenarios.bearings_outliers("none", initial="truth")  # its targets move without any process noise
    f = {
        "srckf": presets.srckf(scenario.motion, scenario.sensor).compile(),
        "rsrckf": presets.rsrckf(scenario.motion, scenario.sensor).compile(),
    }
    before = {name: one.state_dict() for name, one in f.items()}
    tuned, factors = tuning.specialists(f, scenario, seed=5)
    tracks = scenario.simulate(50, 7)
    for name, one in f.items():
        assert all(x.equal(y) for x, y in zip(before[name].values(), one.state_dict().values(), strict=True))
        best = tuned[f"{name} tuned"]
        assert tuning.error_of(best, scenario, tracks) < 0.9 * tuning.error_of(one, scenario, tracks)
        torch.testing.assert_close(best.motion.q(), factors[f"{name} tuned"]["q"] * one.motion.q())
    assert factors["srckf tuned"].keys() == {"q"}
    assert factors["rsrckf tuned"].keys() == {"q", "threshold"}
    with short():
        assert regret.main([*FEW, "--tuned", "srckf", "--quiet", "--json", str(tmp_path / "r.json")]) == 0
    cell = json.loads((tmp_path / "r.json").read_text())["cells"]["2-std"]
    assert cell["tuned"]["srckf tuned"].keys() == {"q"}
    assert "srckf tuned" in cell["filtered"]["filters"]


# ---------------------------------------------------------------- random cells


@pytest.mark.slow
def test_random_cells_are_judged_one_by_one_and_those_that_are_lost_are_the_first_lines(tmp_path, capsys):
    file = tmp_path / "open.json"
    few = ["--filters", "srckf", "--others", "rsrckf", "--runs", "3", "--seed", "2027", "--no-compile"]
    assert regret.main(["--open", "2", *few, "--json", str(file)]) == 0
    found, lines = json.loads(file.read_text()), capsys.readouterr().out.splitlines()
    assert list(found["cells"]) == ["0-none", "1-spikes"]
    ratio = {name: cell["filters"]["srckf"]["ratio"] for name, cell in found["cells"].items()}
    assert [line.split()[0] for line in lines[-3:-1]] == sorted(ratio, key=ratio.__getitem__, reverse=True)
    assert found["summary"]["srckf"]["worst"] == max(ratio.values())
    assert lines[-1].startswith("srckf, 2 cells: median ")


@pytest.mark.parametrize(("wrong", "message"), [
    (["--open", "0"], "open: expected 1 cell or more"),
    (["--open", "1", "--tuned", "fra"], "beside it, received tuned"),
    (["--open", "1", "--filters", "fra", "--others", "fra"], "others: expected some beside those compared"),
])  # fmt: skip
def test_random_cells_refuse_what_goes_with_other_cells(wrong, message, capsys):
    assert regret.main(wrong) != 0
    assert message in capsys.readouterr().err
