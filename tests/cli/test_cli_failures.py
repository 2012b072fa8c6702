"""Whatever goes wrong is said in a line, stops nothing else, and shows in the exit status."""

import importlib
import io
import json
import os
import re
import stat
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import particles
import pytest
import reproduce
import torch
from papers import figures
from regrets.figures import ratios

from torchfra import plotting
from torchfra.cleaning import clean_tracks
from torchfra.cleaning import figures as of_tracks
from torchfra.cli import main as cli
from torchfra.cli import track_command
from torchfra.cli.command import exit_status, message
from torchfra.cli.plan import unused
from torchfra.running import home
from torchfra.tables import printable, text_table
from train import tune

ROOT = Path(__file__).parents[2]
TOLD = ["--sigma", "25", "--q", "1", "--bank", "aircraft"]
"""Nothing has to be found."""
COMPARE = ["compare", "--scenario", "bearings-outliers", "--filters", "srckf", "--no-compile"]
STRANGE = ["$", "$\\frac{$", "$$", "$x^2$", "\\frac", "$\\nothing$", "\x1b[2J\x1b[H", "\x1b]0;title\x07", "a\rb",
           "a\nb", "\x00x", "a" * 5000, "\u00e9" * 200, "\u4e2d\u6587" * 60, "\ud800", "a\udfffb", "\u202eabc",
           "\U0001f680", "../../x", "/etc/x", "..", ".", "-rf", "%s%n{}", "_hidden", "CON", "nul.txt"]  # fmt: skip


def rows(name, north=0.0, last=None):
    """A straight flight of ten fixes."""
    times = [1_714_730_400_000 + 1000 * k for k in range(10)]
    times[-1] += 0 if last is None else last
    return [{"timestamp": t, "latitude": 48 + north + 1e-3 * k, "longitude": 2.0, "altitude": 3000, "icao24": name}
            for k, t in enumerate(times)]  # fmt: skip


def track_them(tmp_path, flights, *options):
    """The exit status of ``torchfra track`` on these flights, with results in ``out`` and ``s.json``."""
    (tmp_path / "f.json").write_text(json.dumps(flights))
    out = ["--out", str(tmp_path / "out"), "--json", str(tmp_path / "s.json")]
    return cli.main(["track", str(tmp_path / "f.json"), "--filter", "srckf", *TOLD, *out, *options])


# ---------------------------------------------------------------- names


def test_strange_names_are_harmless(tmp_path, capsys):
    names = [*STRANGE, "plain"]
    flights = [row for i, name in enumerate(names) for row in rows(name, 0.1 * i)]
    assert track_them(tmp_path, flights, "--no-plots") == 0
    said, errors = capsys.readouterr()
    assert len(re.findall(r" 10 +9 s ", said)) == len(names)
    assert errors == ""
    assert all(line.isprintable() and len(line) < 600 for line in said.splitlines())
    said.encode()
    files = [path.relative_to(tmp_path / "out") for path in (tmp_path / "out").rglob("*")]
    assert len(files) == 2 * len(names)
    assert all(path.parent == Path() and not path.name.startswith(".") for path in files)
    assert not [path for path in files if path.name.split(".")[0] in ("con", "nul")]  # devices on Windows
    assert {"".join(path.suffixes[-2:]) for path in files} >= {".csv", ".meta.json"}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["f.json", "out", "s.json"]
    assert {track["name"] for track in json.loads((tmp_path / "s.json").read_text())["tracks"]} >= {"$", "\ud800"}


def pictures(name):
    """Makes one picture or another, each with the name wherever it can be."""
    yield lambda: figures.rmse_curves({name: {"rmse_position": [1.0, 2.0]}}, "position", 1.0, name)
    yield lambda: ratios({name: ([name], [[1.5]])}, [name], name)
    yield lambda: plotting.learning_curve([{"iteration": 1, "loss": 1.0, name: 2.0}], {name: 1.0}, name)
    yield lambda: plotting.tracks(torch.zeros(3, 2), {name: torch.ones(3, 2)}, name)
    yield lambda: figures.probabilities({name: np.ones((3, 1))}, [name], 0.0, 1.0, name)


@pytest.mark.slow
@pytest.mark.usefixtures("rough_figures")
def test_a_strange_name_is_harmless_in_every_picture(tmp_path):
    for i, name in enumerate(["$\\frac{$" + "\u4e2d" * 99, "_hidden"] * 5):
        make = list(pictures(name))[i % 5]
        assert plotting.save(make(), tmp_path / "p.png").stat().st_size > 1000
    assert track_them(tmp_path, rows("$\\frac{$") + rows("$$\ud800", 0.1)) == 0
    assert len(list((tmp_path / "out").glob("*.png"))) == 2


def test_a_name_is_shown_as_it_is_where_that_does_no_harm():
    assert printable("KLM 1023 \u00e9\u4e2d") == "KLM 1023 \u00e9\u4e2d"
    assert printable("a\x1b[2J\n\ud800") == "a\\x1b[2J\\n\\ud800"
    assert printable("abcdefghij", 7) == "ab...ij"
    assert text_table(["a"], [["\x1b[2J"]]) == "a\n\\x1b[2J"


def test_names_that_are_the_same_where_case_does_not_count_have_files_of_their_own():
    used = set()
    assert [unused(name, used) for name in ("Ab", "aB", "ab", "x/y")] == ["Ab", "aB-2", "ab-3", "x_y"]


def test_an_escape_sequence_in_an_error_does_not_reach_the_terminal(tmp_path, capsys):
    (tmp_path / "f.csv").write_text("\x1b[2J,\x1b]0;x\x07\n1,2\n")
    assert cli.main(["track", str(tmp_path / "f.csv"), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert "\\x1b[2J" in said
    assert said.removesuffix("\n").isprintable()


def test_a_title_of_a_run_is_harmless(tmp_path, capsys):
    small = ["iterations=1", "batch=2", "validation_runs=2", "compile=false"]
    assert tune.main(["noise", *small, "name=$\\frac{$\x1b[2J", "--out", str(tmp_path)]) == 0
    assert (tmp_path / "learning.png").read_bytes().startswith(b"\x89PNG")
    assert "\x1b" not in capsys.readouterr().out


# ---------------------------------------------------------------- one of several


@pytest.mark.slow
@pytest.mark.usefixtures("rough_figures")
def test_one_target_that_cannot_be_filtered_does_not_stop_the_others(tmp_path, capsys):
    flights = rows("good") + rows("late", 0.1, last=2 * 10**10) + rows("other", 0.2)
    assert track_them(tmp_path, flights, "--dt", "1") == 1
    said, errors = capsys.readouterr()
    assert errors.startswith(
        "torchfra: error: late: dt: expected at most 10,000,000 steps, received 1.0 s in a track of"
    )
    assert errors.count("\n") == 1
    assert [line.split()[0] for line in said.splitlines() if line.startswith(("good", "late", "other"))] == [
        "good",
        "other",
    ]
    assert [track["name"] for track in json.loads((tmp_path / "s.json").read_text())["tracks"]] == ["good", "other"]
    assert track_them(tmp_path, rows("late", last=2 * 10**10), "--dt", "1") == 2


@pytest.mark.usefixtures("rough_figures")
def test_one_target_that_cannot_be_drawn_does_not_stop_the_others(tmp_path, capsys, monkeypatch):
    draw = of_tracks.cleaned

    def fail(cleaned):
        if cleaned.recording.name == "bad":
            raise IndexError("no such line")
        return draw(cleaned)

    monkeypatch.setattr(of_tracks, "cleaned", fail)
    assert track_them(tmp_path, rows("bad") + rows("good", 0.1)) == 1
    said, errors = capsys.readouterr()
    assert errors == "torchfra: error: bad: IndexError: no such line\n"
    assert [line.split()[0] for line in said.splitlines() if line.startswith(("bad", "good"))] == ["bad", "good"]
    pictures = {path.name for path in (tmp_path / "out").glob("*.png")}
    assert pictures == {"good.png"}
    assert len(list((tmp_path / "out").glob("*.csv"))) == 2


# ---------------------------------------------------------------- not finite


def spoiled(run):
    """The same filters, with estimates of the first track that are NaN at the end."""

    def spoil(*arguments, **options):
        estimate = run(*arguments, **options)
        mean = estimate.mean.clone()
        mean[0, -1] = torch.nan
        return estimate._replace(mean=mean)

    return spoil


@pytest.fixture
def clean_badly(monkeypatch):
    """Cleaning fails at the last steps of targets that are called bad."""

    def replaced(steps):
        def clean(recordings, **settings):
            for result in clean_tracks(recordings, **settings):
                mean = result.mean.copy()
                mean[-steps if result.recording.name == "bad" else len(mean) :] = np.nan
                yield replace(result, mean=mean)

        monkeypatch.setattr(track_command, "clean_tracks", clean)

    return replaced


@pytest.mark.slow
@pytest.mark.usefixtures("rough_figures")
def test_an_estimate_of_a_recording_that_is_not_finite_is_said_and_shows_in_the_exit_status(
    tmp_path, capsys, clean_badly
):
    clean_badly(steps=1)
    for options in ([], ["--quiet"]):
        assert track_them(tmp_path, rows("bad") + rows("good", 0.1), *options) == 1
        assert capsys.readouterr().err == "torchfra: error: bad: NaN or infinity in 1 of 10 steps\n"
    failed = {track["name"]: track["failed"] for track in json.loads((tmp_path / "s.json").read_text())["tracks"]}
    assert failed == {"bad": True, "good": False}


@pytest.mark.usefixtures("rough_figures")
def test_a_recording_without_any_finite_estimate_gives_no_warning(tmp_path, capsys, clean_badly):
    clean_badly(steps=10)
    assert track_them(tmp_path, rows("bad")) == 1
    assert capsys.readouterr().err == "torchfra: error: bad: NaN or infinity in 10 of 10 steps\n"


@pytest.mark.usefixtures("rough_figures", "short_tracks")
def test_a_filter_whose_result_is_not_finite_is_said_and_shows_in_the_exit_status(tmp_path, capsys, monkeypatch):
    from torchfra.evaluation import runs

    monkeypatch.setattr(runs, "run", spoiled(runs.run))
    arguments = [*COMPARE, "--runs", "3", "--figure", str(tmp_path / "f.png"), "--json", str(tmp_path / "r.json")]
    assert cli.main([*arguments, "--quiet"]) == 1
    assert capsys.readouterr().err == "torchfra: error: srckf: not finite in 1 run\n"
    assert json.loads((tmp_path / "r.json").read_text())["filters"]["srckf"]["failed"] == 1
    assert (tmp_path / "f.png").exists()
    assert reproduce.main(["bearings-outliers", "--runs", "3", "--filters", "srckf"]) == 1
    said, errors = capsys.readouterr()
    assert "inf" in said
    assert errors == "reproduce: error: srckf: not finite in 1 run\n"


def test_an_infinite_number_in_a_summary_of_an_experiment_is_found():
    summary = {
        "by_size": {"2": {"ukf": {"mse": [1.0, float("inf"), float("-inf")], "mmse": float("nan")}}},
        "n": [1, "inf"],
    }
    assert list(reproduce.infinite(summary)) == ["by_size 2 ukf mse"]


def test_an_error_of_the_particles_that_is_not_finite_shows_in_the_exit_status(monkeypatch, capsys):
    of = {"gpb": 1.0, "lagged": 1.0, "particles": float("nan")}
    monkeypatch.setattr(particles, "cells", lambda runs, seed: {"a": (), "b": ()})
    monkeypatch.setattr(particles, "compare", lambda *cell, progress: of)
    assert particles.main(["--runs", "1", "--quiet"]) == 1
    assert capsys.readouterr().err.splitlines() == [
        f"particles: error: {cell}: an error that is not finite" for cell in "ab"
    ]


@pytest.mark.usefixtures("rough_figures")
def test_a_run_without_a_finite_validation_says_that_it_learned_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(tune.Training, "validation", lambda training: torch.tensor(torch.inf).double())
    small = ["iterations=1", "batch=2", "validation_runs=2", "compile=false", "--quiet"]
    assert tune.main(["noise", *small, "--out", str(tmp_path)]) == 1
    assert capsys.readouterr().err == (
        "train: error: no validation was finite: state_dict.pt has the values of the start\n"
    )
    assert (tmp_path / "results.json").exists()


# ---------------------------------------------------------------- too much, too little


@pytest.mark.parametrize("runs", [10**10, 10**19, 10**30])
def test_an_absurd_number_of_runs_is_refused(runs, tmp_path, capsys):
    arguments = [*COMPARE, "--figure", str(tmp_path / "f.png"), "--runs", str(runs)]
    assert cli.main(arguments) == 2
    assert "runs: expected at most 1,000,000,000, " in capsys.readouterr().err
    for key in ("batch", "iterations", "validation_runs", "test_runs", "seed"):
        assert tune.main(["noise", f"{key}={runs}", "--out", str(tmp_path / "x")]) == 2
        assert f"{key}: expected at most 1,000,000,000, received {runs:,}\n" in capsys.readouterr().err


@pytest.mark.parametrize("too_much", [lambda: torch.zeros(10**15), lambda: np.zeros(10**15)])
def test_too_little_memory_is_said_in_a_line(too_much, capsys):
    assert exit_status("program", too_much) == 2
    said = capsys.readouterr().err
    assert said.startswith("program: error: not enough memory: ")
    assert said.count("\n") == 1


def test_a_mistake_in_the_program_itself_keeps_its_traceback():
    assert message(RuntimeError("size mismatch")) is None
    with pytest.raises(KeyError):
        exit_status("program", lambda: {}["a"])


def test_compiling_what_has_no_kernel_is_said_in_a_line(tmp_path, capsys):
    own = tmp_path / "own.py"  # scans that are larger than those of which all events are summed
    own.write_text("import torchfra\n\n\ndef crowd():\n    return torchfra.scenarios.clutter_straight(clutter=12)\n")
    arguments = ["compare", "--scenario", f"{own}:crowd", "--filters", "ukf_jpda", "--runs", "1", "--compile"]
    assert cli.main([*arguments, "--figure", str(tmp_path / "f.png")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_without_a_home_a_temporary_one_is_made(monkeypatch):
    def unknown(cls):
        if "HOME" in os.environ:
            return Path(os.environ["HOME"])
        raise RuntimeError("Could not determine home directory.")

    assert home.known()
    monkeypatch.setattr(Path, "home", classmethod(unknown))
    monkeypatch.delenv("HOME")
    assert not home.known()
    importlib.reload(home)
    assert home.known()
    assert stat.S_IMODE(Path.home().stat().st_mode) == 0o700
    home.shutil.rmtree(Path.home())


@pytest.mark.parametrize("option", ["figure", "print"])
def test_a_figure_in_no_known_form_is_refused_before_any_work(option, monkeypatch, capsys):
    monkeypatch.setattr("torchfra.cli.compare_command.scenario_of", None)
    assert cli.main([*COMPARE, f"--{option}", "x.docx"]) == 2
    assert f"{option}: expected a file that ends in .pdf, .svg, .png, received x.docx" in capsys.readouterr().err


# ---------------------------------------------------------------- endings


def test_ctrl_c_ends_quietly(tmp_path, monkeypatch, capsys):
    def interrupted(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr("torchfra.evaluation.runs.run", interrupted)
    assert cli.main([*COMPARE, "--runs", "2", "--figure", str(tmp_path / "f.png")]) == 130
    assert capsys.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_closed_pipe_ends_quietly(tmp_path):
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "torchfra", *COMPARE, "--runs", "2", "--figure", str(tmp_path / "f.png")]
    with os.fdopen(write, "wb") as closed:
        done = subprocess.run(command, cwd=ROOT, stdout=closed, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (141, "")


def test_output_on_a_full_disk_is_an_error_in_a_line(monkeypatch, capsys):
    with Path("/dev/full").open("w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert exit_status("program", lambda: print("a table")) == 2
    assert capsys.readouterr().err == "program: error: no space left on device\n"


def test_without_standard_output_an_error_is_still_a_line(monkeypatch, capsys):
    monkeypatch.setattr(sys, "stdout", None)
    assert cli.main(["compare"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_letters_that_a_terminal_does_not_have_are_escaped(monkeypatch):
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, "ascii"))
    assert exit_status("program", lambda: print("\u00e9 \ud800")) == 0
    assert written.getvalue() == b"\\xe9 \\ud800\n"
