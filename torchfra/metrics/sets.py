"""Distances between sets of targets and of estimates."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.metrics.lives import least_cost


class OSPA(NamedTuple):
    """Optimal subpattern assignment distance, m, and its parts: their ``order``-th powers add up to the distance's."""

    distance: Tensor
    """``(..., T)``."""
    localisation: Tensor
    """The part of the distances between estimates and the targets they are assigned to, ``(..., T)``."""
    cardinality: Tensor
    """The part of estimates that are too many or too few, ``(..., T)``."""


class GOSPA(NamedTuple):
    """Generalised OSPA distance, m, and its parts: their ``order``-th powers add up to the distance's."""

    distance: Tensor
    """``(..., T)``."""
    localisation: Tensor
    """The part of the distances between estimates and the targets they are assigned to, ``(..., T)``."""
    missed: Tensor
    """The part of targets without an estimate, ``(..., T)``."""
    false: Tensor
    """The part of estimates without a target, ``(..., T)``."""


def ospa(mean: Tensor, truth: Tensor, states: slice, *, cutoff: float = 100.0, order: float = 2.0) -> OSPA:
    """Distance between sets of targets and of estimates, per target.

    Args:
        mean: ``(..., N, T, n)`` estimates; NaN for one that does not exist.
        truth: ``(..., M, T, n)``; NaN for one that does not exist.
        states: the components to compare, ``scenario.position`` say; where that raises, ``scenario.truth_position``
            after ``scenario.cartesian``.
        cutoff: distance that an estimate without a target, or a target without an estimate, counts as, m.
        order: exponent of the mean; with a high one the largest distances count more.

    Returns:
        Distance and parts, ``(..., T)``; 0 where there are neither targets nor estimates.

    Raises:
        ImportError: scipy is not installed.
        ValueError: a cutoff that is not above 0, an order below 1, infinite ones, or shapes that do not match.

    Source: Schuhmacher, Vo & Vo (2008), "A Consistent Metric for Performance Evaluation of Multi-Object Filters".
    """
    pairs, estimates, targets = _pairs(mean, truth, states, cutoff, order)
    largest = torch.maximum(estimates, targets)
    localisation = _assigned(pairs, cutoff**order)[0] / largest.clamp_min(1)
    cardinality = cutoff**order * (largest - torch.minimum(estimates, targets)) / largest.clamp_min(1)
    return OSPA(*((x ** (1 / order)) for x in (localisation + cardinality, localisation, cardinality)))


def gospa(mean: Tensor, truth: Tensor, states: slice, *, cutoff: float = 100.0, order: float = 2.0) -> GOSPA:
    """Distance between sets of targets and of estimates, as errors, missed targets and false estimates (alpha = 2).

    Args:
        mean: ``(..., N, T, n)`` estimates; NaN for one that does not exist.
        truth: ``(..., M, T, n)``; NaN for one that does not exist.
        states: the components to compare, ``scenario.position`` say; where that raises, ``scenario.truth_position``
            after ``scenario.cartesian``.
        cutoff: distance, m, from which on an estimate is false and its target missed; each then counts as
            ``cutoff / 2^(1 / order)``.
        order: exponent of the sum.

    Raises:
        ImportError: scipy is not installed.
        ValueError: a cutoff that is not above 0, an order below 1, infinite ones, or shapes that do not match.

    Source: Rahmathullah, Garcia-Fernandez & Svensson (2017), "Generalized optimal sub-pattern assignment metric".
    """
    pairs, estimates, targets = _pairs(mean, truth, states, cutoff, order)
    pairs = torch.where(pairs < cutoff**order, pairs, cutoff**order)
    localisation, assigned = _assigned(pairs, cutoff**order, within=True)
    missed, false = (cutoff**order / 2 * (number - assigned) for number in (targets, estimates))
    return GOSPA(*((x ** (1 / order)) for x in (localisation + missed + false, localisation, missed, false)))


def swaps(mean: Tensor, truth: Tensor, states: slice, cutoff: float = 100.0) -> Tensor:
    """``(..., N)`` how often each estimate has changed to another target.

    An estimate within ``cutoff`` of the target it began with follows that one; otherwise it follows the nearest target
    within ``cutoff``; if there is none, the one it followed before.

    Args:
        mean: ``(..., N, T, n)`` estimates.
        truth: ``(..., N, T, n)``, of which the i-th is the target that estimate i begins with.
        states: the components to compare.
        cutoff: distance within which an estimate follows a target, m.

    Raises:
        ValueError: not as many targets as estimates.
    """
    if mean.dim() < 3 or mean.shape[-3:-1] != truth.shape[-3:-1]:
        raise ValueError(
            f"truth: expected (..., N, T, n) as the estimates {tuple(mean.shape)}, received {tuple(truth.shape)}"
        )
    gap = (mean[..., states].unsqueeze(-3) - truth[..., states].unsqueeze(-4)).square().sum(-1).sqrt()  # (..., N, M, T)
    first = torch.arange(gap.shape[-3], device=gap.device)
    at_first = gap.diagonal(dim1=-3, dim2=-2).movedim(-1, -2) <= cutoff  # (..., N, T)
    distance, nearest = gap.nan_to_num(torch.inf).min(-2)
    near = torch.where(at_first, first.unsqueeze(-1), torch.where(distance <= cutoff, nearest, -1))
    followed = first.expand(near.shape[:-1])
    count = torch.zeros(near.shape[:-1], dtype=torch.int64, device=gap.device)
    for now in near.unbind(-1):
        after = torch.where(now >= 0, now, followed)
        count, followed = count + (after != followed), after
    return count


def _pairs(mean: Tensor, truth: Tensor, states: slice, cutoff: float, order: float) -> tuple[Tensor, Tensor, Tensor]:
    """Distances ``(..., T, N, M)`` to the power of ``order``, infinite where one is NaN, and the numbers of both."""
    if not 0 < cutoff < torch.inf or not 1 <= order < torch.inf:
        raise ValueError(
            f"cutoff, order: expected finite numbers, cutoff above 0 m and order from 1 on, received {cutoff}, {order}"
        )
    if min(mean.dim(), truth.dim()) < 3 or mean.shape[-2] != truth.shape[-2]:
        raise ValueError(
            f"mean, truth: expected (..., N, T, n) and (..., M, T, n), received {tuple(mean.shape)} and "
            f"{tuple(truth.shape)}"
        )
    estimated, true = (x[..., states].movedim(-2, -3) for x in (mean, truth))  # (..., T, N, d)
    distance = (estimated.unsqueeze(-2) - true.unsqueeze(-3)).square().sum(-1) ** (order / 2)
    estimates, targets = ((~x.isnan().any(-1)).sum(-1).to(distance) for x in (estimated, true))
    return distance.nan_to_num(torch.inf), estimates, targets


def _assigned(pairs: Tensor, limit: float, within: bool = False) -> tuple[Tensor, Tensor]:
    """Least sum of ``(..., N, M)`` pairs, each at most ``limit``, over the pairs that exist, and their number.

    With ``within`` pairs at the limit do not count.
    """
    flat = pairs.detach().cpu().reshape(math.prod(pairs.shape[:-2]), *pairs.shape[-2:])
    totals, counts = torch.zeros(len(flat), dtype=flat.dtype), torch.zeros(len(flat), dtype=flat.dtype)
    for i, cost in enumerate(flat):
        finite = cost[cost.isfinite().any(-1)][:, cost.isfinite().any(-2)].clamp_max(limit)
        if finite.numel():
            rows, columns = least_cost(finite.numpy())
            chosen = finite[rows, columns]
            chosen = chosen[chosen < limit] if within else chosen
            totals[i], counts[i] = chosen.sum(), len(chosen)
    shape = pairs.shape[:-2]
    return totals.to(pairs).reshape(shape), counts.to(pairs).reshape(shape)
