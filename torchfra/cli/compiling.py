"""The choice of a command to run filters as compiled kernels."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from torchfra.types import CompileError, Fallback


def add_compile_option(parser: argparse.ArgumentParser, default: str) -> None:
    """Adds ``--compile`` and ``--no-compile``; ``default`` says when filters compile without either."""
    text = f"run compiled kernels; each takes seconds to compile, once (default: {default}, if llvmlite is installed)"
    parser.add_argument("--compile", action=argparse.BooleanOptionalAction, help=text)


def reporters(wanted: bool | None, quiet: bool) -> tuple[Callable[[str], None], Fallback | None]:
    """``tell`` and ``fallback`` of a command: they print lines, unless ``quiet``.

    There is no fallback where compiled kernels are wanted: a filter without one is then an error.
    """

    def tell(line: str) -> None:
        if not quiet:
            print(line, flush=True)

    def fallback(name: str, reason: str) -> None:
        tell(f"{name} runs interpreted ({reason})")

    return tell, None if wanted else fallback


def choose(wanted: bool | None, worthwhile: bool, tell: Callable[[str], None]) -> bool:
    """Whether a command compiles its filters.

    Args:
        wanted: the choice of the user: True, False, or None for that by ``worthwhile``.
        worthwhile: whether compiling, which takes seconds per filter, saves time.
        tell: called with a line for the user.

    Raises:
        CompileError: ``wanted`` is True, and llvmlite is not installed.
    """
    if wanted is False or (wanted is None and not worthwhile):
        return False
    from torchfra.compiler.llvm import binding  # llvmlite is optional

    try:
        version = ".".join(map(str, binding().llvm_version_info))
    except CompileError as error:
        if wanted:
            raise
        tell(f"filters run interpreted ({' '.join(str(error).removeprefix('compile: ').split())})")
        return False
    tell(f"compiled kernels (LLVM {version}); --no-compile runs without")
    return True
