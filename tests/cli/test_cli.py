"""The commands do their work, write whole files, and say in one line what was wrong with what they were given."""

import json
import subprocess
import sys

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from short_tracks import STEPS

from torchfra import plotting, presets
from torchfra.catalogue import make_scenario
from torchfra.cli import main as cli
from torchfra.evaluation import evaluate
from torchfra.types import CompileError

pytestmark = pytest.mark.usefixtures("rough_figures")


@pytest.fixture
def noisy_track(tmp_path):
    """A straight flight of 80 fixes, 25 m of noise, one fix 3 km off at the 40th."""
    rng = np.random.default_rng(0)
    time = np.arange(80) * 4.0
    xy = np.stack([100 * time, 50 * time], 1) + 25 * rng.standard_normal((80, 2))
    xy[40] += 3000
    path = tmp_path / "flight.csv"
    path.write_text("t,x,y\n" + "".join(f"{t},{x},{y}\n" for t, (x, y) in zip(time, xy, strict=True)))
    return path


def test_too_few_runs_for_the_processes_are_refused(monkeypatch):
    monkeypatch.setattr("torchfra.running.distributed.size", lambda: 3)
    with pytest.raises(ValueError, match=r"^runs: expected 3 or more, one for each of 3 processes, received 2$"):
        evaluate(make_scenario("bearings-outliers"), ["ukf"], runs=2)
    with pytest.raises(ValueError, match=r"^chunk: expected 1 or more, received 0$"):
        evaluate(make_scenario("bearings-outliers"), ["ukf"], runs=3, chunk=0)


@pytest.mark.slow
@pytest.mark.usefixtures("short_tracks")
def test_compare_shows_the_probabilities_of_interacting_models(tmp_path):
    arguments = ["compare", "--scenario", "adsb-turns", "--filters", "srckf,vsimm_srckf", "--runs"]
    out = ["--json", str(tmp_path / "r.json"), "--figure", str(tmp_path / "f.png"), "--quiet"]
    assert cli.main([*arguments, "8", "--no-compile", *out]) == 0
    found = json.loads((tmp_path / "r.json").read_text())["filters"]
    assert len(found["vsimm_srckf"]["rmse_x"]) == len(found["srckf"]["rmse_x"]) == STEPS
    weights = np.array(found["vsimm_srckf"]["probabilities"])
    assert weights.shape == (STEPS, 5)
    np.testing.assert_allclose(weights.sum(1), 1)


def models():
    scenario = make_scenario("bearings-outliers")
    return scenario.motion, scenario.sensor


def compare(tmp_path, *options):
    out = ["--json", str(tmp_path / "r.json"), "--figure", str(tmp_path / "f.png")]
    return cli.main(["compare", "--scenario", "bearings-outliers", "--filters", "srckf", *options, *out])


@pytest.mark.slow
@pytest.mark.usefixtures("short_tracks")
def test_compare_compiles_when_it_is_worthwhile(tmp_path, monkeypatch):
    calls = []

    def choose(wanted, worthwhile, tell):
        calls.append((wanted, worthwhile))
        return False

    monkeypatch.setattr("torchfra.cli.compare_command.choose", choose)
    monkeypatch.setattr("torchfra.cli.compare_command.WORTHWHILE", 10 * STEPS)
    assert compare(tmp_path, "--runs", "9", "--quiet") == 0
    assert compare(tmp_path, "--runs", "10", "--no-compile", "--quiet") == 0
    assert calls == [(None, False), (False, True)]


@pytest.mark.slow
@pytest.mark.usefixtures("short_tracks")
def test_without_a_compiler_commands_run_interpreted_unless_told_to_compile(tmp_path, capsys, monkeypatch, no_compiler):
    monkeypatch.setattr("torchfra.cli.compare_command.WORTHWHILE", 1)
    assert compare(tmp_path, "--runs", "5") == 0
    said = capsys.readouterr().out
    assert said.startswith("filters run interpreted (expected the package llvmlite, which compiles kernels")
    assert compare(tmp_path, "--runs", "5", "--no-compile") == 0
    assert "interpreted" not in capsys.readouterr().out
    assert compare(tmp_path, "--runs", "5", "--compile") == 2
    assert "pip install 'torchfra[compiler]'" in capsys.readouterr().err


@pytest.mark.slow
def test_a_filter_without_a_kernel_runs_interpreted_beside_compiled_ones(tmp_path, capsys, monkeypatch):
    def refuse(self):
        raise CompileError("compile: too large")

    monkeypatch.setattr(presets.ukf(*models()).__class__, "compile", refuse)
    monkeypatch.setattr("torchfra.cli.compare_command.WORTHWHILE", 1)
    assert compare(tmp_path, "--runs", "5") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("compiled kernels (LLVM ")
    assert "ukf runs interpreted (too large)" in lines
    assert "srckf runs interpreted (too large)" in lines
    assert compare(tmp_path, "--runs", "5", "--compile") == 2
    assert "too large" in capsys.readouterr().err


@pytest.mark.slow
def test_compare_runs_a_scenario_through_filters(tmp_path, capsys):
    arguments = ["compare", "--scenario", "bearings-outliers", "--filters", "srckf,fra", "--runs", "5", "--seed", "3",
                 "--json", str(tmp_path / "r.json"), "--figure", str(tmp_path / "f.png")]  # fmt: skip
    assert cli.main(arguments) == 0
    result = json.loads((tmp_path / "r.json").read_text())
    assert result["runs"] == 5
    assert result["seed"] == 3
    assert result["filters"].keys() == {"srckf", "fra"}
    assert result["filters"]["fra"]["mean_rmse_position"] < result["filters"]["srckf"]["mean_rmse_position"]
    assert len(result["filters"]["fra"]["rmse_velocity"]) == 100
    assert "torch" in result["versions"]
    assert (tmp_path / "f.png").exists()
    assert "srckf" in capsys.readouterr().out


@pytest.mark.usefixtures("short_tracks")
def test_compare_draws_the_first_filter_the_usual_one_and_the_best_others(tmp_path, monkeypatch):
    drawn = []

    def comparison(results, shown, dt, limit, title, mapped):
        drawn.append((list(results), list(shown), list(mapped.estimates)))
        return Figure()

    monkeypatch.setattr(plotting, "comparison", comparison)
    arguments = ["compare", "--scenario", "bearings-outliers", "--filters", "ukf,rmckf,srckf,mr_ckf,rsrckf", "--quiet"]
    out = ["--runs", "4", "--figure", str(tmp_path / "f.png")]
    assert cli.main([*arguments, *out]) == 0
    ((names, shown, mapped),) = drawn
    assert names == ["ukf", "rmckf", "srckf", "mr_ckf", "rsrckf"]
    assert shown[:2] == ["ukf", "srckf"]
    assert mapped == shown[:3]


@pytest.mark.slow
def test_compare_runs_recorded_tracks_through_filters(noisy_track, tmp_path):
    arguments = ["compare", str(noisy_track), "--sensor", "radar", "--filters", "ukf,fra", "--steps", "60", "--quiet",
                 "--json", str(tmp_path / "r.json"), "--figure", str(tmp_path / "f.png")]  # fmt: skip
    assert cli.main(arguments) == 0
    result = json.loads((tmp_path / "r.json").read_text())
    assert result["settings"]["sensor"] == "radar"
    assert result["filters"]["ukf"]["relative_time"] == pytest.approx(1.0)


@pytest.fixture
def walks(tmp_path):
    """Two recordings of ranges from four anchors to someone on a circle, the second with a range 9 m short."""
    time = np.arange(60) * 0.1
    path = np.stack([3 + 2 * np.cos(time / 2), 4 + 2 * np.sin(time / 2)], 1)
    for name, wrong in (("a", 0.0), ("b", 9.0)):
        folder = tmp_path / "walks" / name
        folder.mkdir(parents=True)
        lines = [f"{t},{x},{y},0.5" for t, (x, y) in zip(time, path, strict=True)]
        (folder / "path.csv").write_text("\n".join(["t,x,y,z", *lines]))
        for i, place in enumerate(((0, 0, 2), (9, 0, 2), (9, 8, 1), (0, 8, 1))):
            away = np.sqrt(np.square(path - place[:2]).sum(1) + (place[2] - 0.5) ** 2)
            away[30 if i == 1 else 0] += wrong if i == 1 else 0.0
            lines = [f"{t},{r},{place[0]},{place[1]},{place[2]}" for t, r in zip(time, away, strict=True)]
            (folder / f"A{i}.csv").write_text("\n".join(["t,range,x,y,z", *lines]))
    return tmp_path / "walks"


@pytest.mark.slow
def test_compare_runs_recorded_ranges_and_shows_the_error_on_each(walks, tmp_path, capsys):
    out = ["--json", str(tmp_path / "r.json"), "--figure", str(tmp_path / "f.png")]
    assert cli.main(["compare", "--ranges", str(walks), "--filters", "srckf,rsrckf,imm_srckf", *out]) == 0
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["settings"]["recordings"] == [(walks / name).as_posix() for name in "ab"]
    error = {name: of["rmse_of_runs"] for name, of in report["filters"].items()}
    assert error["rsrckf"][0] < error["rsrckf"][1] < 0.3 < error["srckf"][1]
    lines = capsys.readouterr().out.splitlines()
    assert lines[:4] == [
        "recorded-ranges: 2 of 2 recordings, up to 60 steps",
        "srckf: 0.10 m, no run diverged; best of the others: rsrckf, 0.01 m", f"1: {walks}/a", f"2: {walks}/b"
    ]  # fmt: skip
    (line,) = (line.split() for line in lines if line.startswith("srckf "))
    assert line[1:4] == [f"{x:.2f}" for x in (*error["srckf"], sum(error["srckf"]) / 2)]
    assert (tmp_path / "f.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_compare_takes_one_recording_in_files(walks, tmp_path):
    apart = tmp_path / "apart"
    apart.mkdir()
    (apart / "path.csv").write_bytes((walks / "b/path.csv").read_bytes())
    (apart / "anchors.csv").write_text("anchor,x,y,z\nA0,0,0,2\nA1,9,0,2\nA2,9,8,1\nA3,0,8,1\n")
    files = [str(walks / f"b/A{i}.csv") for i in range(4)]
    more = ["--anchors", str(apart / "anchors.csv"), "--reference", str(apart / "path.csv")]
    found = []
    for arguments in (
        [str(walks / "b")],
        [*files, *more],
        [*files, *more, "--height", "0.5"],
        [*files, *more, "--dt", ".2"],
    ):
        out = ["--json", str(tmp_path / "r.json"), "--figure", str(tmp_path / "f.png"), "--quiet"]
        assert cli.main(["compare", "--ranges", *arguments, "--filters", "rsrckf", *out]) == 0
        found.append(json.loads((tmp_path / "r.json").read_text())["filters"]["rsrckf"]["rmse_position"])
    assert found[0] == pytest.approx(found[1])
    assert found[0] == pytest.approx(found[2])
    assert (len(found[0]), len(found[3])) == (60, 30)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--runs", "3"], "runs: expected at most one for each of 2 recordings, received 3"),
        (["--reference", "{walks}/a/path.csv"], "reference: expected one recording beside it, received 2"),
        (["--anchors", "{walks}/a/path.csv"], "a/path.csv: expected rows with the columns anchor,x,y[,z]"),
        (["--q", "-1"], "q: expected"),
    ],
)
def test_what_does_not_go_with_recorded_ranges_is_refused(walks, capsys, options, said):
    assert cli.main(["compare", "--ranges", str(walks), *(o.format(walks=walks) for o in options)]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["compare"], "compare: expected one of files, --scenario and --ranges, received none\n"),
        (["compare", "--scenario", "nowhere"], "bearings-outliers"),
        (["compare", "--scenario", "bearings-outliers", "--filters", "kalman"], "received kalman"),
        (["compare", "--scenario", "bearings-outliers", "--outliers", "wild"], "'wild'"),
        (["compare", "--scenario", "adsb-turns", "--outliers", "std"], "adsb-turns takes no such option"),
        (["compare", "--scenario", "bearings-outliers", "--runs", "-1"], "runs: expected 1 or more, received -1\n"),
        (
            ["compare", "--scenario", "bearings-outliers", "--sensor", "bearings"],
            "sensor: expected beside files, received beside",
        ),
        (
            ["compare", "--scenario", "bearings-outliers", "--q", "0.25"],
            "q: expected beside files or --ranges, received beside",
        ),
        (
            ["compare", "--scenario", "bearings-outliers", "--dt", "5"],
            "dt: expected beside files or --ranges, received beside",
        ),
        (
            ["compare", "--scenario", "bearings-outliers", "--steps", "9"],
            "steps: expected beside files, received beside --scenario",
        ),
        (["compare", "--scenario", "growth", "--limit", "-1"], "limit: expected metres above 0, received -1.0\n"),
        (
            ["compare", "--scenario", "bearings-outliers", "--no-repair"],
            "repair: expected beside files, received beside --scenario",
        ),
        (["compare", "{file}", "--ranges", "{file}"], "received files and --ranges\n"),
        (
            ["compare", "--ranges", "{file}", "--outliers", "none"],
            "outliers: expected beside files or --scenario, received beside",
        ),
        (["compare", "{file}", "--anchors", "a.csv"], "anchors: expected beside --ranges, received beside files\n"),
        (["compare", "--ranges", "missing"], "error: file not found: missing\n"),
        (["compare", "--ranges", "{file}"], "expected ranges above 0 with their times, received none\n"),
        (["compare", "--ranges", "{file}", "."], "ranges: expected either folders or the files of one recording"),
        (["compare", "{file}", "--dt", "-1"], "dt: expected seconds above 0, received -1.0"),
        (["compare", "{file}", "--q", "-1"], "q: expected m^2/s^4 of 0 or more, received -1.0"),
        (["compare", "{file}", "missing.csv"], "error: file not found: missing.csv\n"),
        (["track", "missing.csv"], "error: file not found: missing.csv\n"),
        (["track", "{file}", "--filter", "kalman"], "kalman"),
        (["track", "{file}", "--sigma", "-3"], "error: sigma: expected metres above 0, received -3.0\n"),
        (["track", "{file}", "--q", "-1"], "error: q: expected m^2/s^3 of 0 or more, received -1.0\n"),
        (
            ["track", "{file}", "--bank", "kite"],
            "error: bank: expected one of person, ship, vehicle, aircraft, marine, animal, bird or a Bank,",
        ),
        (["track", "{file}", "--dt", "0"], "error: dt: expected seconds above 0, received 0.0\n"),
        (["track", "{file}", "--dt", "inf"], "error: dt: expected seconds above 0, received inf\n"),
        (["track", "{file}", "--out", "flight.csv"], "flight.csv: expected a file of its own, received the input"),
        (["track", "{file}", "--out", "."], "flight.csv: expected a file of its own, received the input {file}\n"),
        (["track", "{file}", "--out", "flight.csv/a"], "error: not a directory: flight.csv/a"),
        (["track", "{file}", "--out", "a.xlsx"], "out: expected a folder or a file ending in .csv, .parquet, .gpx"),
        (["track", "{file}", "--out", "a.gpx"], "out: maps need latitudes and longitudes, and "),
        (["track", "{file}", "--format", "kml"], "out: maps need latitudes and longitudes, and "),
        (["track", "{file}", "--out", "a.csv", "--format", "csv"], "format: expected a folder as --out, received the"),
        (["track", "{file}", "--html", "{file}"], "html: expected a file of its own, received the input {file}\n"),
        (["track", "."], "error: is a directory: .\n"),
    ],
)
def test_bad_arguments_are_answered_with_one_line_and_code_2(
    arguments, said, noisy_track, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    assert cli.main([a.format(file=noisy_track) for a in arguments]) == 2
    error = capsys.readouterr().err
    assert said.format(file=noisy_track) in error
    assert error.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_a_file_that_cannot_be_finished_leaves_the_old_one_as_it_was(tmp_path):
    from torchfra.running.atomic_write import write

    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError):
        write(path, lambda file: (_ for _ in ()).throw(RuntimeError()))
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.slow
def test_python_m_torchfra_is_the_command():
    done = subprocess.run([sys.executable, "-m", "torchfra", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("torchfra ")


@pytest.mark.slow
@pytest.mark.usefixtures("short_tracks")
def test_compare_takes_values_that_were_learned(tmp_path, capsys):
    scenario = make_scenario("bearings-outliers")
    f = presets.rsrckf(scenario.motion, scenario.sensor, threshold=0.5)
    torch.save(f.state_dict(), tmp_path / "learned.pt")
    arguments = ["compare", "--scenario", "bearings-outliers", "--runs", "5", "--filters", "rsrckf", "--quiet"]
    out = ["--json", str(tmp_path / "r.json"), "--figure", str(tmp_path / "f.png")]
    assert cli.main([*arguments, *out, "--learned", f"rsrckf={tmp_path / 'learned.pt'}"]) == 0
    filters = json.loads((tmp_path / "r.json").read_text())["filters"]
    expected = evaluate(scenario, {"f": f}, runs=5)["f"]["mean_rmse_position"]
    assert filters["learned"]["mean_rmse_position"] == pytest.approx(expected)
    assert filters["learned"]["mean_rmse_position"] != filters["rsrckf"]["mean_rmse_position"]
    torch.save(presets.rsrckf(scenario.motion, scenario.sensor, per_element=True).state_dict(), tmp_path / "two.pt")
    (tmp_path / "config.json").write_text(json.dumps({"filter": "rsrckf", "options": {"per_element": True}}))
    assert cli.main([*arguments, *out, "--learned", f"rsrckf={tmp_path / 'two.pt'}"]) == 0
    for wrong in (f"fra={tmp_path / 'learned.pt'}", f"kalman={tmp_path / 'learned.pt'}", str(tmp_path / "none.pt")):
        assert cli.main([*arguments, *out, "--learned", wrong]) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1
