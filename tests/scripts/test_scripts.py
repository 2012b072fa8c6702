"""What the README and the scripts promise, happens."""

import functools
import json
import re
from pathlib import Path

import bearings as bearings_table
import benchmark
import numpy as np
import pytest
import reproduce
import time_stamps
import torch
from benchmarks import elsewhere, roof, training
from papers import bearings
from short_tracks import SMALL_GPB, STEPS

from torchfra import presets, scenarios
from torchfra.catalogue import SCENARIOS

pytestmark = pytest.mark.usefixtures("rough_figures")

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_the_quickstart_of_the_readme_runs(capsys, monkeypatch):
    code = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    simulate = scenarios.Scenario.simulate
    monkeypatch.setattr(
        scenarios.Scenario, "simulate", lambda scenario, runs, seed: simulate(scenario, runs // 5, seed)
    )
    scope: dict[str, object] = {}
    printed = []
    for block in code:
        if ".compile()" in block:  # with few hypotheses, for the compiler's time
            monkeypatch.setattr(presets, "gpb", functools.partial(presets.gpb, **SMALL_GPB))
        exec(compile(block, "README.md", "exec"), scope)
        printed.append(capsys.readouterr().out)
    (simulated,) = (i for i, block in enumerate(code) if "bearings_outliers" in block)
    assert 100 < float(re.findall(r"tensor\(([\d.]+)", printed[simulated])[0]) < 170
    (learned,) = (text for text in printed if "learnable" in text)
    before, after = (float(error) for error in re.findall(r"^\) ([\d.]+)$", learned, re.M))
    assert 100 < before < 250  # with so few tracks the change is not the one that README.md has
    assert 100 < after < 250


@pytest.mark.slow
@pytest.mark.usefixtures("short_tracks")
def test_reproduce_writes_results_and_the_papers_figures(tmp_path):
    files = ["--json", str(tmp_path / "r.json"), "--plots", str(tmp_path)]
    assert reproduce.main(["bearings-outliers", "--runs", "10", *files, "--quiet"]) == 0
    result = json.loads((tmp_path / "r.json").read_text())
    assert result.keys() == {"experiment", "runs", "seed", "settings", "versions", "filters", "windows", "shares"}
    assert result["experiment"] == "bearings-outliers"
    expected = {"rmse_position", "rmse_velocity", "mean_rmse_position", "median_error_position", "divergence_rate",
                "relative_time"}  # fmt: skip
    for name, figures in result["filters"].items():
        assert expected <= figures.keys()
        assert len(figures["rmse_position"]) == STEPS
        assert result["windows"]["position"][name] == {"1-20 s": pytest.approx(np.mean(figures["rmse_position"]))}
        assert all(0 <= share <= 1 for share in result["shares"][name].values())
    assert [path.stem.split("-")[:2] for path in sorted(tmp_path.glob("*.png"))] == [["wang", n] for n in "2345"]


@pytest.mark.usefixtures("short_tracks")
def test_the_papers_formulas_can_be_run_to_the_letter(tmp_path):
    """Without a limit of the fading factors and with a full inverse, which the safeguarded filter has not."""
    out = ["--runs", "2", "--filters", "fra_srckf", "--literal", "--json", str(tmp_path / "r.json"), "--quiet"]
    assert reproduce.main(["bearings-outliers", *out]) == 0
    filters = json.loads((tmp_path / "r.json").read_text())["filters"]
    assert list(filters) == ["fra_srckf", "fra_srckf_literal"]
    assert filters["fra_srckf"]["mean_rmse_position"] != filters["fra_srckf_literal"]["mean_rmse_position"]
    literal = bearings.OWN["fra_srckf_literal"](scenarios.bearings_outliers())
    assert literal.fading.fading_max().isinf()
    assert literal.fading.rcond == 0


@pytest.mark.slow
@pytest.mark.usefixtures("short_tracks")
def test_the_table_of_both_bearings_scenarios_has_a_column_for_each_reading(tmp_path, capsys):
    names = ["--filters", "ukf,srckf,imm_rsrckf", "--runs", "2"]
    assert bearings_table.main([*names, "--json", str(tmp_path / "r.json")]) == 0
    head, _, *rows = capsys.readouterr().out.splitlines()
    columns = json.loads((tmp_path / "r.json").read_text())["columns"]
    assert head == f"| | {' | '.join(columns)} |"
    assert len(columns) == 6
    assert [row.split(" | ")[0] for row in rows] == ["| `ukf`", "| `srckf`", "| `imm_rsrckf`"]
    assert bearings_table.main(["--filters", "ukf,srckf", "--runs", "2", "--one-by-one"]) == 0
    assert capsys.readouterr().out.splitlines()[2].startswith("| `ukf` | 1.00 | 1.00 |")


@pytest.mark.slow
@pytest.mark.usefixtures("short_tracks")
def test_reproduce_writes_what_du_and_zhang_show(tmp_path, capsys):
    out = ["--json", str(tmp_path / "r.json"), "--plots", str(tmp_path)]
    assert reproduce.main(["adsb-turns", "--runs", "4", *out]) == 0
    result = json.loads((tmp_path / "r.json").read_text())
    assert result["filters"].keys() == {"srckf", "imm3", "imm5", "vsimm_srckf"}
    for name, of in result["filters"].items():
        assert len(of["mean_error_x"]) == len(of["rmse_y"]) == len(of["mape_x"]) == STEPS
        assert of["relative_time"] > 0
        mean = sum(of["rmse_x"][18:]) / (STEPS - 18)
        assert result["averages"][name]["rmse_x"] == pytest.approx(mean)
    assert len(result["filters"]["imm3"]["probabilities"][0]) == 3
    assert result["models"][-1] == "turn -1.8 deg/s"
    names = {"2-tracks", "3-4-mean-error", "5-6-rmse", "7-8-mape", "probabilities"}
    assert {path.name for path in tmp_path.glob("*.png")} == {f"du-{name}.png" for name in names}
    assert "averages over time" in capsys.readouterr().out


@pytest.mark.slow
def test_reproduce_writes_the_decisions_of_the_alpha_beta_bank(tmp_path):
    out = ["--json", str(tmp_path / "r.json"), "--plots", str(tmp_path), "--quiet"]
    assert reproduce.main(["alpha-beta", "--runs", "12", *out]) == 0
    result = json.loads((tmp_path / "r.json").read_text())
    decisions = result["decisions"]
    assert decisions.keys() == result["filters"].keys() == {"f1", "f2", "f3", "paper", "paper_polar", "alphabeta"}
    assert list(decisions["alphabeta"]["rejected"]) == [str(k) for k in range(97, 105)]
    assert decisions["alphabeta"]["rejected"]["100"] == decisions["alphabeta"]["rejected"]["101"] == 1
    assert decisions["alphabeta"]["manoeuvre_x"] < decisions["f1"]["manoeuvre_x"]  # which follows the outliers
    names = {"4-x", "5-y", "6-z", "7-errors", "rmse", "levels"}
    assert {p.name for p in tmp_path.glob("*.png")} == {f"xu-{name}.png" for name in names}


@pytest.mark.slow
def test_reproduce_writes_mean_square_errors_over_the_contamination(tmp_path):
    out = ["--json", str(tmp_path / "r.json"), "--plots", str(tmp_path), "--quiet"]
    scenario = scenarios.growth()
    torch.save(presets.hghckf2(scenario.motion, scenario.sensor, threshold=1.0).state_dict(), tmp_path / "values.pt")
    learned = ["--learned", f"hghckf2={tmp_path / 'values.pt'}"]
    assert reproduce.main(["growth", "--runs", "6", "--sizes", "1,20", "--compile", *learned, *out]) == 0
    result = json.loads((tmp_path / "r.json").read_text())
    assert list(result["by_size"]) == ["1", "20"]
    for of in result["by_size"].values():
        assert of.keys() == {"ghckf", "hghckf1", "hghckf2", "learned"}
        assert len(of["ghckf"]["mse"]) == 500
        assert of["ghckf"]["mmse"] == pytest.approx(sum(of["ghckf"]["mse"]) / 500)
    assert result["by_size"]["1"]["ghckf"]["mmse"] < result["by_size"]["20"]["ghckf"]["mmse"]
    assert {p.name for p in tmp_path.glob("*.png")} == {"qin-1-mmse-position.png", "qin-2-position.png"}


@pytest.mark.slow
@pytest.mark.usefixtures("short_tracks")
def test_reproduce_writes_the_errors_of_the_reentry(tmp_path):
    out = ["--json", str(tmp_path / "r.json"), "--plots", str(tmp_path), "--quiet"]
    assert reproduce.main(["reentry", "--runs", "2", "--filters", "ghckf", "--sizes", "1", *out]) == 0
    result = json.loads((tmp_path / "r.json").read_text())
    assert len(result["filters"]["ghckf"]["rmse_parameter"]) == STEPS
    assert result["by_size"]["1"]["ghckf"].keys() == {"mmse", "mse", "mmse_velocity", "mmse_parameter"}
    quantities = ("position", "velocity", "parameter")
    names = {f"qin-{i + 3}-{q}.png" for i, q in enumerate(quantities)}
    names |= {f"qin-{i + 6}-mmse-{q}.png" for i, q in enumerate(quantities)}
    assert {p.name for p in tmp_path.glob("*.png")} == names


@pytest.mark.slow
@pytest.mark.usefixtures("short_tracks")
def test_reproduce_writes_errors_by_target_and_association_probabilities(tmp_path, capsys):
    out = ["--json", str(tmp_path / "r.json"), "--plots", str(tmp_path)]
    names = ["--filters", "iaukf_jpda_safe"]
    assert (
        reproduce.main(["clutter-crossing", "--runs", "4", "--noise-scale", "4", "--clutter", "4", *names, *out]) == 0
    )
    result = json.loads((tmp_path / "r.json").read_text())
    assert result["settings"]["noise_scale"] == 4
    wanted = {f"iaukf_jpda_safe {gate} m" for gate in (100, 150)}
    assert result["scans"].keys() == result["associations"].keys() == wanted
    of = result["scans"]["iaukf_jpda_safe 100 m"]
    assert len(of["rmse_range"]) == 2
    assert len(of["rmse_azimuth"][0]) == len(of["ospa"]) == STEPS
    assert of["filtered_range"] < of["raw_range"] == pytest.approx(5.0, rel=0.15)  # before the noise grows
    assert of["lost"] == 0
    for rows in result["associations"]["iaukf_jpda_safe 100 m"].values():
        assert [sum(row) for row in rows] == pytest.approx([1.0, 1.0])
        assert len(rows[0]) == 7
    names = {"6-errors", "crossing-ranges", "4-space-wide", "5-space"}
    assert {p.name for p in tmp_path.glob("*.png")} == {f"chen-{name}.png" for name in names}
    assert "association probabilities of the first run" in capsys.readouterr().out


@pytest.mark.slow
def test_reproduce_writes_the_errors_of_a_single_target_whose_noise_grows(tmp_path):
    out = ["--json", str(tmp_path / "r.json"), "--plots", str(tmp_path), "--quiet"]
    assert reproduce.main(["noise-change", "--runs", "20", *out]) == 0
    result = json.loads((tmp_path / "r.json").read_text())["scans"]
    assert result["iaukf"]["filtered_range"] < 0.85 * result["ukf"]["filtered_range"]
    assert [p.name for p in tmp_path.glob("*.png")] == ["chen-noise-change.png"]


def test_every_scenario_of_a_paper_has_an_experiment():
    assert SCENARIOS.keys() - reproduce.EXPERIMENTS.keys() == {"ranges-outliers", "as-stated"}
    assert reproduce.EXPERIMENTS.keys() <= SCENARIOS.keys()


@pytest.mark.parametrize("sizes", ["1,0", "1,-2", "1,nan", "1,inf"])
def test_a_late_size_that_cannot_be_is_said_before_the_first_run(sizes, monkeypatch, capsys):
    monkeypatch.setattr(reproduce, "Study", None)  # as a run would need it
    assert reproduce.main(["growth", "--sizes", sizes]) == 2
    assert f"sizes: expected numbers of 1 or more, received '{sizes}'" in capsys.readouterr().err


def test_reproduce_says_what_is_wrong(capsys):
    assert reproduce.main(["adsb-turns", "--sizes", "1,2"]) == 2
    assert "sizes: adsb-turns takes no such option" in capsys.readouterr().err
    assert reproduce.main(["growth", "--sizes", "large"]) == 2
    assert "sizes: expected numbers" in capsys.readouterr().err
    assert reproduce.main(["growth", "--plots", __file__]) == 2
    assert "plots: expected a folder, received the file" in capsys.readouterr().err
    assert reproduce.main(["adsb-turns", "--outliers", "std"]) == 2
    assert "adsb-turns takes no such option" in capsys.readouterr().err
    assert reproduce.main(["bearings-outliers", "--filters", "imm5"]) == 2
    assert "imm5" in capsys.readouterr().err
    assert reproduce.main(["clutter-straight", "--filters", "ukf_jpda"]) == 2
    assert "_paper or _safe" in capsys.readouterr().err
    assert reproduce.main(["bearings-outliers", "--filters", "kalman"]) == 2
    assert "kalman" in capsys.readouterr().err


def test_time_stamps_says_what_mending_them_changes(tmp_path, capsys):
    late = 5 * np.arange(100) - np.random.default_rng(0).uniform(0, 3, 100)
    np.savetxt(
        tmp_path / "a.csv", np.c_[5 * np.arange(100), 80 * late, 0 * late], "%.6f", ",", header="t,x,y", comments=""
    )
    assert time_stamps.main([str(tmp_path / "a.csv"), "--json", str(tmp_path / "r.json")]) == 0
    result = json.loads((tmp_path / "r.json").read_text())
    assert result["acceleration along, m/s^2, recorded"][-1] > 9 > 3 > result["acceleration along, m/s^2, mended"][-1]
    assert 10 < result["moved, m"][0] < 240
    assert result["off the recorded path, m"][-1] < 0.1
    assert "off the recorded path, m" in capsys.readouterr().out


def test_time_stamps_of_a_track_too_short_to_judge_are_an_error(tmp_path, capsys):
    (tmp_path / "a.csv").write_text("t,x,y\n0,0,0\n5,100,0\n")
    assert time_stamps.main([str(tmp_path / "a.csv")]) == 2
    assert "files: expected a track of 105 s or longer" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.usefixtures("short_tracks")
def test_the_benchmark_times_eager_and_compiled_filters(tmp_path, capsys):
    arguments = ["--what", "tracks,step", "--filters", "srckf", "--batch", "1,8", "--passes", "2", "--json"]
    assert benchmark.main([*arguments, str(tmp_path / "b.json")]) == 0
    result = json.loads((tmp_path / "b.json").read_text())
    timed = {(row["system"], row.get("batch")) for row in result["rows"]}
    assert timed == {(f"srckf, {mode}", batch) for mode in ("compiled", "eager") for batch in (1, 8)} | {
        (f"srckf.step, {mode}", None) for mode in ("compiled", "eager")
    }
    assert all(0 < row["q1"] <= row["median"] <= row["q3"] for row in result["rows"])
    assert result["versions"]["torch"] == torch.__version__
    assert result["settings"]["threads"] == torch.get_num_threads()
    assert "first call" in capsys.readouterr().out


@pytest.mark.slow
def test_the_benchmark_of_the_roof_says_how_far_filters_are_from_what_the_machine_can_do(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(roof, "COSTLY", {"div": 2, "norm": 2})  # each takes a second to compile
    arguments = ["--what", "roof", "--filters", "srckf", "--batch", "64", "--passes", "1", "--json"]
    assert benchmark.main([*arguments, str(tmp_path / "b.json"), "--precision", "single"]) == 0
    (row,) = json.loads((tmp_path / "b.json").read_text())["rows"]
    assert row["bytes"] == 4 * (2 + 4 + 6 + 36 + 2)  # z and two stations; mean, root, NIS and likelihood
    assert row["median over roof"] == pytest.approx(
        row["median"] / max(row["arithmetic us"], row["memory us"]), rel=0.2
    )
    assert "billion operations a second" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.usefixtures("short_tracks")
def test_the_benchmark_of_training_says_time_and_peak_memory(tmp_path):
    arguments = ["--what", "training", "--filters", "srckf", "--batch", "4", "--passes", "1", "--json"]
    assert benchmark.main([*arguments, str(tmp_path / "b.json")]) == 0
    rows = {row["system"]: row for row in json.loads((tmp_path / "b.json").read_text())["rows"]}
    plain, fast = rows["srckf, torch.linalg.qr"], rows["srckf, compiled"]
    assert fast["median"] < plain["median"] / 4
    assert (fast["peak_mib"] is None) == (plain["peak_mib"] is None)


@pytest.mark.slow
@pytest.mark.usefixtures("short_tracks")
def test_the_benchmark_of_a_layer_has_filters_and_network_beside_the_compiled_one(tmp_path):
    arguments = ["--what", "layer", "--batch", "4", "--passes", "1", "--json", str(tmp_path / "b.json")]
    assert benchmark.main(arguments) == 0
    rows = {row["system"]: row for row in json.loads((tmp_path / "b.json").read_text())["rows"]}
    fast, eager, extended = (rows[name] for name in ("srckf, compiled", "srckf, eager", "EKF, eager, as torchfilter's"))
    assert fast["ratio"] == 1.0
    assert fast["error"] == pytest.approx(eager["error"], rel=1e-6)
    assert fast["error"] == pytest.approx(extended["error"], rel=0.2)
    assert "KalmanNet, small" in rows


def test_plain_qr_is_the_same_filter(make, tracks):
    """The baseline of the benchmark computes what it is compared with."""
    f = make("srckf", learn="all")
    loss = f(tracks.z, tracks.prior, u=tracks.u).mean.square().sum()
    with training.plain_qr():
        other = f(tracks.z, tracks.prior, u=tracks.u).mean.square().sum()
        theirs = torch.autograd.grad(other, list(f.parameters()))
    for a, b in zip(torch.autograd.grad(loss, list(f.parameters())), theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-7, atol=0)


def test_the_benchmark_says_what_is_wrong(capsys):
    with pytest.raises(SystemExit):
        benchmark.main(["--filters", "kalman"])
    assert "--filters: expected some of" in capsys.readouterr().err
    for batch in ("a", "0", "1,", "-1"):
        with pytest.raises(SystemExit):
            benchmark.main([f"--batch={batch}"])
        assert f"--batch: expected whole numbers of 1 or more, separated by commas, received {batch}\n" in (
            capsys.readouterr().err
        )


def test_a_peer_times_a_call_for_each_line_in_a_process_without_torch(tmp_path, monkeypatch):
    """A stand-in for a package: a process of its own answers, and torch is not in it."""
    fake = tmp_path / "filterpy" / "kalman.py"
    fake.parent.mkdir()
    fake.with_name("__init__.py").touch()
    fake.write_text(_FAKE_FILTERPY)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(elsewhere, "PEERS", {"filterpy": "FilterPy UKF"})
    scenario = scenarios.bearings_outliers(initial="truth")
    tracks = scenario.simulate(1, 0)
    with elsewhere.start_peers(scenario, tracks) as peers:
        peer = peers["FilterPy UKF"]
        assert peer.first_call() > 0
        assert 0 < peer.one_pass() < 60
        assert 0 < peer.one_pass() < 60
        assert peer.means().tolist() == tracks.prior.mean.tolist()  # the stand-in does not move
    assert peer.process.returncode == 0


_FAKE_FILTERPY = """
import sys

assert "torch" not in sys.modules

class MerweScaledSigmaPoints:
    def __init__(self, *arguments): pass

class UnscentedKalmanFilter:
    def __init__(self, *arguments): pass
    def predict(self): pass
    def update(self, z, u): pass
"""


def test_a_peer_that_is_not_installed_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(elsewhere, "PEERS", {"filterpy": "FilterPy UKF"})
    (tmp_path / "filterpy.py").write_text("raise ImportError('no filterpy here')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    scenario = scenarios.bearings_outliers(initial="truth")
    with elsewhere.start_peers(scenario, scenario.simulate(1, 0)) as peers:
        assert not peers
    assert "FilterPy UKF: not installed (no filterpy here)" in capsys.readouterr().out


@pytest.mark.slow
def test_the_hand_written_program_is_a_peer_where_a_compiler_is(monkeypatch):
    monkeypatch.setattr(elsewhere, "PEERS", {})
    scenario = scenarios.bearings_outliers(initial="truth")
    with elsewhere.start_peers(scenario, scenario.simulate(16, 0)) as peers:
        if elsewhere.SIMD not in peers:
            pytest.skip("no C++ compiler")
        assert 0 < peers[elsewhere.SIMD].one_pass() < 60
        assert peers[elsewhere.SIMD].means() is None
