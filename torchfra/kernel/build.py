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
"""How many times the compiler was called by this process."""


class CompileError(RuntimeError):
    """There is no compiler, it failed, or there is too much to compile."""


LARGEST = 120_000
"""Operations in a step; more would take the compiler many minutes and gigabytes."""


def check(operations: int) -> None:
    """Whether a step of so many operations can be compiled.

    Raises:
        CompileError: it has too many.
    """
    if operations > LARGEST:
        said = f"{operations} operations would take many minutes and gigabytes (at most {LARGEST})"
        raise CompileError(f"compile: a step of {said}: run it without, or with fewer models")


def load(source: str) -> Any:
    """The function ``run`` of a translation unit.

    It is compiled by ``CXX`` (``g++`` unless set), ``CXXFLAGS`` behind flags of its own, unless an earlier process has
    done so already: results are kept in ``TORCHFRA_CACHE``, or ``~/.cache/torchfra``.

    Raises:
        CompileError: there is no compiler, or it fails.
    """
    compiler, version = _compiler()
    flags = FLAGS.split() + shlex.split(os.environ.get("CXXFLAGS", ""))
    said = "\n".join((source, *compiler, version, *flags, torch.__version__, _processor()))
    library = _folder() / f"{hashlib.sha256(said.encode()).hexdigest()[:32]}.so"
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
        text, made = Path(folder) / "kernel.cpp", Path(folder) / "kernel.so"
        text.write_text(source)
        brought = Path(torch.__file__).parent  # vectors and their mathematics
        link = [f"-L{brought / 'lib'}", f"-Wl,-rpath,{brought / 'lib'}", "-ltorch_cpu"]
        done = subprocess.run([*command, f"-I{brought / 'include'}", str(text), "-o", str(made), *link],
                              capture_output=True, text=True, check=False)  # fmt: skip
        if done.returncode:
            raise CompileError(f"compile: {shlex.join(command)} failed:\n{done.stderr[-2000:]}")
        compiled += 1
        os.replace(made, library)


def _folder() -> Path:
    own = os.environ.get("TORCHFRA_CACHE")
    return Path(own) if own else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torchfra"


@lru_cache(maxsize=1)
def _compiler() -> tuple[list[str], str]:
    """The compiler, and what it says it is."""
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
    """What the processor can do: what is compiled for one may not run on another."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return torch.backends.cpu.get_cpu_capability()
    return next((line for line in lines if line.startswith(("flags", "Features"))), "")
