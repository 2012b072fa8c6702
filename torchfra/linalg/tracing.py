"""Whether code is being executed or traced."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.autograd import forward_ad


def is_traced(*tensors: Tensor) -> bool:
    """Whether this runs under ``torch.compile``, ``torch.export``, a transform of ``torch.func`` or ``elementary``.

    There a Python branch must not depend on the values of tensors.
    """
    if torch.compiler.is_compiling() or _elementary.get():
        return True
    return bool(tensors) and any(map(torch._C._functorch.is_functorch_wrapped_tensor, tensors))


def has_tangents() -> bool:
    """Whether this runs in forward-mode differentiation, inside of ``torch.autograd.forward_ad.dual_level``."""
    return not torch.compiler.is_compiling() and forward_ad._current_level >= 0


_elementary: ContextVar[bool] = ContextVar("elementary", default=False)
_caller: ContextVar[Callable[..., Any] | None] = ContextVar("caller", default=None)
F = TypeVar("F", bound=Callable[..., Any])


def is_plain(x: Tensor) -> bool:
    """Whether only the numbers of a tensor are wanted: no derivative in any mode, and no code that is traced."""
    if x.requires_grad or torch.compiler.is_compiling() or _elementary.get() or forward_ad._current_level >= 0:
        return False
    return not torch._C._functorch.is_functorch_wrapped_tensor(x)


@contextmanager
def elementary(caller: Callable[..., Any] | None = None) -> Iterator[None]:
    """Inside this context, decompositions run as loops of elementary arithmetic, entry by entry.

    Args:
        caller: runs functions marked ``batchwise``; it is called with the function, its ranks and its tensors.
    """
    tokens = _elementary.set(True), _caller.set(caller)
    try:
        yield
    finally:
        _elementary.reset(tokens[0])
        _caller.reset(tokens[1])


def batchwise(*ranks: int) -> Callable[[F], F]:
    """Declares that a function of tensors acts on each entry of the batch alike, as NumPy's ``gufunc`` does.

    Every result has the full batch.  Inside of ``elementary`` the caller of that context runs the function.

    Args:
        ranks: number of event dimensions of each argument; the last arguments are optional.
    """

    def decorate(function: F) -> F:
        @wraps(function)
        def call(*tensors: Tensor) -> Any:
            caller = None if torch.compiler.is_compiling() else _caller.get()
            return function(*tensors) if caller is None else caller(function, ranks[: len(tensors)], tensors)

        return call  # type: ignore[return-value]

    return decorate


def has_caller() -> bool:
    """Whether functions marked ``batchwise`` are called, once for each entry of the batch."""
    return not torch.compiler.is_compiling() and _caller.get() is not None


now_elementary = _elementary.get
"""Whether this runs inside the context of ``elementary``, for code that ``torch.compile`` does not look into."""


def is_elementary() -> bool:
    """Whether this runs inside the context of ``elementary``."""
    return not torch.compiler.is_compiling() and _elementary.get()
