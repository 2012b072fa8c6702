"""Arguments that should be numbers."""

from __future__ import annotations

from numbers import Integral, Real
from typing import Any

import torch
from torch import Tensor


def as_number(value: Any) -> float:
    """The value as a number; NaN for anything that is not a number, so that every comparison fails."""
    if isinstance(value, Real) or (isinstance(value, Tensor) and value.numel() == 1):
        return float(value)
    return float("nan")


def is_integer(value: object, least: int) -> bool:
    """Whether a value is a whole number of Python or numpy, ``least`` or more."""
    return isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= least


def as_numbers(value: Any, name: str) -> Tensor:
    """Numbers as a floating-point tensor; all but floating-point tensors become float64.

    Raises:
        ValueError: the value is not numeric.
    """
    try:
        values = value if isinstance(value, Tensor) else torch.as_tensor(value, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(f"{name}: expected numbers, received {value!r}") from None
    return values if values.is_floating_point() else values.double()
