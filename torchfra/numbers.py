"""Whether an argument is a number."""

from __future__ import annotations

from typing import Any

import torch


def as_number(value: Any) -> float:
    """The value as a number; NaN for anything that is not a number, so that every comparison fails."""
    if isinstance(value, int | float) or (isinstance(value, torch.Tensor) and value.numel() == 1):
        return float(value)
    return float("nan")


def is_integer(value: object, least: int) -> bool:
    """Whether a value is a whole number, ``least`` or more."""
    return isinstance(value, int) and not isinstance(value, bool) and value >= least
