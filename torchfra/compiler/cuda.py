"""From CUDA source to a function: compiled by NVRTC for the GPU at hand, launched by the driver on torch's own stream.

Both are libraries with documented functions in C, called through ctypes, and both are there wherever torch runs on such
a GPU: NVRTC comes with torch's wheels, the driver with the GPU.  Nothing else is needed: no nvcc, no C++ compiler.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
import sys
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from torchfra.compiler import cache
from torchfra.compiler.source import THREADS
from torchfra.types import CompileError as CompileError

_OPTIONS = ("--std=c++17", "--fmad=true")


def load(source: str, device: torch.device) -> Callable[[int, int, int, int, int], None]:
    """The kernel ``run`` of a translation unit, as a function with the arguments of ``jit.load``'s.

    Args:
        source: what ``Scan.cuda`` writes.
        device: the GPU; the function starts the kernel on the stream that is current there, and does not wait.

    Raises:
        CompileError: there is no NVRTC or no driver, or one of them fails.
    """
    major, minor = torch.cuda.get_device_capability(device)
    module = ctypes.c_void_p()
    kernel = ctypes.c_void_p()
    image = compiled(source, f"sm_{major}{minor}")
    context = _context(device.index or 0)
    with _Current(context):
        _drive("cuModuleLoadData", ctypes.byref(module), image)
        _drive("cuModuleGetFunction", ctypes.byref(kernel), module, b"run")

    def run(tracks: int, steps: int, threads: int, inputs: int, outputs: int) -> None:
        numbers = ctypes.c_int64(tracks), ctypes.c_int64(steps)
        # The table of the outputs lies behind that of the inputs: together they are the last argument.
        arguments = (ctypes.c_void_p * 3)(*map(ctypes.addressof, numbers), inputs)
        stream = ctypes.c_void_p(torch.cuda.current_stream(device).cuda_stream)
        shape = (-(-tracks // THREADS), 1, 1, THREADS, 1, 1)  # of the grid, and of a block
        if tracks == 0:
            return
        with _Current(context):
            _drive("cuLaunchKernel", kernel, *map(ctypes.c_uint, shape), ctypes.c_uint(0), stream, arguments, None)

    return run


def compiled(source: str, architecture: str) -> bytes:
    """The machine code of a translation unit for an architecture such as ``sm_90``, by NVRTC; kept on disk.

    Raises:
        CompileError: there is no NVRTC, or it fails.
    """
    major, minor = ctypes.c_int(), ctypes.c_int()
    _nvrtc().nvrtcVersion(ctypes.byref(major), ctypes.byref(minor))
    key = "\n".join((bare(source), architecture, *_OPTIONS, f"{major.value}.{minor.value}"))
    name = f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.cubin"
    image = cache.read(name)
    if image is None:
        image = _compile(_nvrtc(), source, architecture)
        cache.write(name, image)
    return image


def _compile(nvrtc: ctypes.CDLL, source: str, architecture: str) -> bytes:
    program, size = ctypes.c_void_p(), ctypes.c_size_t()

    def check(status: int, read: str = "nvrtcGetProgramLog") -> None:
        if status:
            getattr(nvrtc, f"{read}Size")(program, ctypes.byref(size))
            log = ctypes.create_string_buffer(max(size.value, 1))
            getattr(nvrtc, read)(program, log)
            said = log.value.decode(errors="replace")[:2000]  # what follows from the first error does not help
            raise CompileError(f"compile: NVRTC for {architecture} failed (status {status}):\n{said}")

    check(nvrtc.nvrtcCreateProgram(ctypes.byref(program), source.encode(), b"kernel.cu", 0, None, None))
    try:
        options = [f"--gpu-architecture={architecture}".encode(), *(option.encode() for option in _OPTIONS)]
        check(nvrtc.nvrtcCompileProgram(program, len(options), (ctypes.c_char_p * len(options))(*options)))
        check(nvrtc.nvrtcGetCUBINSize(program, ctypes.byref(size)))
        image = ctypes.create_string_buffer(size.value)
        check(nvrtc.nvrtcGetCUBIN(program, image))
        return image.raw
    finally:
        nvrtc.nvrtcDestroyProgram(ctypes.byref(program))


class _Current:
    """The context of a GPU, current in this thread while inside: that of torch."""

    def __init__(self, context: ctypes.c_void_p) -> None:
        self._context = context

    def __enter__(self) -> None:
        _drive("cuCtxPushCurrent_v2", self._context)

    def __exit__(self, *_: object) -> None:
        _drive("cuCtxPopCurrent_v2", ctypes.byref(ctypes.c_void_p()))


@lru_cache
def _context(index: int) -> ctypes.c_void_p:
    """The primary context of a GPU, which torch uses as well."""
    device, context = ctypes.c_int(), ctypes.c_void_p()
    _drive("cuInit", 0)
    _drive("cuDeviceGet", ctypes.byref(device), index)
    _drive("cuDevicePrimaryCtxRetain", ctypes.byref(context), device)
    return context


def _drive(name: str, *arguments: Any) -> None:
    """Calls a function of the driver.

    Raises:
        CompileError: it fails.
    """
    status = getattr(_driver(), name)(*arguments)
    if status:
        text = ctypes.c_char_p()
        _driver().cuGetErrorString(status, ctypes.byref(text))
        said = (text.value or b"").decode(errors="replace")
        raise CompileError(f"compile: {name} of the CUDA driver failed (status {status}: {said})")


@lru_cache(maxsize=1)
def _driver() -> ctypes.CDLL:
    names = ["nvcuda.dll"] if sys.platform == "win32" else ["libcuda.so.1", "libcuda.so"]
    return _library(names, "the CUDA driver", "install NVIDIA's driver")


@lru_cache(maxsize=1)
def _nvrtc() -> ctypes.CDLL:
    names = [*map(str, _in_wheels()), *(f"libnvrtc.so.{version}" for version in (13, 12, 11)), "libnvrtc.so"]
    return _library(names, "NVRTC", "it comes with torch's wheels for CUDA; else `pip install nvidia-cuda-nvrtc`")


def _in_wheels() -> Iterator[Path]:
    """The NVRTC that came with torch, as a package beside it or, on Windows, in its own folder."""
    spec = importlib.util.find_spec("nvidia")
    for folder in (spec and spec.submodule_search_locations) or ():
        for pattern in ("*/lib/libnvrtc.so.*", "*/bin/nvrtc64_*.dll", "*/bin/*/nvrtc64_*.dll"):
            yield from (path for path in sorted(Path(folder).glob(pattern)) if "alt" not in path.name)
    yield from sorted((Path(torch.__file__).parent / "lib").glob("nvrtc64_*.dll"))


def _library(names: list[str], what: str, how: str) -> ctypes.CDLL:
    reasons = []
    for name in names:
        try:
            return ctypes.CDLL(name)
        except OSError as error:
            reasons.append(str(error))
    raise CompileError(f"compile: expected {what} for filters on a GPU, found none ({'; '.join(reasons)}): {how}")


def bare(source: str) -> str:
    """A source without its lines of comments, which name lines of the step: what a kernel is known by."""
    return "".join(line for line in source.splitlines(keepends=True) if not line.lstrip().startswith("//"))
