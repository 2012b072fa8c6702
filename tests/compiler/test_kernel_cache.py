"""A kernel is kept for one user alone, found again undamaged or made anew."""

import errno
import os
import stat
import subprocess
import sys
import time
import warnings
from ctypes import addressof, c_int64

import pytest

from torchfra.compiler import cache, jit, sharing

SOURCE = """
define void @run(i64 %n, i64 %steps, i32 %threads, ptr %in, ptr %out) {
  %sum = add i64 %n, NUMBER
  store i64 %sum, ptr %out
  ret void
}
"""
HOSTILE = b"not what was compiled"
LOADED = """
import importlib.util, os, sys
spec = importlib.util.spec_from_file_location("module", sys.argv[1])
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
"""
"""Loads one module of the package from its file: without torch, in a moment."""


def answer(number=40, again=False):
    """What a small kernel computes: ``number + 2``; ``again``: by the code that this process may have already."""
    out = c_int64()
    if not again:
        jit._loaded.clear()
    jit.load(SOURCE.replace("NUMBER", str(number)))(2, 0, 0, None, addressof(out))
    return out.value


def only(folder):
    """The one file that is kept."""
    (file,) = folder.iterdir()
    return file


def exchange(file, content):
    """Another file of the name: to cut off the one that this process runs would end it, whatever is checked."""
    other = file.with_name("other")
    other.write_bytes(content)
    other.chmod(0o600)
    other.replace(file)


def fetched(name, before="", *arguments):
    """Whether another process finds a kernel; and what it says."""
    code = f"{LOADED}{before}\nprint(module.read(sys.argv[2]))"
    command = [sys.executable, "-c", code, cache.__file__, name, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return done.stdout != "None\n", done.stderr


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A cache of its own, with nothing in it."""
    monkeypatch.setenv("TORCHFRA_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(jit, "_loaded", {})
    return tmp_path / "cache"


def signed(name):
    """What someone else has made, with its digest."""
    return HOSTILE + cache._digest(name, HOSTILE)


def compilations(work):
    """How often the compiler is called."""
    before = jit.compiled
    work()
    return jit.compiled - before


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


def test_what_is_signed_is_found(folder):
    """The next tests can fail."""
    answer()
    name = only(folder).name
    exchange(only(folder), signed(name))
    assert fetched(name) == (True, "")


@pytest.mark.parametrize("mode", [0o777, 0o1777, 0o775, 0o702])
def test_a_folder_to_which_others_may_write_is_not_used(mode, folder):
    answer()
    name = only(folder).name
    exchange(only(folder), planted := signed(name))
    folder.chmod(mode)
    found, said = fetched(name)
    assert not found
    assert f"TORCHFRA_CACHE: expected a folder that you alone can write to, received {folder} (other users" in said
    with pytest.warns(RuntimeWarning, match="other users may write to it, which chmod go-w ends"):
        assert answer() == 42
    assert only(folder).read_bytes() == planted


def test_a_folder_of_another_user_is_not_used(folder):
    answer()
    name = only(folder).name
    exchange(only(folder), signed(name))
    found, said = fetched(name, "owner = os.geteuid(); os.geteuid = lambda: owner + 1")
    assert not found
    assert f"it belongs to user {os.geteuid()}" in said


def test_a_folder_that_is_exchanged_after_it_was_checked_is_not_used(folder, tmp_path):
    answer()
    name = only(folder).name
    other = tmp_path / "other"
    other.mkdir()
    (other / name).write_bytes(signed(name))
    exchange = """
def exchange(*args):
    os.rename(sys.argv[3], sys.argv[3] + "-moved")
    os.rename(sys.argv[4], sys.argv[3])
    found = read(*args)
    assert not found.startswith(b"not what")
    return found
read, module._content = module._content, exchange
"""
    assert fetched(name, exchange, str(folder), str(other)) == (True, "")
    assert (folder.with_name("cache-moved") / name).exists()


# ---------------------------------------------------------------- damage


def with_other_content(change):
    return lambda file: exchange(file, change(file.read_bytes()))


def linked(file):
    target = file.parent.with_name("target.o")
    file.rename(target)
    file.symlink_to(target)


def exchanged(file):
    """The file of another kernel, with its digest."""
    answer(50)
    (other,) = set(file.parent.iterdir()) - {file}
    other.replace(file)


DAMAGE = {
    "empty": with_other_content(lambda x: b""),
    "truncated": with_other_content(lambda x: x[: len(x) // 2]),
    "without its end": with_other_content(lambda x: x[:-1]),
    "longer": with_other_content(lambda x: x + b"0"),
    "one bit": with_other_content(lambda x: x[:100] + bytes([x[100] ^ 1]) + x[101:]),
    "planted": with_other_content(lambda x: HOSTILE + bytes(32)),
    "of another kernel": exchanged,
    "a link": linked,
    "open to others": lambda file: file.chmod(0o666),
}


@pytest.mark.slow
@pytest.mark.parametrize("how", DAMAGE)
def test_a_file_that_is_not_as_it_was_made_is_made_anew(how, folder):
    answer()
    name = only(folder).name
    assert fetched(name) == (True, "")
    DAMAGE[how](only(folder))
    assert fetched(name) == (False, "")
    assert compilations(answer) == 1
    assert fetched(name) == (True, "")
    assert stat.S_IMODE(only(folder).lstat().st_mode) == 0o600


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
def test_a_file_of_another_user_is_made_anew(folder):
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
    for flags in ("+sse2", "+sse2,+sse3", "+sse2"):
        monkeypatch.setattr(jit, "features", lambda flags=flags: flags)
        assert answer() == 42
    assert len(list(folder.iterdir())) == 2


KEEPS = (
    LOADED
    + """
for _ in range(20):
    module.write("a.o", b"made")
    assert module.read("a.o") == b"made"
"""
)


def test_processes_may_keep_the_same_kernel_at_the_same_time(folder):
    command = [sys.executable, "-W", "error", "-c", KEEPS, cache.__file__]
    processes = [subprocess.Popen(command, stderr=subprocess.PIPE) for _ in range(4)]
    assert [p.communicate()[1] for p in processes] == [b""] * 4
    assert only(folder).name == "a.o"


def test_a_process_that_is_killed_at_any_moment_leaves_a_whole_kernel_or_none(folder):
    content = bytes(2**20)
    code = f"{LOADED}\nprint(flush=True)\nwhile True:\n    module.write('a.o', bytes(2**20))"
    for moment in range(8):
        with subprocess.Popen([sys.executable, "-c", code, cache.__file__], stdout=subprocess.PIPE) as process:
            process.stdout.readline()
            time.sleep(0.003 * moment)
            process.kill()
        assert cache.read("a.o") in (None, content)
    cache.write("a.o", content)
    assert cache.read("a.o") == content
    assert all(path.suffix == ".part" for path in folder.iterdir() if path.name != "a.o")


# ---------------------------------------------------------------- where it cannot be kept


@pytest.mark.parametrize("place", ["/dev/null", "/dev/null/below", "/proc/nowhere", "~nobody-has-this-name/cache"])
def test_without_a_folder_there_is_one_warning_and_the_process_keeps_its_kernels(place, folder, monkeypatch):
    monkeypatch.setenv("TORCHFRA_CACHE", place)
    with pytest.warns(RuntimeWarning, match=f"TORCHFRA_CACHE: .*{place}.*again by every process") as seen:
        assert answer(60) == 62
    assert len(seen) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert compilations(lambda: answer(60, again=True)) == 0
        assert answer(61) == 63


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
    assert only(tmp_path / where).suffix == ".o"
    assert compilations(answer) == 0


def in_parts(count, monkeypatch):
    """A module of so many functions, each of which calls the next one and adds 1, in as many parts."""
    monkeypatch.setattr(sharing, "_LINES", 0)
    head = "define internal i64 @f{}(ptr noalias %in, i64 %n) noinline nounwind {{\nentry:\n"
    texts = [
        f"{head.format(k)}%more = call i64 @f{k + 1}(ptr %in, i64 %n)\n%sum = add i64 %more, 1\nret i64 %sum\n}}\n"
        for k in range(count)
    ]
    texts += ["@table = internal constant [2 x i16] [i16 3, i16 4]\n", f"{head.format(count)}ret i64 %n\n}}\n"]
    run = "define void @run(i64 %n, i64 %steps, i32 %threads, ptr %in, ptr %out) {\n%four = load i16, ptr %last\n"
    run = run.replace("%four", "%last = getelementptr i16, ptr @table, i64 1\n%four")
    run += "%wide = zext i16 %four to i64\n%all = call i64 @f0(ptr %in, i64 %wide)\n"
    run += "store i64 %all, ptr %out\nret void\n}\n"
    return sharing.module([*texts, run], [])


@pytest.mark.parametrize("threads", [1, 2])
def test_a_long_module_is_compiled_in_parts_by_threads(folder, monkeypatch, threads):
    monkeypatch.setattr("torch.get_num_threads", lambda: threads)
    source, out = in_parts(5, monkeypatch), c_int64()
    assert source.count(sharing.PART) == 7
    for _ in range(2):  # compiled, and as it was kept
        jit._loaded.clear()
        jit.load(source)(0, 0, 0, None, addressof(out))
        assert out.value == 9
        assert only(folder).exists()
