"""The time for which a sensor has been faulty."""

from __future__ import annotations

import torch
from torch import Tensor

LIKELY = 0.5
"""Probability above which a measurement is more likely wrong than right."""


def faulty_seconds(duration: Tensor, was: Tensor, now: Tensor, dt: Tensor) -> Tensor:
    """Seconds ``(..., B)`` since the first of the measurements in a row that are more likely wrong than right.

    Args:
        duration: ``(..., B)`` these seconds at the step before.
        was: ``(..., B)`` probability at the step before that the last measurement is wrong.
        now: ``(..., B)`` probability after this step that the last measurement is wrong.
        dt: ``(...)`` seconds between the two steps.

    Returns:
        0 at the first such measurement, and where the last measurement is more likely right.
    """
    return torch.where((was > LIKELY) & (now > LIKELY), duration + dt.unsqueeze(-1), 0.0)
