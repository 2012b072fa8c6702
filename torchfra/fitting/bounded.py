"""Gradients of single tracks, bounded, and the rate at which they are followed."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def bounded(losses: Tensor, gradients: Tensor, clip: float | Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of which no track's moves the values further than another's may.

    Args:
        losses: ``(..., N)`` of each track.
        gradients: ``(..., N, P)``.
        clip: largest norm of one, a number or ``(..., 1 or N)``.

    Returns:
        The gradients ``(..., N, P)``, 0 for a track whose loss or gradient is NaN or infinite, and which are finite
        ``(..., N)``.
    """
    finite = losses.isfinite() & gradients.isfinite().all(-1)
    norm = torch.linalg.vector_norm(gradients, dim=-1)
    shorter = (clip / norm).clamp_max(1.0).unsqueeze(-1)
    return torch.where(finite.unsqueeze(-1), gradients * shorter, 0.0), finite


def falling(rate: float, progress: float) -> float:
    """A learning rate that falls to a tenth along half a cosine, after this part of all iterations."""
    return rate * (0.55 + 0.45 * math.cos(math.pi * progress))
