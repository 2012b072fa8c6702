"""Whether code is being executed or traced."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from torch import Tensor


def is_traced(*tensors: Tensor) -> bool:
    """Whether this runs under ``torch.compile``, ``torch.export``, a transform of ``torch.func`` or ``elementary``.

    There a Python branch must not depend on the values of tensors.
    """
    wrapped = torch._C._functorch.is_functorch_wrapped_tensor
    return bool(torch.compiler.is_compiling()) or is_elementary() or any(wrapped(t) for t in tensors)


_elementary: ContextVar[bool] = ContextVar("elementary", default=False)


@contextmanager
def elementary() -> Iterator[None]:
    """Inside this context, decompositions run as loops of elementary arithmetic, which ``torchfra.kernel`` records."""
    token = _elementary.set(True)
    try:
        yield
    finally:
        _elementary.reset(token)


def is_elementary() -> bool:
    """Whether this runs inside the context of ``elementary``."""
    return not torch.compiler.is_compiling() and _elementary.get()
