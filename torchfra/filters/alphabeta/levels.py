"""Levels of the bank: shares that say which one is in use, and what each level's gains lead to."""

from __future__ import annotations

from functools import reduce

import torch
from torch import Tensor

from torchfra.filters.alphabeta import gains as design
from torchfra.filters.alphabeta.axes import three_gain_root, two_gain_root
from torchfra.filters.alphabeta.gains import Gains


def one_level(place: int, level: Tensor) -> Tensor:
    """Shares ``(N,)`` of a single level."""
    return torch.eye(level.shape[-1], dtype=level.dtype, device=level.device)[place]


def of_level(level: Tensor, values: Tensor) -> Tensor:
    """Values ``(..., g)`` of the level in use, from those ``(..., N)`` of all levels and its shares ``(..., g, N)``."""
    parts = [level[..., i] * values[..., i].unsqueeze(-1) for i in range(level.shape[-1])]
    return reduce(torch.add, parts)  # many times faster than a sum over so few


def steady_states(alpha: Tensor, beta: Tensor, gamma: Tensor | None) -> tuple[list[Tensor], Tensor]:
    """Entries of each level's covariance root, ``(..., N)`` each, and the variance ``(..., N)`` of its residuals."""
    entries, variance = two_gain_root(alpha, beta)
    if gamma is None:
        return entries, variance
    has_gamma = gamma > 0
    three, wider = three_gain_root(alpha, beta, torch.where(has_gamma, gamma, 0.1 * beta))
    both = zip([*entries, *[torch.zeros_like(alpha)] * 3], three, strict=True)
    return [torch.where(has_gamma, b, a) for a, b in both], torch.where(has_gamma, wider, variance)


def all_stable(gains: Gains) -> bool:
    """Whether every level is stable; one whose ``gamma`` is 0 has two gains."""
    alpha, beta, gamma = gains
    if gamma is None:
        return design.stable(gains)
    two = gamma == 0
    parts = [Gains(alpha[two], beta[two])] if bool(two.any()) else []
    parts += [Gains(alpha[~two], beta[~two], gamma[~two])] if bool((~two).any()) else []
    return all(map(design.stable, parts))
