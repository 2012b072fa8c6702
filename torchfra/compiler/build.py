"""From C++ to a function: compiled once by the machine's own compiler, and kept on disk."""

from __future__ import annotations

import ctypes
import hashlib
import importlib
import os
import platform
import shlex
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import torch

from torchfra.compiler import cache, compilers, parts
from torchfra.compiler.compilers import CompileError as CompileError
from torchfra.compiler.compilers import Compiler

compiled = 0
"""How many libraries this process has compiled."""

LARGE = 30_000
"""Lines of a source from which the compiler optimises less: in half the time, for steps of many models."""


def load(source: str) -> Any:
    """The function ``run`` of a translation unit.

    It is compiled by the first compiler there is (see ``compilers``) with ``CXXFLAGS`` behind its flags, unless an
    earlier process has done so: libraries are kept in ``TORCHFRA_CACHE``, or ``~/.cache/torchfra`` (see ``cache``).

    Raises:
        CompileError: there is no compiler, it fails, or what it makes cannot be loaded.
    """
    return _function(source, "run", [*[ctypes.c_int64] * 2, ctypes.c_int, *[ctypes.c_void_p] * 2], None)


def load_whole(source: str) -> Any:
    """Likewise the function ``whole`` of the ends of tracks.

    Raises:
        CompileError: likewise.
    """
    arguments = [ctypes.c_void_p, *[ctypes.c_int64] * 2, ctypes.c_int, *[ctypes.c_void_p] * 3, ctypes.c_int64]
    return _function(source, "whole", arguments, ctypes.c_int)


def _function(source: str, name: str, arguments: list[Any], result: Any) -> Any:
    compiler = compilers.find()
    flags = [*compiler.flags(is_large(source)), *compilers.words("CXXFLAGS")]
    command = [*compiler.command, *flags]
    key = "\n".join((bare(source), *command, compiler.version, torch.__version__, *platform.libc_ver(), _processor()))
    library = f"{hashlib.sha256(key.encode()).hexdigest()[:32]}{compilers.SUFFIX}"
    try:
        function = getattr(cache.fetch(library) or _compile(compiler, flags, source, library), name)
    except (OSError, AttributeError) as error:
        raise CompileError(f"compile: no kernel from {compilers.described(command)}: {error}") from None
    function.argtypes, function.restype = arguments, result
    return function


def bare(source: str) -> str:
    """A source without its lines of comments, which name lines of the step: what a kernel is known by."""
    return "".join(line for line in source.splitlines(keepends=True) if not line.lstrip().startswith("//"))


def is_large(source: str) -> bool:
    """Whether the compiler optimises less, for the sake of its time."""
    return bare(source).count("\n") > LARGE


def compiler() -> str:
    """The command of the C++ compiler that makes kernels.

    Raises:
        CompileError: there is none.
    """
    return shlex.join(compilers.find().command)


def wide() -> bool:
    """Whether the compiler takes kernels for tracks side by side in vector registers; all take those for single ones.

    Raises:
        CompileError: there is none.
    """
    return compilers.find().wide


def stop() -> None:
    """Ends all compilations, whose ``load`` then raises a ``CompileError``: call it when the process ends."""
    _places().stop()


def _places() -> Any:
    """The module that has ``workplace``, ``run`` and ``stop`` on this system."""
    return importlib.import_module(f"torchfra.compiler.{'workplace' if os.name == 'posix' else 'plain_workplace'}")


def _compile(compiler: Compiler, flags: list[str], source: str, name: str) -> ctypes.CDLL:
    """The library; parts of a large source are compiled at the same time, by as many processes as there are cores."""
    global compiled
    places = _places()
    command = [*compiler.command, *flags]
    with places.workplace() as folder:

        def run(arguments: list[str], made: Path) -> None:
            status, errors = places.run([*command, *arguments], folder)
            if status or not made.exists():
                failed = f"{compilers.described(command)} failed (exit status {status})"
                raise CompileError(f"compile: {failed}:\n{errors[-2000:]}")

        text, made = folder / "kernel.cpp", folder / f"kernel{compilers.SUFFIX}"
        text.write_text(source)
        shares = parts.shares(source, 1 if compiler.family == "msvc" else _cores())
        texts = [text] if len(shares) == 1 else [folder / f"part{k}.o" for k in range(len(shares))]
        if len(shares) > 1:
            _at_once([partial(run, compiler.to_object(text, x, n), x) for x, n in zip(texts, shares, strict=True)])
        run(compiler.to_library(texts, made, "SLEEF" in source), made)
        compiled += 1
        return cache.keep(name, made)


def _at_once(calls: Sequence[Callable[[], None]]) -> None:
    """Makes all calls, each in a thread; raises what one of them raises, when all have ended."""
    with ThreadPoolExecutor(len(calls)) as threads:
        try:
            list(threads.map(lambda call: call(), calls))
        except CompileError:
            raise
        except BaseException:  # an interruption
            stop()
            raise


def _cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@lru_cache(maxsize=1)
def _processor() -> str:
    """The instructions that the processor has: a library for one may not run on another."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:  # not Linux
        return " ".join((platform.machine(), platform.processor(), torch.backends.cpu.get_cpu_capability()))
    return next((line for line in lines if line.startswith(("flags", "Features"))), "")
