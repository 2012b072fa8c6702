"""Angles, brought into (-pi, pi] or [0, 2 pi)."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def wrap(angle: Tensor) -> Tensor:
    """The same angle between -pi and pi, rad."""
    return angle - 2 * math.pi * torch.round(angle / (2 * math.pi))


def near(angle: Tensor, other: Tensor) -> Tensor:
    """The same angle within half a turn of another, rad; as it is where it is already."""
    return angle - 2 * math.pi * torch.round((angle - other) / (2 * math.pi))


def turned(azimuth: Tensor) -> Tensor:
    """The same azimuth in [0, 2 pi)."""
    turn = 2 * math.pi
    positive = azimuth - turn * torch.floor(azimuth / turn)
    return torch.where(positive >= turn, positive - turn, positive)  # rounding makes a whole turn of just below 0
