"""Targets against the measurements of a scan: batches ``(..., N)``, ``(..., N, 1)`` and ``(..., N, J)``."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchfra.adaptive.fading import Memory
from torchfra.linalg.tracing import is_traced
from torchfra.sensors.base import MeasurementNoise
from torchfra.types import Gaussian, Whitened


def column(x: Any) -> Any:
    """Targets ``(..., N)`` against measurements, ``(..., N, 1)``: a belief, or what an adaptive side remembers."""
    if isinstance(x, Gaussian):
        return Gaussian(x.mean.unsqueeze(-2), x.scale_tril.unsqueeze(-3))
    return type(x)(*(part.unsqueeze(-3 if isinstance(x, Memory) else -2) for part in x))


def flat(x: Any) -> Any:
    """And back, of what an adaptive side remembers."""
    return type(x)(*(part.squeeze(-3 if isinstance(x, Memory) else -2) for part in x))


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
    chances = _taken(log_weights[..., 1:], 0, order, inside.shape)
    return torch.cat([log_weights[..., :1], chances], -1), _chosen(whitened, order, inside.shape)


def likeliest(share: Tensor, whitened: Whitened) -> Whitened:
    """Of the measurements ``(..., N, J)`` the one with the largest ``share (..., N, J)``, ``(..., N, 1)``."""
    return _chosen(whitened, share.argmax(-1, keepdim=True), share.shape)


def _chosen(whitened: Whitened, order: Tensor, shape: torch.Size) -> Whitened:
    """Of measurements ``shape = (..., N, J)`` those whose numbers are in ``order (..., N, K)``."""
    residual, spread = (_taken(x, event, order, shape) for x, event in ((whitened.residual, 1), (whitened.spread, 2)))
    lost = None if whitened.lost is None else _taken(whitened.lost, 2, order, shape)
    return Whitened(residual, spread, whitened.reads, lost)


def _taken(x: Tensor, event: int, order: Tensor, shape: torch.Size) -> Tensor:
    own = x.shape[x.dim() - event :]
    rows = order[(..., *[None] * event)].expand(*order.shape, *own)
    return x.expand(*shape, *own).gather(-event - 1, rows)


def combined(
    share: Tensor, residual: Tensor, root: Tensor, normalised: Tensor, noise: MeasurementNoise
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
