"""What tells tensors of one form from others."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import torch
from torch import Tensor

_HOOKS: Any = getattr(getattr(torch._C, "_autograd", None), "_top_saved_tensors_default_hooks", None)
"""It is private: versions may differ."""


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


def hooked() -> bool:
    """Whether what is saved for a gradient pass may come back otherwise: stored elsewhere, or computed anew.

    True also where torch does not tell.
    """
    return _HOOKS is None or _HOOKS(False) is not None


def _form(x: Tensor) -> Hashable:
    if not isinstance(x, Tensor):
        return type(x)
    return type(x), x.dtype, x.device, x.shape, x.stride(), x.requires_grad, x.is_neg(), x.is_conj(), x._is_zerotensor()


def savable(x: Tensor) -> Tensor:
    """The tensor, or a copy of one that was made in inference mode, which autograd saves for no gradient pass."""
    return x.clone() if x.is_inference() else x
