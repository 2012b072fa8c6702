"""A belief that noise will pull apart, as a sum of narrower ones that a filter follows side by side.

Tracks that start on a point from which paths part to both sides are no Gaussian belief soon after.  Once noise has made
the belief wide, but while it is still Gaussian, it is cut along its longest axis, and each part is followed by itself,
weighed by the likelihood of all that is measured since.

Source: Alspach & Sorenson (1972), "Nonlinear Bayesian Estimation Using Gaussian Sum Approximations".
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.filters import Filter
from torchfra.linalg.triangular import tria
from torchfra.types import Gaussian

FIRST, PARTS, WIDEST = 15, 101, 3.0
"""Steps before the cut, parts, and how many standard deviations the outermost ones are off."""


def split(belief: Gaussian, parts: int) -> tuple[Gaussian, Tensor]:
    """Beliefs ``(..., parts, n)``, evenly apart along the longest axis, and their log weights ``(parts,)``.

    Each is as wide along it as they are apart; together they have the mean of ``belief`` and, but for the tails, its
    covariance.
    """
    variances, axes = torch.linalg.eigh(belief.covariance)
    stds = variances.clamp_min(0.0).sqrt()
    at = torch.linspace(-WIDEST, WIDEST, parts, dtype=stds.dtype)
    gap = at[1] - at[0]
    off = (1 - gap.square()).sqrt() * at.unsqueeze(-1) * (stds[..., -1:] * axes[..., -1]).unsqueeze(-2)
    narrow = tria(axes * torch.cat([stds[..., :-1], gap * stds[..., -1:]], -1).unsqueeze(-2))
    roots = narrow.unsqueeze(-3).expand(*off.shape, off.shape[-1])
    return Gaussian(belief.mean.unsqueeze(-2) + off, roots), (-at.square() / 2).log_softmax(0)


def followed(
    f: Filter, z: Tensor, prior: Gaussian, dt: float, first: int = FIRST, parts: int = PARTS
) -> tuple[Tensor, Tensor]:
    """Means ``(parts, B, T, n)`` and weights ``(parts, B, T)`` of a belief that is cut after ``first`` steps.

    Args:
        f: the filter that follows each part.
        z: ``(B, T, m)`` measurements.
        prior: the belief before the first.
        dt: seconds of a step.
        first: steps before the cut, in which all parts are one.
        parts: how many.
    """
    start = f(z[:, :first], prior, dt=dt)
    beliefs, log_weight = split(Gaussian(start.mean[:, -1], start.scale_tril[:, -1]), parts)
    each = f(z[:, None, first:].expand(-1, parts, -1, -1), beliefs, dt=dt)
    weight = (log_weight[:, None] + each.log_likelihood.cumsum(-1)).softmax(1).transpose(0, 1)
    together = log_weight.exp()[:, None, None].expand(parts, len(z), first)
    means = torch.cat([start.mean.expand(parts, *start.mean.shape), each.mean.transpose(0, 1)], -2)
    return means, torch.cat([together, weight], -1)
