"""The C++ compilers that make kernels: which there is, and how each is called."""

from __future__ import annotations

import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import torch

from torchfra.types import CompileError as CompileError

_FLAGS = {
    "gcc": "-O2 NATIVE -fno-math-errno -fno-trapping-math -fopenmp -shared -fPIC -std=c++20 -w",
    "clang": "-O2 NATIVE -fno-math-errno -fno-trapping-math -ffp-contract=fast -pthread -shared -fPIC -std=c++20 -w",
    "zig": "-O2 -g0 -fno-math-errno -fno-trapping-math -ffp-contract=fast -fno-sanitize=all -shared -fPIC -std=c++20",
    "msvc": "/nologo /O2 /std:c++20 /EHsc /LD /w",
}
"""Of each family.  What needs no OpenMP has threads of C++; zig takes all instructions of the processor by itself."""
_LESS = {"msvc": "/Od", "gcc": "-O1 -fexpensive-optimizations"}
"""Of large kernels; -O1 for others.  What g++ has beside it makes ``gpb`` 1.15 times as fast, and takes 6 % longer."""
_INSTALL = (
    "install g++, clang++ or, without rights of an administrator, `pip install ziglang`, or name a compiler in the "
    "environment variable CXX; without compile() the filter needs none"
)
SUFFIX = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
"""Of a library."""


class Compiler(NamedTuple):
    """A compiler that runs."""

    command: tuple[str, ...]
    version: str
    """What it reports."""

    @property
    def family(self) -> str:
        """``gcc``, ``clang``, ``zig`` or ``msvc``: how it is called."""
        name = Path(self.command[0].replace("\\", "/")).stem.lower()
        if name in ("cl", "clang-cl"):
            return "msvc"
        if self.command[-1] == "c++" and ("zig" in name or "ziglang" in self.command):
            return "zig"
        return "clang" if "clang" in self.version else "gcc"

    @property
    def wide(self) -> bool:
        """Whether it takes kernels in vectors: not on Windows, where torch keeps their mathematics to itself."""
        return self.family != "msvc" and sys.platform != "win32"

    def flags(self, large: bool = False) -> list[str]:
        """Those for a kernel; a ``large`` one is optimised less."""
        arm = platform.machine().lower() in ("arm64", "aarch64")
        text = _FLAGS[self.family].replace("NATIVE", "-mcpu=native" if arm else "-march=native")
        return text.split() + (_LESS.get(self.family, "-O1").split() if large else [])

    def to_library(self, texts: Sequence[Path], made: Path, wide: bool) -> list[str]:
        """The arguments behind the flags: from sources or objects to a library; ``wide``: it has torch's functions."""
        names = list(map(str, texts))
        if self.family == "msvc":
            return [*names, f"/Fo{made.with_suffix('.obj')}", f"/Fe{made}"]
        library = Path(torch.__file__).parent / "lib"
        return [*names, "-o", str(made), *([f"-L{library}", f"-Wl,-rpath,{library}", "-ltorch_cpu"] if wide else [])]

    def to_object(self, text: Path, made: Path, parts: int) -> list[str]:
        """The arguments behind the flags: from these parts of a source, as bits, to an object; not of ``msvc``."""
        return ["-c", f"-DPARTS={parts}", str(text), "-o", str(made)]


def find() -> Compiler:
    """What ``CXX`` names, or else the first that runs: ``g++``, ``clang++``, zig; on Windows before these ``cl``.

    Raises:
        CompileError: there is none.
    """
    if "CXX" in os.environ:
        command = tuple(words("CXX"))
        compiler, error = _runs(command)
        if compiler is None:
            name = shlex.join(command) or "''"
            raise CompileError(f"compile: expected a C++ compiler, {name} does not run ({error}): {_INSTALL}")
        return compiler
    return _first(_candidates())


def words(variable: str) -> list[str]:
    """The words of an environment variable, as in a shell; on Windows a backslash is a part of a path.

    Raises:
        CompileError: they cannot be told apart.
    """
    value, posix = os.environ.get(variable, ""), os.name == "posix"
    try:
        found = shlex.split(value, posix=posix)
    except ValueError as error:
        raise CompileError(f"compile: {variable}: expected words as in a shell, received {value!r} ({error})") from None
    return found if posix else [word.strip('"') for word in found]


def described(command: Sequence[str]) -> str:
    """A command, and which of it the user has set."""
    own = [f"{name}={os.environ[name]!r}" for name in ("CXX", "CXXFLAGS") if name in os.environ]
    return shlex.join(command) + (f" (with {' and '.join(own)})" if own else "")


def _candidates() -> tuple[tuple[str, ...], ...]:
    windows = (("cl",), ("clang-cl",)) if sys.platform == "win32" else ()
    wheel = ((sys.executable, "-m", "ziglang", "c++"),) if importlib.util.find_spec("ziglang") else ()
    named = [(name, *rest) for name, *rest in (*windows, ("g++",), ("clang++",)) if shutil.which(name)]
    return (*named, *wheel, *((("zig", "c++"),) if shutil.which("zig") else ()))


def _first(candidates: tuple[tuple[str, ...], ...]) -> Compiler:
    tried = []
    for command in candidates:
        compiler, error = _runs(command)
        if compiler is not None:
            return compiler
        tried.append(f"{shlex.join(command)} does not run ({error})")
    sought = "g++, clang++, the Python package ziglang, zig" + (", cl, clang-cl" if sys.platform == "win32" else "")
    found = "; ".join(tried) or "none is there"
    raise CompileError(f"compile: expected a C++ compiler out of {sought}; {found}: {_INSTALL}")


def _runs(command: tuple[str, ...]) -> tuple[Compiler | None, str]:
    """The compiler; None and a reason if it does not run."""
    return _asked(command, shutil.which(command[0]) if command else None)


@lru_cache(maxsize=16)
def _asked(command: tuple[str, ...], path: str | None) -> tuple[Compiler | None, str]:
    """The same, asked once for each file that the command is."""
    asks = [] if command and Path(command[0]).stem.lower() == "cl" else ["--version"]
    try:
        done = subprocess.run(
            [*command, *asks], stdin=subprocess.DEVNULL, capture_output=True, check=True, text=True, errors="replace"
        )
    except (OSError, subprocess.CalledProcessError) as error:
        return None, str(error)
    return Compiler(command, done.stdout or done.stderr), ""
