"""What tells tensors of one form from others."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Hashable, Sequence
from typing import Any

from torch import Tensor


def guard(tensors: Sequence[Tensor]) -> Callable[..., bool]:
    """What says whether other tensors have the form of these: torch's own, in C++, or a slower one of ours."""
    sizes, strides = [list(x.shape) for x in tensors], [list(x.stride()) for x in tensors]
    try:
        guards: Any = importlib.import_module("torch._C._dynamo.guards").TensorGuards
        check: Callable[..., bool] = guards(*tensors, dynamic_dims_sizes=sizes, dynamic_dims_strides=strides).check
    except (ImportError, AttributeError, TypeError):  # it is private: versions may differ
        forms = [_form(x) for x in tensors]
        return lambda *others: [_form(x) for x in others] == forms
    return check


def _form(x: Tensor) -> Hashable:
    if not isinstance(x, Tensor):
        return type(x)
    return type(x), x.dtype, x.device, x.shape, x.stride(), x.requires_grad, x.is_neg(), x.is_conj(), x._is_zerotensor()
