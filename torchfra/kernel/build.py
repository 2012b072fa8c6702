"""From C++ to a function: compiled once by the machine's own compiler, and kept on disk."""

from __future__ import annotations

import ctypes
import hashlib
import os
import shlex
import subprocess
import tempfile
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

FLAGS = "-O2 -march=native -fno-math-errno -fno-trapping-math -fopenmp -shared -fPIC -std=c++20 -w"
compiled = 0
"""How many times this process has called the compiler."""


class CompileError(RuntimeError):
    """There is no compiler, it failed, or there is too much to compile."""


LARGE = 30_000
"""Lines of a source from which the compiler optimises less: in half the time, for steps of many models."""
LARGEST = 120_000
"""Operations in a step; more would take the compiler many minutes and gigabytes."""


def check(operations: int) -> None:
    """Checks that a step of so many operations can be compiled.

    Raises:
        CompileError: it has too many.
    """
    if operations > LARGEST:
        raise CompileError(
            f"compile: a step of {operations} operations would take many minutes and gigabytes (at most {LARGEST}): "
            "run it without compile(), or with fewer models"
        )


def load(source: str) -> Any:
    """The function ``run`` of a translation unit.

    It is compiled by ``CXX`` (``g++`` unless set) with ``CXXFLAGS`` behind ``FLAGS``, unless an earlier process has
    done so: libraries are kept in ``TORCHFRA_CACHE``, or ``~/.cache/torchfra``.

    Raises:
        CompileError: there is no compiler, or it fails.
    """
    compiler, version = _compiler()
    less = ["-O1"] if source.count("\n") > LARGE else []
    flags = FLAGS.split() + less + shlex.split(os.environ.get("CXXFLAGS", ""))
    key = "\n".join((source, *compiler, version, *flags, torch.__version__, _processor()))
    library = _folder() / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.so"
    if not library.exists():
        _compile([*compiler, *flags], source, library)
    function = ctypes.CDLL(str(library)).run
    function.argtypes = [ctypes.c_int64, ctypes.c_int64, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p]
    function.restype = None
    return function


def compiler() -> str:
    """The command of the C++ compiler that makes kernels: ``CXX``, or ``g++``.

    Raises:
        CompileError: it does not run.
    """
    command, _ = _compiler()
    return shlex.join(command)


def _compile(command: list[str], source: str, library: Path) -> None:
    global compiled
    library.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        text, result = Path(folder) / "kernel.cpp", Path(folder) / "kernel.so"
        text.write_text(source)
        torch_folder = Path(torch.__file__).parent  # its vectors and their mathematics
        link = [f"-L{torch_folder / 'lib'}", f"-Wl,-rpath,{torch_folder / 'lib'}", "-ltorch_cpu"]
        done = subprocess.run([*command, f"-I{torch_folder / 'include'}", str(text), "-o", str(result), *link],
                              capture_output=True, text=True, check=False)  # fmt: skip
        if done.returncode:
            raise CompileError(f"compile: {shlex.join(command)} failed:\n{done.stderr[-2000:]}")
        compiled += 1
        os.replace(result, library)  # other processes see all of it or nothing


def _folder() -> Path:
    chosen = os.environ.get("TORCHFRA_CACHE")
    return Path(chosen) if chosen else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torchfra"


@lru_cache(maxsize=1)
def _compiler() -> tuple[list[str], str]:
    """The command of the compiler, and the version it reports."""
    command = shlex.split(os.environ.get("CXX", "g++"))
    try:
        return command, subprocess.run([*command, "--version"], capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError) as error:
        raise CompileError(
            f"compile: expected a C++ compiler, {shlex.join(command)} does not run ({error}): install g++, or name one "
            "in the environment variable CXX; without compile() the filter needs none"
        ) from None


@lru_cache(maxsize=1)
def _processor() -> str:
    """The instructions that the processor has: a library for one may not run on another."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return torch.backends.cpu.get_cpu_capability()
    return next((line for line in lines if line.startswith(("flags", "Features"))), "")
