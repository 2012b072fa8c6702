"""Outputs go where they are told to, whole or not at all, and what cannot be written is found before any work."""

import errno
import json
import os
import resource
import signal
import stat
import subprocess
import sys
import threading
from pathlib import Path

import benchmark
import particles
import pytest
import regret
import reproduce
import time_stamps

from torchfra.cli import main as cli
from torchfra.running import atomic_write
from torchfra.running.atomic_write import check, write, write_json, write_text
from train import tune

pytestmark = pytest.mark.usefixtures("rough_figures")

COMPARE = ["compare", "--scenario", "bearings-outliers", "--filters", "srckf", "--runs", "2", "--no-compile"]


def device(folder):
    """What /dev/null is."""
    path = folder / "null"
    try:
        os.mknod(path, 0o666 | stat.S_IFCHR, os.makedev(1, 3))
    except PermissionError:
        pytest.skip("needs the right to make devices")
    return path


# ---------------------------------------------------------------- what is there stays what it is


def test_a_pipe_is_written_to(tmp_path):
    path, got = tmp_path / "pipe", []
    os.mkfifo(path)
    reader = threading.Thread(target=lambda: got.append(path.read_bytes()), daemon=True)
    reader.start()
    check(path)
    write_json(path, {"a": 1})
    reader.join(60)
    assert stat.S_ISFIFO(path.stat().st_mode)
    assert json.loads(got[0]) == {"a": 1}


@pytest.mark.slow
def test_a_device_stays_a_device(tmp_path):
    path = device(tmp_path)
    (tmp_path / "link").symlink_to("null")
    for place in (path, tmp_path / "link"):
        check(place)
        write_text(place, "gone")
    assert stat.S_ISCHR(path.stat().st_mode)
    assert (tmp_path / "link").is_symlink()
    assert cli.main([*COMPARE, "--quiet", "--json", str(path), "--figure", str(tmp_path / "link")]) == 0
    assert stat.S_ISCHR(path.stat().st_mode)


@pytest.mark.parametrize("old", ["old", None])
def test_what_a_link_points_to_is_replaced_and_the_link_stays(old, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    target = tmp_path / "elsewhere" / "real"
    if old is not None:
        target.write_text(old)
    (tmp_path / "second").symlink_to("elsewhere/real")
    (tmp_path / "first").symlink_to("second")
    write_text(tmp_path / "first", "new")
    assert target.read_text() == "new"
    assert not target.is_symlink()
    assert (tmp_path / "first").readlink() == Path("second")
    assert sorted(path.name for path in target.parent.iterdir()) == ["real"]


_ALONE = """
import importlib.util, os, signal, sys
spec = importlib.util.spec_from_file_location("atomic_write", sys.argv[1])
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
"""
"""Loads the module without torch, which takes seconds."""


def alone(code, *arguments, **options):
    """A process of its own that knows the module."""
    command = [sys.executable, "-c", _ALONE + code, atomic_write.__file__, *map(str, arguments)]
    return subprocess.run(command, check=False, timeout=60, **options)


def test_the_file_behind_standard_output_gets_all_that_is_printed_and_written(tmp_path):
    code = "print(1); module.check('/dev/stdout'); module.write_json('/dev/stdout', {}); print(2)"
    with (tmp_path / "log").open("w") as log:
        assert alone(code, stdout=log).returncode == 0
    assert (tmp_path / "log").read_text() == "1\n{}\n2\n"
    assert alone(code, stdout=subprocess.PIPE).stdout == b"1\n{}\n2\n"


# ---------------------------------------------------------------- whole or not at all


@pytest.fixture
def full_disk(monkeypatch):
    """There is no room when a file is finished."""

    def fsync(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(atomic_write.os, "fsync", fsync)


def test_a_full_disk_leaves_the_old_file_and_no_other_and_the_error_names_it(tmp_path, full_disk):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(OSError, match=r"No space left on device: '.*/a\.txt'"):
        write_text(path, "new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_larger_than_allowed_leaves_the_old_one(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(OSError, match=r"File too large: '.*/a\.txt'"):
            write_text(path, "new" * 1000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_what_a_killed_write_has_left_is_gone_after_the_next(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    half = "lambda file: (file.write(b'half'), file.flush(), os.kill(os.getpid(), signal.SIGKILL))"
    assert alone(f"module.write(sys.argv[2], {half})", path).returncode == -signal.SIGKILL
    assert path.read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 2
    write_text(path, "new")
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o664, 0o755])
def test_a_file_that_is_replaced_keeps_its_permissions_from_the_first_byte_on(mode, tmp_path):
    path, seen = tmp_path / "a.txt", []
    path.write_text("old")
    path.chmod(mode)
    write(path, lambda file: (seen.append(os.fstat(file.fileno()).st_mode), file.write(b"new")))
    assert path.read_text() == "new"
    assert [stat.S_IMODE(x) for x in (*seen, path.stat().st_mode)] == [mode, mode]


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root gives files away")
def test_a_file_that_root_replaces_stays_that_of_its_owner(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    os.chown(path, 1234, 4321)
    write_text(path, "new")
    assert (path.stat().st_uid, path.stat().st_gid) == (1234, 4321)


def test_of_two_that_write_the_same_file_one_waits_for_the_other(tmp_path):
    path, begun, seen = tmp_path / "a.txt", threading.Event(), []

    def slowly(file):
        begun.set()
        seen.append(second.is_alive())
        file.write(b"first")

    second = threading.Thread(target=lambda: (begun.wait(), write_text(path, "second")))
    second.start()
    write(path, slowly)
    second.join()
    assert seen == [True]
    assert path.read_text() == "second"
    assert list(tmp_path.iterdir()) == [path]


# ---------------------------------------------------------------- before any work


def a_folder(folder):
    (folder / "there").mkdir()
    return folder / "there"


def a_link_to_a_folder(folder):
    (folder / "link").symlink_to(a_folder(folder))
    return folder / "link"


def below_a_file(folder):
    (folder / "file").write_text("")
    return folder / "file" / "r"


def a_circle(folder):
    (folder / "a").symlink_to("b")
    (folder / "b").symlink_to("a")
    return folder / "a"


WRONG = {
    a_folder: "is a directory: ",
    a_link_to_a_folder: "is a directory: ",
    below_a_file: "not a directory: ",
    a_circle: "too many levels of symbolic links: ",
    lambda folder: folder / ("x" * 300): "file name too long: ",
    lambda folder: folder / "new" / ("x" * 300): "file name too long: ",
    lambda folder: Path("/proc/nothing/r"): "/proc/nothing/r",
}


@pytest.mark.parametrize("make", WRONG)
def test_an_output_that_cannot_be_written_is_found_before_any_work(make, tmp_path, monkeypatch, capsys):
    def work(*arguments, **options):
        raise AssertionError("there was work")

    for module in ("torchfra.cli.compare_command.scenario_of", "torchfra.readers.read", "time_stamps.read",
                   "regret.chosen_cells", "particles.cells", "reproduce.evaluate",
                   "train.tune.Training"):  # fmt: skip
        monkeypatch.setattr(module, work)
    monkeypatch.setattr(benchmark, "KINDS", dict.fromkeys(benchmark.KINDS, work))
    path = str(make(tmp_path))
    before = sorted(tmp_path.rglob("*"))
    for main, arguments in (
        (cli.main, [*COMPARE, "--json", path]),
        (cli.main, [*COMPARE, "--figure", path]),
        (cli.main, ["track", "flight.csv", "--json", path]),
        (time_stamps.main, ["flight.csv", "--json", path]),
        (regret.main, ["--json", path]),
        (regret.main, ["--figure", path]),
        (particles.main, ["--json", path]),
        (reproduce.main, ["growth", "--json", path]),
        (benchmark.main, ["--json", path]),
        (benchmark.main, ["--what", "scaling", "--figure", path]),
    ):
        assert main(arguments) == 2, (main, arguments)
        said = capsys.readouterr().err
        assert WRONG[make] in said
        assert said.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("name", ["checkpoint.pt", "config.json", "log.csv", "results.json", "learning.png"])
def test_a_run_finds_before_it_begins_that_a_file_cannot_be_written(name, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(tune, "Training", None)
    (tmp_path / name).mkdir()
    assert tune.main(["noise", "--out", str(tmp_path), "--resume"]) == 2
    assert f"is a directory: {tmp_path / name}\n" in capsys.readouterr().err


def test_one_target_whose_table_cannot_be_written_is_found_before_any_work(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("torchfra.cli.track_command.clean_tracks", None)
    (tmp_path / "flight.csv").write_text("t,x,y\n0,0,0\n1,1,1\n")
    for ending in ("csv", "meta.json", "png"):
        out = tmp_path / ending
        (out / f"flight.{ending}").mkdir(parents=True)
        assert cli.main(["track", str(tmp_path / "flight.csv"), "--out", str(out)]) == 2
        assert f"is a directory: {out}/flight.{ending}\n" in capsys.readouterr().err


def test_no_output_replaces_an_input_or_another_output(tmp_path, capsys):
    flight = tmp_path / "flight.csv"
    flight.write_text("t,x,y\n0,0,0\n1,1,1\n")
    (tmp_path / "link").symlink_to("flight.csv")
    learned = tmp_path / "learned.png"
    learned.write_text("{}")
    for main, arguments in (
        (cli.main, ["track", str(flight), "--json", str(tmp_path / "link")]),
        (cli.main, ["compare", str(flight), "--json", str(flight)]),
        (cli.main, [*COMPARE, "--learned", str(learned), "--figure", str(learned)]),
        (time_stamps.main, [str(flight), "--json", str(flight)]),
    ):
        assert main(arguments) == 2
        given = learned if str(learned) in arguments else flight
        assert f"expected a file of its own, received the input {given}\n" in capsys.readouterr().err
    assert flight.read_text().startswith("t,x,y")
    assert learned.read_text() == "{}"
    same = str(tmp_path / "same.png")
    assert cli.main([*COMPARE, "--json", same, "--figure", same]) == 2
    assert f"figure: expected a file of its own, received {same}, as for json\n" in capsys.readouterr().err


# ---------------------------------------------------------------- the table in any case


@pytest.mark.slow
@pytest.mark.usefixtures("short_tracks")
@pytest.mark.parametrize(("main", "arguments"), [
    (cli.main, [*COMPARE, "--figure", "{out}/f.png"]),
    (reproduce.main, ["growth", "--runs", "2", "--filters", "ghckf", "--sizes", "1", "--plots", "{out}"]),
    (regret.main, ["--filters", "srckf", "--cells", "1-good-none", "--runs", "2", "--figure", "{out}/f.png"]),
])  # fmt: skip
def test_the_table_is_printed_and_the_other_files_tried_if_one_cannot_be_written(
    main, arguments, tmp_path, full_disk, capsys
):
    assert main([a.format(out=tmp_path) for a in arguments] + ["--json", str(tmp_path / "r.json")]) == 1
    said, errors = capsys.readouterr()
    assert "srckf" in said or "ghckf" in said
    assert f"json: no space left on device: {tmp_path}/r.json\n" in errors
    assert errors.count("no space left on device") == errors.count("\n") >= 2
    assert list(tmp_path.iterdir()) == []
