"""From C++ to a function: compiled once by the machine's own compiler, and kept on disk."""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shlex
import subprocess
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from torchfra.kernel import cache

FLAGS = "-O2 -march=native -fno-math-errno -fno-trapping-math -fopenmp -shared -fPIC -std=c++20 -w"
compiled = 0
"""How many times this process has called the compiler."""


class CompileError(RuntimeError):
    """There is no compiler, it failed, or there is too much to compile."""


LARGE = 30_000
"""Lines of a source from which the compiler optimises less: in half the time, for steps of many models."""


def load(source: str) -> Any:
    """The function ``run`` of a translation unit.

    It is compiled by ``CXX`` (``g++`` unless set) with ``CXXFLAGS`` behind ``FLAGS``, unless an earlier process has
    done so: libraries are kept in ``TORCHFRA_CACHE``, or ``~/.cache/torchfra`` (see ``cache``).

    Raises:
        CompileError: there is no compiler, it fails, or what it makes cannot be loaded.
    """
    compiler, version = _compiler(*_words("CXX", "g++"))
    less = ["-O1"] if source.count("\n") > LARGE else []
    command = [*compiler, *FLAGS.split(), *less, *_words("CXXFLAGS", "")]
    key = "\n".join((source, *command, version, torch.__version__, *platform.libc_ver(), _processor()))
    name = f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.so"
    try:
        function = (cache.fetch(name) or _compile(command, source, name)).run
    except (OSError, AttributeError) as error:
        raise CompileError(f"compile: no kernel from {_described(command)}: {error}") from None
    function.argtypes = [ctypes.c_int64, ctypes.c_int64, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p]
    function.restype = None
    return function


def compiler() -> str:
    """The command of the C++ compiler that makes kernels: ``CXX``, or ``g++``.

    Raises:
        CompileError: it does not run.
    """
    command, _ = _compiler(*_words("CXX", "g++"))
    return shlex.join(command)


def stop() -> None:
    """Ends all compilations of this process, whose ``load`` then raises a ``CompileError``: for one that ends."""
    from torchfra.kernel import workplace

    workplace.stop()


def _compile(command: list[str], source: str, name: str) -> ctypes.CDLL:
    from torchfra.kernel.workplace import run, workplace  # not on every system, nor are kernels

    global compiled
    with workplace() as folder:
        text, made = folder / "kernel.cpp", folder / "kernel.so"
        text.write_text(source)
        torch_folder = Path(torch.__file__).parent  # its vectors and their mathematics
        link = [f"-L{torch_folder / 'lib'}", f"-Wl,-rpath,{torch_folder / 'lib'}", "-ltorch_cpu"]
        status, errors = run([*command, f"-I{torch_folder / 'include'}", str(text), "-o", str(made), *link], folder)
        if status or not made.exists():
            raise CompileError(f"compile: {_described(command)} failed (exit status {status}):\n{errors[-2000:]}")
        compiled += 1
        return cache.keep(name, made)


def _words(variable: str, default: str) -> list[str]:
    """The words of an environment variable.

    Raises:
        CompileError: they cannot be told apart.
    """
    value = os.environ.get(variable, default)
    try:
        return shlex.split(value)
    except ValueError as error:
        raise CompileError(f"compile: {variable}: expected words as in a shell, received {value!r} ({error})") from None


def _described(command: list[str]) -> str:
    """A command, and which of it the user has set."""
    own = [f"{name}={os.environ[name]!r}" for name in ("CXX", "CXXFLAGS") if name in os.environ]
    return shlex.join(command) + (f" (with {' and '.join(own)})" if own else "")


@lru_cache(maxsize=8)
def _compiler(*command: str) -> tuple[tuple[str, ...], str]:
    """The command of the compiler, and the version it reports."""
    try:
        version = subprocess.run(
            [*command, "--version"], stdin=subprocess.DEVNULL, capture_output=True, check=True, text=True,
            errors="replace",
        )  # fmt: skip
    except (OSError, subprocess.CalledProcessError) as error:
        name = shlex.join(command) or "''"
        raise CompileError(
            f"compile: expected a C++ compiler, {name} does not run ({error}): install g++, or name one in the "
            "environment variable CXX; without compile() the filter needs none"
        ) from None
    return command, version.stdout


@lru_cache(maxsize=1)
def _processor() -> str:
    """The instructions that the processor has: a library for one may not run on another."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return torch.backends.cpu.get_cpu_capability()
    return next((line for line in lines if line.startswith(("flags", "Features"))), "")
