"""Whether an argument is a number."""

from __future__ import annotations

from typing import Any

import torch


def real(value: Any) -> float:
    """The number that a value is; NaN for what is none, which no comparison lets pass."""
    if isinstance(value, int | float) or (isinstance(value, torch.Tensor) and value.numel() == 1):
        return float(value)
    return float("nan")


def whole(value: object, least: int) -> bool:
    """Whether a value is a whole number, ``least`` or more."""
    return isinstance(value, int) and not isinstance(value, bool) and value >= least
