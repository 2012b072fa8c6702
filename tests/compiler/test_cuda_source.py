"""Kernels for a GPU: their source gives what the filter gives, compiles for GPUs, and is launched as the driver asks.

No test here needs a GPU: the source runs on the CPU, where a loop goes over the threads.  ``test_cuda`` needs one.
"""

import copy
import ctypes
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from conftest import without_acceleration
from short_tracks import SMALL_GPB

from torchfra import presets, scenarios
from torchfra.compiler import cuda, jit, step
from torchfra.compiler.source import Scan
from torchfra.motion import ConstantVelocity
from torchfra.scenarios import Tracks
from torchfra.sensors import Position
from torchfra.types import CompileError, Gaussian

BEFORE = """
#include <math.h>
#include <cstdint>
#define __CUDACC__
#define __device__
#define __global__
#define __launch_bounds__(...)
#define __grid_constant__
#define __syncthreads()
#define __noinline__ __attribute__((noinline))
#define __forceinline__ inline
static thread_local struct { unsigned x; } blockIdx, threadIdx, blockDim;
#define run kernel
"""
AFTER = """
#undef run
extern "C" void launch(unsigned blocks, unsigned threads, int64_t tracks, int64_t steps, const Ports& ports) {
  blockDim.x = threads;
  for (blockIdx.x = 0; blockIdx.x < blocks; blockIdx.x++)
    for (threadIdx.x = 0; threadIdx.x < threads; threadIdx.x++) kernel(tracks, steps, ports);
}
extern "C" void run(int64_t tracks, int64_t steps, int, const Port* in, const Port*) {
  launch((tracks + 2) / 3, 3, tracks, steps, *reinterpret_cast<const Ports*>(in));
}
"""
DRIVER = """
#include <cstdint>
#include <cstring>
#include <dlfcn.h>
using Launch = void (*)(unsigned, unsigned, int64_t, int64_t, const void*);
static int current = 0;
extern "C" {
int depth() { return current; }
void* stream = nullptr;
int cuInit(unsigned flags) { return flags; }
int cuDeviceGet(int* device, int number) { *device = number + 7; return 0; }
int cuDevicePrimaryCtxRetain(void** context, int device) {
  *context = (void*)(device == 7 ? 0x700000007 : 0);
  return 0;
}
int cuCtxPushCurrent_v2(void* context) { current++; return context == (void*)0x700000007 ? 0 : 201; }
int cuCtxPopCurrent_v2(void** context) { *context = nullptr; current--; return 0; }
int cuModuleLoadData(void** module, const char* image) { *module = dlopen(image, RTLD_NOW); return *module ? 0 : 200; }
int cuModuleGetFunction(void** kernel, void* module, const char* name) {
  *kernel = strcmp(name, "run") ? nullptr : dlsym(module, "launch");
  return *kernel ? 0 : 500;
}
int cuLaunchKernel(void* kernel, unsigned x, unsigned y, unsigned z, unsigned bx, unsigned by, unsigned bz,
                   unsigned shared, void* on, void** arguments, void** extra) {
  if (y != 1 || z != 1 || by != 1 || bz != 1 || shared || extra || current != 1) return 1;
  stream = on;
  ((Launch)kernel)(x, bx, *(int64_t*)arguments[0], *(int64_t*)arguments[1], arguments[2]);
  return 0;
}
int cuGetErrorString(int status, const char** text) { *text = status == 1 ? "invalid argument" : "other"; return 0; }
}
"""
"""A driver whose GPU is the CPU: modules are libraries, and the image of one is its path."""


needs_gcc = pytest.mark.skipif(shutil.which("g++") is None, reason="there is no g++")


def emulated(source):
    """The source of a GPU's kernel, to be compiled for the CPU."""
    return BEFORE + source + AFTER


def library(text, *flags):
    """The path of a library of this C++."""
    path = Path(tempfile.mkdtemp(dir=Path(os.environ["TORCHFRA_CACHE"]).parent)) / "image.so"
    command = ["g++", "-x", "c++", "-", *flags, "-std=c++17", "-shared", "-fPIC", "-o", str(path)]
    subprocess.run(command, input=text, text=True, check=True)
    return path


def on_the_cpu(source):
    """The kernel of a GPU as a function on the CPU."""
    run = ctypes.CDLL(str(library(emulated(source), "-O0"))).run
    run.argtypes = [*[ctypes.c_int64] * 2, ctypes.c_int, *[ctypes.c_void_p] * 2]
    return run


def of_kind(name, **options):
    """A filter and tracks for it, with an outlier and gaps."""
    adsb = name == "alphabeta"
    scenario = (
        scenarios.adsb_turns() if adsb else without_acceleration(scenarios.bearings_outliers("std", initial="truth"))
    )
    tracks = scenario.simulate(4, 0)
    z = tracks.z[:, :12].clone()
    z[0, 3, 0], z[1, 5], z[2, 4, 1] = torch.nan, torch.nan, z[2, 4, 1] + 0.3
    motion = scenario.bank if name.startswith("imm") else scenario.motion
    u = None if tracks.u is None else tracks.u[:12]
    return getattr(presets, name)(motion, scenario.sensor, **options), tracks._replace(z=z, u=u)


def on_a_line(name, **options):
    """A filter of a target on a line, whose kernels are small, and tracks with an outlier and gaps."""
    z = torch.randn(4, 12, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64).cumsum(1)
    z[0, 3], z[1, 5], z[2, 4:6] = torch.nan, torch.nan, z[2, 4:6] + 60.0
    z[3, 6:] += 8.0 * torch.arange(6).unsqueeze(-1)
    prior = Gaussian(torch.zeros(4, 2).double(), torch.eye(2).double())
    f = getattr(presets, name)(ConstantVelocity(0.5, dims=1), Position(2.0, dims=1), **options)
    return f, Tracks(z, z, None, prior)


def in_precision(tracks, dtype):
    mean, root = tracks.prior
    u = None if tracks.u is None else tracks.u.to(dtype)
    return tracks._replace(z=tracks.z.to(dtype), u=u, prior=Gaussian(mean.to(dtype), root.to(dtype)))


def results(f, tracks, wanted=()):
    """Means, roots and scores, and the gradients of the wanted hyperparameters."""
    e = f(tracks.z, tracks.prior, u=tracks.u)
    loss = e.mean.double().square().mean() + e.log_likelihood.double().sum()
    gradients = torch.autograd.grad(loss, wanted) if wanted else ()
    return [x.detach() for x in (e.mean, e.scale_tril, e.nis, e.log_likelihood)] + list(gradients)


def compare(f, tracks, dtype, monkeypatch):
    tracks, fast = in_precision(tracks, dtype), copy.deepcopy(f).compile()
    slow = results(f, tracks, list(f.parameters()))
    monkeypatch.setattr(Scan, "source", lambda scan, narrow=False: scan.cuda())
    monkeypatch.setattr(jit, "load", on_the_cpu)
    for one, other in zip(slow, results(fast, tracks, list(fast.parameters())), strict=True):
        scale = one.nan_to_num().abs().max()
        tolerance = 1e-12 if dtype == torch.float64 else 2e-3
        torch.testing.assert_close(other / scale, one / scale, rtol=0, atol=tolerance, equal_nan=True)


# ---------------------------------------------------------------- the same results


@needs_gcc
@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", ["srckf", "alphabeta"])
def test_a_loop_over_threads_gives_what_the_filter_gives(name, dtype, monkeypatch):
    compare(*of_kind(name, **({"learn": ("q",)} if name == "srckf" else {})), dtype, monkeypatch)


@needs_gcc
@pytest.mark.slow
@pytest.mark.parametrize(("name", "options"), [
    ("fra", {"learn": "all", "temperature": 1.0}), ("gpb", SMALL_GPB | {"learn": ("noise_levels",)}),
])  # fmt: skip
def test_filters_of_several_branches_too(name, options, monkeypatch):
    compare(*on_a_line(name, **options), torch.float64, monkeypatch)


@needs_gcc
@pytest.mark.slow
def test_a_step_of_interacting_models_that_calls_routines_too(monkeypatch):
    monkeypatch.setattr(step, "_MOST", 10)
    compare(*of_kind("imm_srckf"), torch.float64, monkeypatch)
    assert any("_r1(a, v" in source for source in source_of("imm_srckf", monkeypatch))


@pytest.mark.parametrize(
    ("name", "waits", "called"), [("srckf", False, False), ("fra", True, False), ("gpb", True, True)]
)
def test_threads_of_a_block_go_through_a_long_step_together_and_a_very_long_one_is_no_single_function(
    name, waits, called, monkeypatch
):
    monkeypatch.setattr("torchfra.compiler.source._LONG", 10_000)
    whole = scenarios.bearings_outliers("std", initial="truth")
    tracks, found = whole.simulate(4, 0), []
    monkeypatch.setattr(Scan, "source", lambda scan, narrow=False: found.append(scan.cuda()) or "")
    monkeypatch.setattr(jit, "load", lambda source: lambda *_: None)
    getattr(presets, name)(whole.motion, whole.sensor).compile()(tracks.z[:, :3], tracks.prior, u=tracks.u[:3])
    assert ("    __syncthreads();" in found[-1]) == waits
    assert found[-1].startswith("#define LONG") == called


# ---------------------------------------------------------------- machine code for GPUs


def source_of(name, monkeypatch, **options):
    """The last kernel that a filter needs: the gradient pass, if it learns."""
    f, tracks = of_kind(name, **options)
    found = []
    monkeypatch.setattr(Scan, "source", lambda scan, narrow=False: found.append(scan.cuda()) or "")
    monkeypatch.setattr(jit, "load", lambda source: lambda *_: None)
    mean = f.compile()(tracks.z, tracks.prior, u=tracks.u).mean
    if options:
        mean.square().sum().backward()
    return found


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("nvcc") is None, reason="no nvcc")
def test_nvcc_compiles_it(tmp_path, monkeypatch):
    for k, source in enumerate(source_of("srckf", monkeypatch, learn=("q",))):
        path = tmp_path / f"{k}.cu"
        path.write_text(source)
        command = ["nvcc", "-std=c++17", "-ptx", "-arch=sm_80", str(path), "-o", str(path.with_suffix(".ptx"))]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        assert ".visible .entry run(" in path.with_suffix(".ptx").read_text()


def has_nvrtc():
    try:
        return bool(cuda._nvrtc())
    except CompileError:
        return False


@pytest.mark.skipif(not has_nvrtc(), reason="pip install nvidia-cuda-nvrtc")
def test_nvrtc_compiles_it_and_quotes_what_it_cannot(monkeypatch):
    called, compile_it = [], cuda._compile
    monkeypatch.setattr(cuda, "_compile", lambda *args: called.append(args) or compile_it(*args))
    sources = source_of("srckf", monkeypatch, learn=("q",))
    for source in (*sources, *sources):
        assert cuda.compiled(source, "sm_80")[:4] == b"\x7fELF"
    assert len(called) == len(sources)  # then it is kept
    with pytest.raises(CompileError, match=r"NVRTC for sm_80 failed.*\n.*identifier \"walk\" is undefined"):
        cuda.compiled("__global__ void run() { walk(); }", "sm_80")


# ---------------------------------------------------------------- how it is launched


@pytest.fixture
def driver(tmp_path, monkeypatch):
    """A driver whose GPU is the CPU."""
    path = tmp_path / "libcuda.so"
    command = ["g++", "-x", "c++", "-", "-shared", "-fPIC", "-o", str(path)]
    subprocess.run(command, input=DRIVER, text=True, check=True)
    library = ctypes.CDLL(str(path))
    monkeypatch.setattr(cuda, "_driver", lambda: library)
    monkeypatch.setattr("torch.cuda.get_device_capability", lambda device: (9, 0))
    monkeypatch.setattr("torch.cuda.current_stream", lambda device: SimpleNamespace(cuda_stream=0x123456789AB))
    cuda._context.cache_clear()
    yield library
    cuda._context.cache_clear()


def image(source, architecture):
    """Machine code of the CPU for a kernel, as its path."""
    assert architecture == "sm_90"
    return str(library(emulated(source), "-O0")).encode()


@needs_gcc
def test_the_driver_is_given_the_tensors_and_the_stream(driver, monkeypatch):
    """All but the compiler and the driver itself is what runs on a GPU."""
    f, tracks = of_kind("srckf")
    with torch.no_grad():
        slow = results(f, tracks)
        monkeypatch.setattr(cuda, "compiled", image)
        monkeypatch.setattr(Scan, "source", lambda scan, narrow=False: scan.cuda())
        monkeypatch.setattr(jit, "load", lambda source: cuda.load(source, torch.device("cuda", 0)))
        fast = results(f.compile(), tracks)
    for one, other in zip(slow, fast, strict=True):
        torch.testing.assert_close(other, one, rtol=1e-10, atol=1e-10, equal_nan=True)
    assert ctypes.c_void_p.in_dll(driver, "stream").value == 0x123456789AB
    assert driver.depth() == 0


@needs_gcc
def test_a_driver_that_refuses_is_quoted(driver, monkeypatch):
    monkeypatch.setattr(cuda, "compiled", lambda source, architecture: b"/no/such/image")
    with pytest.raises(CompileError, match=r"cuModuleLoadData of the CUDA driver failed \(status 200: other\)"):
        cuda.load("", torch.device("cuda", 0))
    assert driver.depth() == 0


def test_without_libraries_it_says_what_is_missing(monkeypatch):
    with pytest.raises(CompileError, match=r"expected NVRTC for filters on a GPU, found none .*no-such-library"):
        cuda._library(["no-such-library"], "NVRTC", "install it")
