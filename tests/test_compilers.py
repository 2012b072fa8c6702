"""Kernels are made by whichever C++ compiler there is, for the processors and systems that torch runs on."""

import copy
import importlib.util
import struct
import subprocess
import sys
from ctypes import addressof, c_int64
from pathlib import Path

import pytest
import torch

from torchfra.compiler import build, cache, compilers, plain_workplace
from torchfra.compiler.compilers import CompileError, Compiler

ZIG = f"{sys.executable} -m ziglang c++"
needs_zig = pytest.mark.skipif(importlib.util.find_spec("ziglang") is None, reason="pip install ziglang")
SOURCE = """
#include <cstdint>
extern "C" void run(int64_t n, int64_t, int, const void*, void* out) { *(int64_t*)out = n + 40; }
"""


def answer():
    """What a small kernel computes."""
    out = c_int64()
    build.load(SOURCE)(2, 0, 0, None, addressof(out))
    return out.value


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A cache of its own."""
    monkeypatch.setenv("TORCHFRA_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("CXXFLAGS", "-O0")
    monkeypatch.setattr(cache, "_unkept", {})
    return tmp_path / "cache"


@pytest.fixture
def sources(make, tracks, monkeypatch):
    """From a filter's name to the sources of its kernels: many tracks forwards, a single step of one track."""

    def of(name):
        written = []
        monkeypatch.setattr(build, "load", lambda source: written.append(source) or (lambda *_: None))
        with torch.no_grad():
            f = make(name).compile()
            f(tracks.z, tracks.prior, u=tracks.u)
            f.step(f.init(tracks.prior._replace(mean=tracks.prior.mean[0])), tracks.z[0, 0], u=tracks.u[0])
        return written

    return of


# ---------------------------------------------------------------- which one


@pytest.mark.parametrize(("command", "version", "family"), [
    ("g++", "g++ (Debian 12.2.0)", "gcc"), ("g++", "Apple clang version 17.0.0", "clang"),
    ("/usr/bin/clang++-19", "Debian clang version 19.1", "clang"), ("ccache g++", "g++ (GCC) 15.1", "gcc"),
    (ZIG, "clang version 21.1", "zig"), ("/opt/zig/zig c++", "clang version 21.1", "zig"),
    ("cl", "Microsoft (R) C/C++ Optimizing Compiler", "msvc"),
    ("C:\\LLVM\\bin\\clang-cl.exe", "clang version 20", "msvc"),
])  # fmt: skip
def test_the_family_of_a_compiler_is_known_by_its_name_and_what_it_reports(command, version, family):
    assert Compiler(tuple(command.split()), version).family == family


def test_flags_follow_the_processor_and_the_size(monkeypatch):
    gcc = Compiler(("g++",), "g++ (GCC) 15.1")
    for machine, native in (("x86_64", "-march=native"), ("aarch64", "-mcpu=native"), ("arm64", "-mcpu=native")):
        monkeypatch.setattr("platform.machine", lambda machine=machine: machine)
        assert native in gcc.flags()
    assert gcc.flags(large=True)[-2:] == ["-O1", "-fexpensive-optimizations"]
    assert Compiler(("cl",), "").flags()[-1] == "/w"


def test_the_first_that_runs_is_taken(tmp_path, monkeypatch):
    monkeypatch.delenv("CXX", raising=False)
    for name, status in (("g++", 1), ("clang++", 0)):  # the first is there and does not run, as on a bare macOS
        script = tmp_path / name
        script.write_text(f"#!/bin/sh\necho clang version 99; exit {status}\n")
        script.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert compilers.find() == Compiler(("clang++",), "clang version 99\n")


def test_without_any_all_that_were_looked_for_are_named_and_what_to_do(tmp_path, monkeypatch):
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    expected = r"out of g\+\+, clang\+\+, the Python package ziglang, zig; none is there: .*pip install ziglang.*CXX"
    with pytest.raises(CompileError, match=expected):
        build.compiler()


def test_backslashes_are_part_of_paths_on_windows(monkeypatch):
    monkeypatch.setenv("CXX", r'"C:\Program Files\LLVM\bin\clang++.exe" -m64')
    monkeypatch.setattr("os.name", "nt")
    assert compilers.words("CXX") == [r"C:\Program Files\LLVM\bin\clang++.exe", "-m64"]


def test_the_compiler_of_windows_is_given_its_own_arguments():
    made = Compiler(("cl",), "Microsoft").to_library([Path("kernel.cpp")], Path("kernel.dll"), wide=False)
    assert made == ["kernel.cpp", "/Fokernel.obj", "/Fekernel.dll"]


# ---------------------------------------------------------------- the same results


@pytest.mark.slow
@needs_zig
@pytest.mark.parametrize(
    ("name", "dtype", "gradients"), [("srckf", torch.float32, False), ("fra", torch.float64, True)]
)
def test_zig_makes_what_the_other_compiler_makes(name, dtype, gradients, make, tracks, folder, monkeypatch):
    found = []
    z, prior = tracks.z.to(dtype), type(tracks.prior)(*(x.to(dtype) for x in tracks.prior))
    monkeypatch.setenv("CXXFLAGS", "-O0 -ffp-contract=off")
    for command in ("g++", ZIG):
        monkeypatch.setenv("CXX", command)
        f = make(name, learn=("q",) if gradients else ()).compile()
        estimate = f(z, prior, u=tracks.u.to(dtype))
        found.append([estimate.mean.detach()])
        if gradients:
            found[-1] += torch.autograd.grad(estimate.mean.square().mean(), f.motion.q.raw)
    tolerance = 1e-12 if dtype == torch.float64 else 1e-4
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=tolerance, atol=tolerance * one.abs().max().item())


@pytest.mark.slow
def test_threads_of_cxx_give_what_openmp_gives(make, tracks, folder, monkeypatch):
    many = [x.repeat(20, *[1] * (x.dim() - 1)) for x in (tracks.z, tracks.prior.mean)]
    prior = tracks.prior._replace(mean=many[1])
    f, found, threads = make("srckf"), [], torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        for flags in ("-O0", "-O0 -fno-openmp -pthread"):
            monkeypatch.setenv("CXXFLAGS", flags)
            found.append(copy.deepcopy(f).compile()(many[0], prior, u=tracks.u).mean)
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(*found)


def test_no_tracks_are_no_work(make, tracks):
    f = make("srckf").compile()
    prior = tracks.prior._replace(mean=tracks.prior.mean[:0])
    assert f(tracks.z[:0], prior, u=tracks.u).mean.shape == (0, *tracks.truth.shape[1:])


# ---------------------------------------------------------------- other systems


def machine_of(path):
    """Format and processor of an object file, from its header."""
    head = path.read_bytes()[:20]
    if head[:4] == b"\x7fELF":
        return "ELF", {62: "x86_64", 183: "aarch64"}[struct.unpack_from("<H", head, 18)[0]]
    if head[:4] == b"\xcf\xfa\xed\xfe":
        return "Mach-O", {0x01000007: "x86_64", 0x0100000C: "aarch64"}[struct.unpack_from("<I", head, 4)[0]]
    return "COFF", {0x8664: "x86_64", 0xAA64: "aarch64"}[struct.unpack_from("<H", head)[0]]


@pytest.mark.slow
@needs_zig
@pytest.mark.parametrize("processor", ["x86_64", "aarch64"])
@pytest.mark.parametrize(("system", "form"), [("linux-gnu", "ELF"), ("macos", "Mach-O"), ("windows-gnu", "COFF")])
def test_kernels_compile_for_other_systems_and_processors(system, form, processor, sources, tmp_path):
    """Vectors and single tracks; on Windows single tracks alone."""
    for k, source in enumerate(sources("fra")):
        wide = "SLEEF" in source
        if wide and system == "windows-gnu":
            continue
        text, made = tmp_path / f"{k}.cpp", tmp_path / f"{k}.o"
        text.write_text(source)
        model = ["-mcpu=x86_64_v3"] if processor == "x86_64" else []
        flags = ["-c", "-O0", "-w", "-std=c++20", "-target", f"{processor}-{system}"]
        command = [*ZIG.split(), *flags, *model, str(text), "-o", str(made)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[-2000:]
        assert machine_of(made) == (form, processor)


def test_where_files_cannot_be_named_beside_a_folder_kernels_are_kept_by_their_paths(folder, monkeypatch):
    monkeypatch.setattr(cache, "_DESCRIPTORS", False)
    monkeypatch.setattr(build, "_places", lambda: plain_workplace)
    before = build.compiled
    assert answer() == answer() == 42
    assert build.compiled == before + 1
    (kept,) = folder.iterdir()
    content = kept.read_bytes()
    kept.unlink()  # its memory is that of the loaded library
    kept.write_bytes(content[:-1])
    assert cache.fetch(kept.name) is None


def test_where_there_are_no_process_groups_a_compilation_can_still_be_stopped(tmp_path):
    with plain_workplace.workplace() as place:
        status, said = plain_workplace.run([sys.executable, "-c", "import os; print(os.environ['TMP'])"], place)
        assert (status, said.strip()) == (0, str(place))
    assert not place.exists()
