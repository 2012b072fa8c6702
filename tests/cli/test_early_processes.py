"""Processes for a large file begin to import torch before this one does; no other call starts any."""

import argparse
import gc
import os
import subprocess
import sys

import pytest

from torchfra.cli import early, track_command


@pytest.fixture
def started(monkeypatch, tmp_path):
    """Modules for which processes were started, on two processors, in a folder with a large file and a small one."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "large.csv").write_text(" " * 1_000_001)
    (tmp_path / "small.csv").write_text(" ")
    modules = []
    monkeypatch.setattr(early, "prepare", modules.append)
    monkeypatch.setattr(early, "cores", lambda: 2)
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    return modules


@pytest.mark.parametrize("line", ["large.csv", "--quiet large.csv --out small.csv", "large.csv --jobs 3"])
def test_a_large_file_starts_them(started, line):
    early.start_processes(line.split())
    assert started == ["torchfra.cleaning.core"]


@pytest.mark.parametrize(
    "line",
    [
        "small.csv",
        "small.csv --out large.csv",
        "none.csv",
        "",
        "large.csv --jobs 1",
        "large.csv --jobs some",
        "large.csv --filter imm",
        "large.csv --out",
        "large.csv --sigma some",
        "large.csv --sigma -1",
        "large.csv --sgima 5",
        "large.csv large.csv",
        "large.csv --help",
    ],
)
def test_no_other_line_does(started, line):
    early.start_processes(line.split())
    assert not started


def test_all_options_of_the_command_are_known():
    command = argparse.ArgumentParser()
    track_command.add_to(command)
    known = {f"--{name}" for names in early.OPTIONS.values() for name in names.split()}
    assert known == {*command._option_string_actions} - {"-h", "--help"}


def test_no_process_of_several_does(started, monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    early.start_processes(["large.csv"])
    assert not started


@pytest.mark.skipif(sys.platform != "linux", reason="others import nothing ahead")
def test_ctrl_c_leaves_what_they_import_to_the_end_of_this_process(tmp_path):
    (tmp_path / "slow.py").write_text(
        "import pathlib, time\n"
        "pathlib.Path('begun').touch()\n"
        "while not pathlib.Path('pressed').exists(): time.sleep(0.01)\n"
        "pathlib.Path('done').touch()\n"
    )
    code = (
        "import os, pathlib, signal, time\n"
        "from torchfra.running.jobs import prepare\n"
        "signal.signal(signal.SIGINT, lambda *_: None)\n"
        "prepare('slow')\n"
        "while not pathlib.Path('begun').exists(): time.sleep(0.01)\n"
        "os.killpg(0, signal.SIGINT)\n"
        "pathlib.Path('pressed').touch()\n"
        "for _ in range(3000):\n"
        "    if pathlib.Path('done').exists(): break\n"
        "    time.sleep(0.01)\n"
    )
    paths = os.pathsep.join([str(tmp_path), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=os.environ | {"PYTHONPATH": paths}, capture_output=True,
        start_new_session=True, check=True,
    )  # fmt: skip
    assert (tmp_path / "done").exists()
    assert not done.stderr


def test_this_process_has_not_imported_torch_before():
    code = "import sys; from torchfra.cli import early; early.start_processes([]); sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_garbage_is_collected_after_an_import_as_before_it(monkeypatch):
    monkeypatch.delitem(sys.modules, "colorsys", raising=False)
    frozen = []
    monkeypatch.setattr(gc, "freeze", lambda: frozen.append(gc.isenabled()))
    assert early.imported("colorsys").__name__ == "colorsys"
    assert frozen == [False]
    assert gc.isenabled()
