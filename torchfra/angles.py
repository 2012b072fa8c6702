"""Angles, brought into (-pi, pi] or [0, 2 pi)."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def wrap(angle: Tensor) -> Tensor:
    """The same angle between -pi and pi, rad; half a turn, which both ends are, is pi but for rounding."""
    return angle - 2 * math.pi * _turns(angle)


def near(angle: Tensor, other: Tensor) -> Tensor:
    """The same angle within half a turn of another, rad; as it is where it is already."""
    return angle - 2 * math.pi * _turns(angle - other)


def _turns(angle: Tensor) -> Tensor:
    """Whole turns in an angle.

    A point behind a station is half a turn from one in front of it, and with round numbers exactly so.  Rounding must
    not decide which way round: the cut lies beside that, by far more than rounding, where nothing else lies.
    """
    return torch.round(angle / (2 * math.pi) - torch.finfo(angle.dtype).eps ** (2 / 3))


def turned(azimuth: Tensor) -> Tensor:
    """The same azimuth in [0, 2 pi)."""
    turn = 2 * math.pi
    positive = azimuth - turn * torch.floor(azimuth / turn)
    return torch.where(positive >= turn, positive - turn, positive)  # rounding makes a whole turn of just below 0
