"""A filter written as C++ gives, without torch, the numbers that it gives in Python."""

import re
import shutil
import subprocess

import export
import pytest
import torch

from torchfra import presets
from torchfra.compiler import export as exported
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position
from torchfra.types import CompileError

needs_gcc = pytest.mark.skipif(shutil.which("g++") is None, reason="there is no g++")
NAMES = ["CMakeLists.txt", "example.cpp", "filter.cpp", "filter.hpp"]


def small():
    return presets.srckf(ConstantVelocity(0.1), Position(2.0))


@needs_gcc
@pytest.mark.slow
@pytest.mark.parametrize(("arguments", "tolerance"), [
    (["--filter", "srckf", "--inputs", "noise"], 1e-12),
    (["--filter", "fra", "--inputs", "std"], 1e-12),
    (["--filter", "alphabeta", "--scenario", "alpha-beta"], 1e-11),  # has no belief among what it remembers
    (["--filter", "rsrckf", "--precision", "single"], 1e-2),
])  # fmt: skip
def test_an_exported_step_gives_what_the_filter_gives(arguments, tolerance, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("CXXFLAGS", "-O0")
    folder = tmp_path / "new" / "folder"
    assert export.main([*arguments, "--tracks", "3", "--out", str(folder)]) == 0
    said = re.search(r"(\d+) steps, [\d.]+ us each, .* difference from the filter ([\d.e+-]+)", capsys.readouterr().out)
    assert int(said[1]) >= 300
    assert float(said[2]) < tolerance
    name = arguments[1]
    assert sorted(path.name for path in folder.iterdir()) == sorted(
        ["CMakeLists.txt", "example.cpp", f"{name}.cpp", f"{name}.hpp"]
    )


@needs_gcc
@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cmake") is None, reason="there is no cmake")
def test_cmake_builds_the_files_and_the_program_runs(tmp_path):
    for name, text in exported.export(small()).items():
        (tmp_path / name).write_text(text)
    for command in (["cmake", "-S", ".", "-B", "build"], ["cmake", "--build", "build"]):
        subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    text = "1  0 0 1 0  1 0 0 0  0 1 0 0  0 0 1 0  0 0 0 1  nan 2 0.5\n"  # one step of half a second, x is missing
    done = subprocess.run([tmp_path / "build" / "example"], input=text, capture_output=True, text=True, check=True)
    numbers = [float(x) for x in done.stdout.split()]
    assert len(numbers) == 4 + 16 + 2
    assert numbers[0] == pytest.approx(0.5)  # where its speed has carried it
    assert 0 < numbers[1] < 2


@needs_gcc
@pytest.mark.slow
def test_the_example_says_what_is_wrong_with_its_input_and_fast_math_is_refused(tmp_path):
    for name, text in exported.export(small(), inputs="std").items():
        (tmp_path / name).write_text(text)
    build = ["g++", "-std=c++17", "filter.cpp", "example.cpp", "-o", "example"]
    subprocess.run(build, cwd=tmp_path, check=True)
    for text, said in (
        ("hello", "tracks of numbers"),
        ("", "tracks of numbers"),
        ("-3", "received -3"),
        ("2 0 0", "ends"),
    ):
        done = subprocess.run([tmp_path / "example"], input=text, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stdout) == (1, "")
        assert said in done.stderr
    done = subprocess.run([*build, "-ffast-math"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "build without it" in done.stderr


def test_the_header_says_what_the_filter_is_and_needs_nothing_else():
    files = exported.export(small(), "tracker", inputs=("std",), dtype=torch.float32)
    assert sorted(files) == ["CMakeLists.txt", "example.cpp", "tracker.cpp", "tracker.hpp"]
    header = files["tracker.hpp"]
    for line in ("using Scalar = float;", "(motion): ConstantVelocity(", " Scalar std[2];", " Scalar belief_mean[4];"):
        assert line in header
    included = set(re.findall(r"#include (.*)", files["tracker.cpp"]))
    assert included == {'"tracker.hpp"', "<math.h>", "<cstdint>"}
    assert sorted(exported.export(small())) == NAMES


def test_a_filter_that_learns_keeps_its_parameters():
    f = presets.srckf(ConstantVelocity(0.1), Position(2.0), learn=("q",))
    exported.export(f)
    assert f.motion.q.raw.requires_grad


@pytest.mark.parametrize(("arguments", "said"), [
    ({"name": "Two words"}, "name: expected small letters"),
    ({"name": 3}, "name: expected small letters"),
    ({"name": "class"}, "name: expected one that C"),
    ({"name": "example"}, "name: expected one that C"),
    ({"f": "srckf"}, "filter: expected one of single tracks, received str"),
    ({"u": -1}, "u: expected a whole number"),
    ({"inputs": ("sigma",)}, "inputs: expected one of"),
    ({"inputs": ("std", "noise")}, "inputs: expected at most one"),
    ({"dtype": torch.float16}, "dtype: expected float32 or float64"),
])  # fmt: skip
def test_bad_arguments_are_named_before_any_work(arguments, said, monkeypatch):
    monkeypatch.setattr(exported, "Step", None)
    with pytest.raises(ValueError, match=said):
        exported.export(**{"f": small()} | arguments)


def test_filters_without_a_step_of_one_track_are_refused(crossing):
    many = presets.srckf(ConstantVelocity(torch.tensor([0.1, 0.2])), Position(2.0))
    with pytest.raises(ValueError, match=r"one value of each hyperparameter, received a batch of motion\.q"):
        exported.export(many)
    with pytest.raises(ValueError, match="one of single tracks, received JPDA"):
        exported.export(presets.ukf_jpda(crossing.motion, crossing.sensor, clutter=crossing.clutter))


@needs_gcc
def test_a_folder_that_cannot_be_and_a_compiler_that_fails_are_named(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").touch()
    monkeypatch.setattr(export, "export", None)
    assert export.main(["--out", str(tmp_path / "file")]) == 2
    assert "out: expected a folder, received the file" in capsys.readouterr().err
    monkeypatch.undo()
    monkeypatch.setenv("CXXFLAGS", "--no-such-flag")
    with pytest.raises(CompileError, match="no-such-flag"):
        export.compiled(exported.export(small()), "filter", tmp_path)
