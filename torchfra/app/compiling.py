"""Which filters of a command run as compiled kernels."""

from __future__ import annotations

import argparse
import copy
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor

import torch

from torchfra.app.progress import progress_bar
from torchfra.cleaning.others import Fallback
from torchfra.filters import Filter
from torchfra.motion.bank import Bank
from torchfra.types import CompileError


def add_compile_option(parser: argparse.ArgumentParser, default: str) -> None:
    """Adds ``--compile`` and ``--no-compile``; ``default`` says when filters compile without either."""
    text = f"run compiled kernels; each takes seconds to compile, once (default: {default}, if there is a C++ compiler)"
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
        wanted: by the user: True, False, or None for what is best.
        worthwhile: whether there is so much to compute that compiling, which takes seconds per filter, saves time.
        tell: called with a line for the user.

    Raises:
        CompileError: it is wanted, and there is no compiler.
    """
    if wanted is False or (wanted is None and not worthwhile):
        return False
    from torchfra.compiler.build import compiler  # only where it is needed

    try:
        name = compiler()
    except CompileError as error:
        if wanted:
            raise
        tell(f"filters run interpreted ({_brief(error)})")
        return False
    tell(f"compiled kernels ({name}); --no-compile runs without")
    return True


def compiled(
    filters: Mapping[str, Filter],
    first_call: Callable[[Filter], object],
    *,
    fallback: Fallback | None = None,
    progress: bool = False,
) -> dict[str, Filter]:
    """Shallow copies of filters that run as compiled kernels; compiles several at once.

    Args:
        filters: by name.
        first_call: calls a filter in the way it will be called, so that its kernel is made.
        fallback: called for each filter that has no kernel, or one that is slow to compile, which is then returned as
            it is; with None they are all compiled, and one without a kernel raises the error.
        progress: whether to show a bar.

    Raises:
        CompileError, NotImplementedError: a filter has no kernel, and there is no ``fallback``.
    """

    def attempt(f: Filter) -> Filter | CompileError | NotImplementedError:
        if fallback is not None and f.slow_to_compile:
            return CompileError("its kernel takes long to compile; --compile makes it")
        try:
            with torch.no_grad():  # which holds for this thread only
                g = copy.copy(f).compile()
                first_call(g)
        except (CompileError, NotImplementedError) as error:
            return error
        return g

    order = sorted(filters, key=lambda name: not isinstance(filters[name].motion, Bank))  # what takes longest first
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        made = pool.map(attempt, [filters[name] for name in order])
        try:
            attempts = dict(zip(order, progress_bar(made, "kernel", progress), strict=True))
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            from torchfra.compiler.build import stop

            stop()
            raise
    for name, f in attempts.items():
        if not isinstance(f, Filter):
            if fallback is None:
                raise f
            fallback(name, _brief(f))
    return {name: f if isinstance(f := attempts[name], Filter) else filters[name] for name in filters}


def _brief(error: Exception) -> str:
    return " ".join(str(error).removeprefix("compile: ").split())
