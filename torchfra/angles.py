"""Angles, brought into (-pi, pi] or [0, 2 pi)."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def wrap(angle: Tensor) -> Tensor:
    """An angle brought into (-pi, pi], rad; up to rounding, half a turn of either sign becomes pi."""
    return angle - 2 * math.pi * _turns(angle)


def near(angle: Tensor, other: Tensor) -> Tensor:
    """An angle shifted by whole turns to within half a turn of another, rad; unchanged where it is there already."""
    return angle - 2 * math.pi * _turns(angle - other)


def _turns(angle: Tensor) -> Tensor:
    """Whole turns in an angle.

    A point behind a station is half a turn from one in front of it, and with round numbers exactly so.  Rounding must
    not decide which way round: the cut lies beside that, by far more than rounding, where nothing else lies.
    """
    return torch.round(angle / (2 * math.pi) - torch.finfo(angle.dtype).eps ** (2 / 3))


def turned(azimuth: Tensor) -> Tensor:
    """An azimuth brought into [0, 2 pi), rad."""
    turn = 2 * math.pi
    positive = azimuth - turn * torch.floor(azimuth / turn)
    return torch.where(positive >= turn, positive - turn, positive)  # rounding makes a whole turn of just below 0
