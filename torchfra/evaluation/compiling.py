"""Several filters compiled at once."""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor

import torch

from torchfra.filters import Filter
from torchfra.motion.bank import Bank
from torchfra.running.progress import progress_bar
from torchfra.types import CompileError, Fallback


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
        first_call: calls a filter as later calls do, which compiles its kernel.
        fallback: called for each filter without a kernel, which is then returned as it is; None raises the error.
        progress: whether to show a bar.

    Raises:
        CompileError, NotImplementedError: a filter has no kernel, and there is no ``fallback``.
    """
    from torchfra.compiler.llvm import binding  # only where it is needed

    def attempt(f: Filter) -> Filter | CompileError | NotImplementedError:
        try:
            with torch.no_grad():  # which holds for this thread only
                binding()
                g = copy.copy(f).compile()
                first_call(g)
        except (CompileError, NotImplementedError) as error:
            return error
        return g

    order = sorted(filters, key=lambda name: not isinstance(filters[name].motion, Bank))  # the slowest to compile first
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        made = pool.map(attempt, [filters[name] for name in order])
        try:
            attempts = dict(zip(order, progress_bar(made, "kernel", progress), strict=True))
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    for name, f in attempts.items():
        if not isinstance(f, Filter):
            if fallback is None:
                raise f
            fallback(name, brief(f))
    return {name: f if isinstance(f := attempts[name], Filter) else filters[name] for name in filters}


def brief(error: Exception) -> str:
    """Why a filter does not run compiled, in one line."""
    return " ".join(str(error).removeprefix("compile: ").split())
