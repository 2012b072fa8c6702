"""Choosing per track: between two results, or whether to compute a result at all."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchfra.adaptive.fading import Memory
from torchfra.gaussian.inputs import Frame
from torchfra.motion.base import Adaptation
from torchfra.sensors.base import MeasurementNoise
from torchfra.types import Gaussian, Prediction, Whitened

# Dimensions of one track's entry in each field; what is more are batch dimensions.  None: not a tensor.
_EVENT: dict[type, tuple[Any, ...]] = {
    Gaussian: (1, 2),
    Prediction: (Gaussian, 2, 2, 0),
    Whitened: (1, 2, None, 2),
    Memory: (2, 2),
    MeasurementNoise: (1, 1, 2, 2, 0),
    Adaptation: (2, 1, 1),
    Frame: (1, 1, MeasurementNoise, 0, 1, 2, 1, 2, Adaptation),
}


def select(mask: Tensor, yes: Any, no: Any) -> Any:
    """``yes`` where ``mask (...)``, else ``no``: tensors that begin with the batch, or tuples of them."""
    if isinstance(yes, Tensor):
        mask = mask.reshape(mask.shape + (1,) * (max(yes.dim(), no.dim()) - mask.dim()))
        return torch.where(mask, yes, no)
    parts = [select(mask, a, b) for a, b in zip(yes, no, strict=True)]
    return type(yes)(*parts) if hasattr(yes, "_fields") else tuple(parts)


def where_needed(mask: Tensor, function: Callable[..., Any], arguments: tuple[Any, ...], default: Any) -> Any:
    """``function(*arguments)`` for the tracks in ``mask (...)`` alone, ``default`` for the others.

    The arguments are tuples of this package or vectors ``(..., m)``; ``function`` gives what ``default`` is: tensors
    that begin with the batch, or tuples of them.  Tracks are gathered, so this is for code that runs eagerly.
    """
    rows = mask.flatten().nonzero().squeeze(-1)
    if len(rows) == 0:
        return default
    result = function(*(_gather(x, 1 if isinstance(x, Tensor) else type(x), mask, rows) for x in arguments))
    return _scatter(result, default, mask, rows)


def _gather(x: Any, event: Any, mask: Tensor, rows: Tensor) -> Any:
    if event in _EVENT and x is not None:
        return type(x)(*(_gather(part, e, mask, rows) for part, e in zip(x, _EVENT[event], strict=True)))
    if not isinstance(x, Tensor) or x.dim() == event:
        return x  # shared by all tracks
    shape = x.shape[x.dim() - event :]
    return x.expand(mask.shape + shape).reshape((-1, *shape))[rows]


def _scatter(values: Any, default: Any, mask: Tensor, rows: Tensor) -> Any:
    if isinstance(values, Tensor):
        shape = default.shape[mask.dim() :]
        return default.reshape((-1, *shape)).index_put((rows,), values).reshape(default.shape)
    parts = [_scatter(v, d, mask, rows) for v, d in zip(values, default, strict=True)]
    return type(default)(*parts) if hasattr(default, "_fields") else tuple(parts)
