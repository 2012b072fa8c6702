"""A kernel is kept for one user alone, found again undamaged or made anew, and nothing is left of what was killed."""

import errno
import os
import shlex
import signal
import stat
import subprocess
import sys
import time
import warnings
from ctypes import addressof, c_int64
from pathlib import Path

import pytest

from torchfra.compiler import build, cache, workplace
from torchfra.compiler.build import CompileError
from torchfra.evaluation.compiling import compiled

SOURCE = """
#include <cstdint>
extern "C" void run(int64_t n, int64_t, int, const void*, void* out) { *(int64_t*)out = n + NUMBER; }
"""
HOSTILE = 'extern "C" void run() {} __attribute__((constructor)) void f() { __builtin_trap(); }'
LOADED = """
import importlib.util, os, sys
spec = importlib.util.spec_from_file_location("module", sys.argv[1])
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
"""
"""Loads one module of the package from its file: without torch, in a moment."""


def answer(number=40):
    """What a small kernel computes: ``number + 2``."""
    out = c_int64()
    build.load(SOURCE.replace("NUMBER", str(number)))(2, 0, 0, None, addressof(out))
    return out.value


def only(folder):
    """The one library that is kept."""
    (library,) = folder.iterdir()
    return library


def exchange(library, content):
    """Another file of the name: to cut off the one that this process runs would end it, whatever is checked."""
    other = library.with_name("other")
    other.write_bytes(content)
    other.chmod(0o600)
    other.replace(library)


def fetched(name, before="", *arguments):
    """Whether another process, which has loaded nothing yet, finds a kernel; and what it says."""
    code = f"{LOADED}{before}\nprint(module.fetch(sys.argv[2]) is not None)"
    command = [sys.executable, "-c", code, cache.__file__, name, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True)  # a library that is hostile ends it
    return done.stdout == "True\n", done.stderr


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A cache of its own, and a folder for temporary files beside it; nothing else in either."""
    monkeypatch.setenv("TORCHFRA_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("CXXFLAGS", "-O0")
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    monkeypatch.setattr(cache, "_unkept", {})
    return tmp_path / "cache"


@pytest.fixture
def hostile(tmp_path):
    """A library that ends whoever loads it."""
    path = tmp_path / "hostile.so"
    command = ["g++", "-x", "c++", "-", "-shared", "-fPIC", "-o", str(path)]
    subprocess.run(command, input=HOSTILE, text=True, check=True)
    return path.read_bytes()


def compilations(work):
    """How often the compiler is called."""
    before = build.compiled
    work()
    return build.compiled - before


# ---------------------------------------------------------------- one user alone


def test_a_kernel_is_kept_for_its_user_alone_and_compiled_once(folder):
    previous = os.umask(0)
    try:
        assert compilations(answer) == 1
    finally:
        os.umask(previous)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert stat.S_IMODE(only(folder).stat().st_mode) == 0o600
    assert compilations(answer) == 0
    assert answer() == 42


def test_a_hostile_library_would_be_seen(folder, hostile):
    """Were it signed, it would be loaded: the next tests can fail."""
    answer()
    name = only(folder).name
    exchange(only(folder), hostile + cache._digest(name, hostile))
    with pytest.raises(subprocess.CalledProcessError):
        fetched(name)


@pytest.mark.parametrize("mode", [0o777, 0o1777, 0o775, 0o702])
def test_a_folder_to_which_others_may_write_is_not_used(mode, folder, hostile):
    answer()
    name = only(folder).name
    exchange(only(folder), signed := hostile + cache._digest(name, hostile))
    folder.chmod(mode)
    found, said = fetched(name)
    assert not found
    assert f"TORCHFRA_CACHE: expected a folder that you alone can write to, received {folder} (other users" in said
    with pytest.warns(RuntimeWarning, match="other users may write to it, which chmod go-w ends"):
        assert answer() == 42
    assert only(folder).read_bytes() == signed


def test_a_folder_of_another_user_is_not_used(folder, hostile, monkeypatch):
    answer()
    name = only(folder).name
    exchange(only(folder), hostile + cache._digest(name, hostile))
    found, said = fetched(name, "owner = os.geteuid(); os.geteuid = lambda: owner + 1")
    assert not found
    assert f"it belongs to user {os.geteuid()}" in said


def test_a_folder_that_is_exchanged_after_it_was_checked_is_not_used(folder, hostile, tmp_path):
    answer()
    name = only(folder).name
    other = tmp_path / "other"
    other.mkdir()
    (other / name).write_bytes(hostile + cache._digest(name, hostile))
    exchange = """
def exchange(*args):
    intact = check(*args)
    os.rename(sys.argv[3], sys.argv[3] + "-moved")
    os.rename(sys.argv[4], sys.argv[3])
    return intact
check, module._is_intact = module._is_intact, exchange
"""
    assert fetched(name, exchange, str(folder), str(other)) == (True, "")
    assert (folder.with_name("cache-moved") / name).exists()


# ---------------------------------------------------------------- damage


def with_other_content(change):
    return lambda library, _: exchange(library, change(library.read_bytes()))


def linked(library, hostile):
    target = library.parent.with_name("target.so")
    library.rename(target)
    library.symlink_to(target)


def exchanged(library, hostile):
    """The library of another kernel, with its digest."""
    answer(50)
    (other,) = set(library.parent.iterdir()) - {library}
    other.replace(library)


DAMAGE = {
    "empty": with_other_content(lambda x: b""),
    "truncated": with_other_content(lambda x: x[: len(x) // 2]),
    "without its end": with_other_content(lambda x: x[:-1]),
    "longer": with_other_content(lambda x: x + b"0"),
    "one bit": with_other_content(lambda x: x[:5000] + bytes([x[5000] ^ 1]) + x[5001:]),
    "planted": exchange,
    "of another kernel": exchanged,
    "a link": linked,
    "open to others": lambda library, _: library.chmod(0o666),
}


@pytest.mark.slow
@pytest.mark.parametrize("how", DAMAGE)
def test_a_library_that_is_not_as_it_was_made_is_made_anew(how, folder, hostile):
    answer()
    name = only(folder).name
    assert fetched(name) == (True, "")
    DAMAGE[how](only(folder), hostile)
    assert fetched(name) == (False, "")
    assert compilations(answer) == 1
    assert fetched(name) == (True, "")
    assert stat.S_IMODE(only(folder).lstat().st_mode) == 0o600


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
def test_a_library_of_another_user_is_made_anew(folder):
    answer()
    os.chown(only(folder), 12345, -1)
    assert fetched(only(folder).name) == (False, "")
    assert compilations(answer) == 1
    assert only(folder).stat().st_uid == os.geteuid()


def test_all_is_on_the_disk_before_it_has_its_name(folder, monkeypatch):
    done = []
    for name in ("fsync", "replace"):
        function = getattr(os, name)
        monkeypatch.setattr(os, name, lambda *args, f=function, n=name, **kw: (done.append(n), f(*args, **kw)))
    answer()
    assert done == ["fsync", "replace"]


def test_what_a_killed_process_was_writing_is_removed(folder):
    answer(1)
    old, young = folder / "old.part", folder / "young.part"
    for path in (old, young):
        path.touch()
    os.utime(old, (0, 0))
    answer(2)
    assert not old.exists()
    assert young.exists()  # it may be at work


# ---------------------------------------------------------------- several processes and machines


def test_machines_with_other_instructions_have_kernels_of_their_own(folder, monkeypatch):
    for flags in ("flags: avx2", "flags: avx512f", "flags: avx2"):
        monkeypatch.setattr(build, "_processor", lambda flags=flags: flags)
        assert answer() == 42
    assert len(list(folder.iterdir())) == 2


KEEPS = (
    LOADED
    + """
from pathlib import Path
for _ in range(20):
    module.keep("a.so", Path(sys.argv[2]))
    assert module.fetch("a.so") is not None
"""
)


def test_processes_may_make_the_same_kernel_at_the_same_time(folder, tmp_path):
    answer()
    made = only(folder).rename(tmp_path / "made.so")
    command = [sys.executable, "-W", "error", "-c", KEEPS, cache.__file__, str(made)]
    processes = [subprocess.Popen(command, stderr=subprocess.PIPE) for _ in range(4)]
    assert [p.communicate()[1] for p in processes] == [b""] * 4
    assert only(folder).name == "a.so"


# ---------------------------------------------------------------- where it cannot be kept


@pytest.mark.parametrize("place", ["/dev/null", "/dev/null/below", "/proc/nowhere", "~nobody-has-this-name/cache"])
def test_without_a_folder_there_is_one_warning_and_the_process_keeps_its_kernels(place, folder, monkeypatch):
    monkeypatch.setenv("TORCHFRA_CACHE", place)
    with pytest.warns(RuntimeWarning, match=f"TORCHFRA_CACHE: .*{place}.*temporary folder") as seen:
        assert answer(60) == 62
    assert len(seen) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert compilations(lambda: answer(60)) == 0
        assert answer(61) == 63
    assert list((folder.parent / "temporary").iterdir()) == []


def test_a_full_disk_is_a_warning(folder, monkeypatch):
    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.warns(RuntimeWarning, match="no space left on device"):
        assert answer() == 42
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(("place", "where"), [(".", "here"), ("kernels", "here/kernels"), ("~", "home"),
                                              ("~/kernels", "home/kernels")])  # fmt: skip
def test_folders_are_named_as_in_a_shell(place, where, folder, tmp_path, monkeypatch):
    for name in ("here", "home"):
        (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("TORCHFRA_CACHE", place)
    assert answer() == 42
    assert only(tmp_path / where).suffix == ".so"
    assert compilations(answer) == 0


# ---------------------------------------------------------------- the compiler


@pytest.mark.parametrize(("variable", "value"), [
    ("CXX", ""), ("CXX", "g++ 'half"), ("CXX", "/dev/null"), ("CXX", "/"), ("CXX", "true"), ("CXX", "false"),
    ("CXX", "no-such-compiler"), ("CXXFLAGS", "'half"), ("CXXFLAGS", "-no-such-flag"), ("CXXFLAGS", "-fsyntax-only"),
    ("CXXFLAGS", "-c"), ("CXXFLAGS", "-E"), ("CXXFLAGS", "-Drun=walk"), ("CXXFLAGS", "-std=c++98 -include thread"),
])  # fmt: skip
def test_a_compiler_or_flags_that_do_not_work_are_named(variable, value, folder, monkeypatch):
    monkeypatch.setenv(variable, value)
    with pytest.raises(CompileError, match=f"{variable}.*"):
        answer()
    assert list((folder.parent / "temporary").iterdir()) == []


def test_what_a_compiler_says_need_not_be_text(folder, tmp_path, monkeypatch):
    script = tmp_path / "compiler"
    script.write_text("#!/bin/sh\nprintf '\\377'; printf '\\377 says no' >&2; test \"$1\" = --version\n")
    script.chmod(0o755)
    monkeypatch.setenv("CXX", str(script))
    with pytest.raises(CompileError, match="says no"):
        answer()


PATIENT = """#!/bin/sh
sh -c 'echo $$ > {pid}; touch "$TMPDIR/left.s"; exec sleep 60' &
wait
"""
COMPILES = (
    LOADED
    + """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background starts with it ignored
with module.workplace() as folder:
    module.run(sys.argv[2:], folder)
"""
)


def wait_until(true):
    for _ in range(1000):
        if true():
            return
        time.sleep(0.02)
    raise AssertionError("in twenty seconds nothing has happened")


def runs(pid):
    """Whether a process is there, and has not ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_of_a_killed_compilation_nothing_is_left(sent, folder, tmp_path, monkeypatch):
    temporary, pid, script = tmp_path / "temporary", tmp_path / "pid", tmp_path / "compiler"
    script.write_text(PATIENT.format(pid=shlex.quote(str(pid))))
    script.chmod(0o755)
    process = subprocess.Popen(
        [sys.executable, "-c", COMPILES, workplace.__file__, str(script)],
        env={**os.environ, "TMPDIR": str(temporary)}, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    wait_until(lambda: list(temporary.glob("*/left.s")))
    started = int(pid.read_text())
    assert runs(started)
    process.send_signal(sent)
    process.wait()
    wait_until(lambda: not runs(started))
    assert answer() == 42  # another process compiles something
    assert list(temporary.iterdir()) == []


def test_an_interruption_ends_compilations_in_other_threads(folder, tmp_path, make, tracks, monkeypatch):
    pid, script = tmp_path / "pid", tmp_path / "compiler"
    script.write_text(PATIENT.format(pid=shlex.quote(str(pid))).replace("sh -c", 'test "$1" = --version || sh -c'))
    script.chmod(0o755)

    def interrupted(made, *_):
        wait_until(pid.exists)
        raise KeyboardInterrupt

    monkeypatch.setenv("CXX", str(script))
    monkeypatch.setattr("torchfra.evaluation.compiling.progress_bar", interrupted)
    started = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        compiled({"srckf": make("srckf")}, lambda f: f(tracks.z, tracks.prior, u=tracks.u))
    assert time.monotonic() - started < 30  # not the minute that the compiler takes
    assert list((tmp_path / "temporary").iterdir()) == []


def test_a_compilation_that_is_going_on_is_left_alone(folder, tmp_path):
    with workplace.workplace() as one:
        (one / "kernel.cpp").touch()
        assert answer() == 42
        assert (one / "kernel.cpp").exists()
    assert list((tmp_path / "temporary").iterdir()) == []
