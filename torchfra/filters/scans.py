"""Targets against the measurements of a scan: batches ``(..., N)``, ``(..., N, 1)`` and ``(..., N, J)``."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchfra.adaptive import NoiseMemory
from torchfra.linalg import is_traced
from torchfra.sensors import Noise
from torchfra.types import Gaussian, Whitened


def column(x: Any) -> Any:
    """Targets ``(..., N)`` against measurements, ``(..., N, 1)``: a belief, or a memory of the noise."""
    if isinstance(x, Gaussian):
        return Gaussian(x.mean.unsqueeze(-2), x.scale_tril.unsqueeze(-3))
    return type(x)(*(part.unsqueeze(-2) for part in x))


def flat(x: NoiseMemory) -> NoiseMemory:
    """And back."""
    return NoiseMemory(*(part.squeeze(-2) for part in x))


def first(predicted: Gaussian, each: Gaussian) -> Gaussian:
    """All that may have happened, ``(J + 1, ..., N)``: missed, or any one of the measurements ``(..., N, J)``."""
    mean = torch.cat([predicted.mean.expand_as(each.mean[..., :1, :]), each.mean], -2)
    root = torch.cat([predicted.scale_tril.expand_as(each.scale_tril[..., :1, :, :]), each.scale_tril], -3)
    return Gaussian(mean.movedim(-2, 0), root.movedim(-3, 0))


def gated(log_weights: Tensor, whitened: Whitened) -> tuple[Tensor, Whitened]:
    """Only as many of the measurements ``(..., N, J)`` as the fullest gate holds; all of them where code is traced.

    Args:
        log_weights: ``(..., N, J + 1)`` of the target being missed, and of each measurement.
        whitened: the measurements.
    """
    inside = log_weights[..., 1:] > -torch.inf
    if is_traced(log_weights) or inside.numel() == 0:
        return log_weights, whitened
    most = max(int(inside.sum(-1).amax()), 1)
    if most == inside.shape[-1]:
        return log_weights, whitened
    order = inside.to(torch.int8).argsort(dim=-1, descending=True, stable=True)[..., :most]

    def taken(x: Tensor | None, event: int) -> Any:
        if x is None:
            return None
        shape = x.shape[x.dim() - event :]
        rows = order[(..., *[None] * event)].expand(*order.shape, *shape)
        return x.expand(*inside.shape, *shape).gather(-event - 1, rows)

    few = Whitened(taken(whitened.residual, 1), taken(whitened.spread, 2), whitened.reads, taken(whitened.lost, 2))
    return torch.cat([log_weights[..., :1], taken(log_weights[..., 1:], 0)], -1), few


def combined(
    share: Tensor, residual: Tensor, root: Tensor, normalised: Tensor, noise: Noise
) -> tuple[Tensor, Tensor, Tensor]:
    """What all measurements together say, in their own units, by the probabilities ``share (..., N, J)``.

    Args:
        share: that each is the target's own.
        residual: ``(..., N, J, m)`` in units of the noise.
        root: ``(..., N, J, m, m)`` of its covariance, in units of the noise.
        normalised: ``(..., N, J, m)`` residual divided by its root.
        noise: of each measurement.

    Returns:
        The weighted innovation ``(..., N, m)``, the root of the likeliest one's covariance, and the weighted normalised
        innovation.
    """
    weight, likeliest = share.unsqueeze(-1), share.argmax(-1)[..., None, None, None]
    coloured, root = noise.colour(residual.unsqueeze(-1)).squeeze(-1), noise.colour(root)
    root = root.expand(*share.shape, *root.shape[-2:])
    own = root.gather(-3, likeliest.expand(*share.shape[:-1], 1, *root.shape[-2:])).squeeze(-3)
    return (weight * coloured).sum(-2), own, (weight * normalised).sum(-2)
