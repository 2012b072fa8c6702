"""A kernel gives the same numbers in the registers of any processor, and on threads of any kind."""

import copy
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from alike import close
from test_regions import make_small, program

from torchfra import presets, scenarios
from torchfra.compiler import elementary_functions, jit, llvm

WIDE = ["avx512", "avx2", ""]


@pytest.fixture
def on(monkeypatch):
    """As on a processor with such registers."""
    has = llvm.registers()

    def limited(kind):
        if WIDE.index(kind) < WIDE.index(has):
            pytest.skip(f"this processor has no {kind}")
        monkeypatch.setattr(llvm, "registers", lambda: kind)

    return limited


def random_numbers(tracks):
    draw = torch.Generator().manual_seed(0)
    return [torch.rand(tracks, *shape, dtype=torch.float64, generator=draw) * 4 - 2 for shape in ((3,), (5, 4))]


@pytest.mark.parametrize("kind", WIDE)
def test_regions_gather_tracks_in_any_registers(kind, on, monkeypatch):
    tensors = random_numbers(tracks=83)
    whole = program(83)(torch.Size([83]), 5, tensors)
    make_small(monkeypatch.setattr)
    on(kind)
    for a, b in zip(whole, program(83)(torch.Size([83]), 5, tensors), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("kind", "dtype"), [*zip(WIDE, (torch.float64, torch.float32, torch.float64), strict=True)])
def test_a_filter_and_its_gradient_are_the_same_in_any_registers(kind, dtype, on):
    on(kind)
    scenario = scenarios.bearings_outliers()
    tracks = scenario.simulate(runs=21, seed=0)
    z, u = tracks.z[:, :10].to(dtype), tracks.u[:10].to(dtype)
    prior = type(tracks.prior)(*(x.to(dtype) for x in tracks.prior))
    f = presets.rsrckf(scenario.motion, scenario.sensor, learn=("std",)).to(dtype)
    said = []
    for one in (f, copy.deepcopy(f).compile()):
        e = one(z, prior, u=u)
        e.log_likelihood.sum().backward()
        said.append((e.mean, e.nis, [p.grad for p in one.parameters()]))
    close(*said, tolerance=1e-9 if dtype == torch.float64 else 2e-2)


def test_without_openmp_threads_of_python_share_the_tracks(monkeypatch, tmp_path):
    monkeypatch.setenv("TORCHFRA_CACHE", str(tmp_path))
    tensors = random_numbers(tracks=500)
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        usual = program(500)(torch.Size([500]), 5, tensors)
        monkeypatch.setattr(jit, "_loaded", {})
        found = elementary_functions.address
        monkeypatch.setattr(jit, "address", lambda name: 0 if name == "GOMP_parallel" else found(name))
        started = []
        monkeypatch.setattr(jit.threading.Thread, "start", counted(jit.threading.Thread.start, started))
        for a, b in zip(usual, program(500)(torch.Size([500]), 5, tensors), strict=True):
            assert torch.equal(a, b)
        assert len(started) == 2
    finally:
        torch.set_num_threads(before)


def counted(function, calls):
    return lambda *args: calls.append(1) or function(*args)


CROWDED = """
import ctypes, sys
import torch
from test_regions import scan_of
from torchfra.compiler.program import Program

libc = ctypes.CDLL(None)
libc.mmap.restype = ctypes.c_void_p
libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_long]
libc.munmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t]
reserve = lambda size: libc.mmap(None, size, 0, 0x4022, -1, 0)
reserve(4 << 30)
for page in [reserve(4096) for _ in range(4000)][::2]:
    libc.munmap(page, 4096)
for tracks in range(3, 15):
    reserve(4 << 30)
    numbers = [torch.rand(tracks, *shape, dtype=torch.float64) for shape in ((3,), (5, 4))]
    Program(scan_of(tracks, 60))(torch.Size([tracks]), 5, numbers)
"""
"""Kernels in an address space full of holes, where code and its constants lie further apart than 32 bits reach."""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="asks Linux for its address space")
def test_code_and_its_constants_may_lie_far_apart(tmp_path):
    here = Path(__file__).parent
    paths = map(str, (here, here.parent, here.parents[1]))
    environment = {**os.environ, "TORCHFRA_CACHE": str(tmp_path), "PYTHONPATH": os.pathsep.join(paths)}
    subprocess.run([sys.executable, "-c", CROWDED], cwd=here, env=environment, check=True)


def test_a_kernel_needs_no_other_compiler(monkeypatch, tmp_path):
    """No program is started, whatever the path."""
    monkeypatch.setenv("TORCHFRA_CACHE", str(tmp_path))
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr(jit, "_loaded", {})
    assert shutil.which("g++") is None
    assert program(5)(torch.Size([5]), 5, random_numbers(tracks=5))
    assert [path.suffix for path in tmp_path.iterdir()] == [".o"]
    assert llvm.is_installed()
