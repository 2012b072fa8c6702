"""Copies of modules: ones that nobody changes, and ones that have other tensors for their values."""

from __future__ import annotations

import copy
from typing import Any

from torch import Tensor, nn


def frozen(module: nn.Module, memo: dict[int, nn.Module] | None = None) -> nn.Module:
    """A copy that no later change of the module reaches.

    Tensors without a gradient, lists, dictionaries and sets are copied, tensors to the CPU, where traces are made;
    everything else is shared.
    """
    memo = {} if memo is None else memo
    if id(module) not in memo:
        new = memo[id(module)] = module.__new__(type(module))
        new.__dict__.update({key: _copied(x) for key, x in module.__dict__.items()})
        new.__dict__["_buffers"] = {key: _copied(x) for key, x in module._buffers.items()}
        new.__dict__["_modules"] = {key: x and frozen(x, memo) for key, x in module._modules.items()}
    return memo[id(module)]


def _copied(x: Any) -> Any:
    if isinstance(x, Tensor):
        return x if x.requires_grad else x.detach().cpu().clone()
    return copy.copy(x) if isinstance(x, list | dict | set) else x


def put_in_place(module: nn.Module, path: str, x: Tensor) -> None:
    """Puts a tensor in the place of the parameter, buffer or number of this path."""
    owner, _, key = path.rpartition(".")
    part = module.get_submodule(owner)
    part._parameters.pop(key, None)
    (part.__dict__ if key in part.__dict__ else part._buffers)[key] = x
