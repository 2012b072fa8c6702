"""Since when a sensor is faulty."""

from __future__ import annotations

import torch
from torch import Tensor

LIKELY = 0.5
"""Probability above which what is measured is more likely wrong than right."""


def lasting(lasted: Tensor, was: Tensor, now: Tensor, dt: Tensor) -> Tensor:
    """Seconds ``(..., B)`` since the first of the measurements in a row that are more likely wrong than right.

    Args:
        lasted: ``(..., B)`` the same at the step before.
        was: ``(..., B)`` probability that what was measured last then was wrong.
        now: ``(..., B)`` the same after this step.
        dt: ``(...)`` seconds between the two.

    Returns:
        0 at the first of them, and where what is measured is right.
    """
    return torch.where((was > LIKELY) & (now > LIKELY), lasted + dt.unsqueeze(-1), 0.0)
