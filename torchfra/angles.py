"""Angles: the same one within half a turn, or within a whole one."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def wrap(angle: Tensor) -> Tensor:
    """The same angle within half a turn either way, rad."""
    return angle - 2 * math.pi * torch.round(angle / (2 * math.pi))


def turned(azimuth: Tensor) -> Tensor:
    """The same azimuth in [0, 2 pi)."""
    whole = 2 * math.pi
    positive = azimuth - whole * torch.floor(azimuth / whole)
    return torch.where(positive >= whole, positive - whole, positive)  # what rounding makes of next to nothing below 0
