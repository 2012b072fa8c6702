"""Distances between sets of targets and of estimates."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor


class OSPA(NamedTuple):
    """Optimal subpattern assignment, m, and the parts whose ``order``-th powers add up to its own."""

    distance: Tensor
    """``(..., T)``."""
    localisation: Tensor
    """How far the assigned ones are from their targets."""
    cardinality: Tensor
    """How many are too many or too few."""


class GOSPA(NamedTuple):
    """Generalised OSPA, m, and the parts whose ``order``-th powers add up to its own."""

    distance: Tensor
    """``(..., T)``."""
    localisation: Tensor
    missed: Tensor
    false: Tensor


def ospa(mean: Tensor, truth: Tensor, states: slice, *, cutoff: float = 100.0, order: float = 2.0) -> OSPA:
    """Distance between sets of targets and of estimates, per target; NaN for one that is not there.

    Args:
        mean: ``(..., N, T, n)`` estimates.
        truth: ``(..., M, T, n)``.
        states: the components that count, say ``scenario.position``.
        cutoff: m that an estimate without a target, or the other way round, counts.
        order: of the mean; a high one lets the worst count more.

    Returns:
        Distance and parts, ``(..., T)``; 0 where there are neither targets nor estimates.

    Raises:
        ImportError: scipy is not there.
        ValueError: a cutoff that is not above 0, an order below 1, infinite ones, or shapes that do not fit.

    Source: Schuhmacher, Vo & Vo (2008), "A Consistent Metric for Performance Evaluation of Multi-Object Filters".
    """
    pairs, there, wanted = _pairs(mean, truth, states, cutoff, order)
    most = torch.maximum(there, wanted)
    near = _assigned(pairs, cutoff**order)[0] / most.clamp_min(1)
    off = cutoff**order * (most - torch.minimum(there, wanted)) / most.clamp_min(1)
    return OSPA(*((x ** (1 / order)) for x in (near + off, near, off)))


def gospa(mean: Tensor, truth: Tensor, states: slice, *, cutoff: float = 100.0, order: float = 2.0) -> GOSPA:
    """Distance between sets of targets and of estimates, as errors, missed targets and false estimates (alpha = 2).

    Args:
        mean: ``(..., N, T, n)`` estimates; NaN for one that is not there.
        truth: ``(..., M, T, n)``; NaN for one that is not there.
        states: the components that count, say ``scenario.position``.
        cutoff: m from which on an estimate is false and its target missed; each counts ``cutoff / 2^(1 / order)``.
        order: of the sum.

    Raises:
        ImportError: scipy is not there.
        ValueError: a cutoff that is not above 0, an order below 1, infinite ones, or shapes that do not fit.

    Source: Rahmathullah, Garcia-Fernandez & Svensson (2017), "Generalized optimal sub-pattern assignment metric".
    """
    pairs, there, wanted = _pairs(mean, truth, states, cutoff, order)
    found, count = _assigned(torch.where(pairs < cutoff**order, pairs, cutoff**order), cutoff**order, within=True)
    missed, false = (cutoff**order / 2 * (number - count) for number in (wanted, there))
    return GOSPA(*((x ** (1 / order)) for x in (found + missed + false, found, missed, false)))


def swaps(mean: Tensor, truth: Tensor, states: slice, cutoff: float = 100.0) -> Tensor:
    """``(..., N)`` how often each estimate has gone over to another target.

    An estimate is with its own target within ``cutoff``; beyond, it is with the nearest other within it, if there is
    one; else it stays with whom it was.

    Args:
        mean: ``(..., N, T, n)`` estimates.
        truth: ``(..., N, T, n)``, estimate i begins as that of target i.
        states: the components that count.
        cutoff: m.

    Raises:
        ValueError: not one truth for each estimate.
    """
    if mean.dim() < 3 or mean.shape[-3:-1] != truth.shape[-3:-1]:
        raise ValueError(
            f"truth: expected (..., N, T, n) as the estimates {tuple(mean.shape)}, received {tuple(truth.shape)}"
        )
    gap = (mean[..., states].unsqueeze(-3) - truth[..., states].unsqueeze(-4)).square().sum(-1).sqrt()  # (..., N, M, T)
    own = torch.arange(gap.shape[-3], device=gap.device)
    mine = gap.diagonal(dim1=-3, dim2=-2).movedim(-1, -2) <= cutoff  # (..., N, T)
    nearest, whose = gap.nan_to_num(torch.inf).min(-2)
    near = torch.where(mine, own.unsqueeze(-1), torch.where(nearest <= cutoff, whose, -1))
    holder, count = own.expand(near.shape[:-1]), torch.zeros(near.shape[:-1], dtype=torch.int64, device=gap.device)
    for now in near.unbind(-1):
        after = torch.where(now >= 0, now, holder)
        count, holder = count + (after != holder), after
    return count


def _pairs(mean: Tensor, truth: Tensor, states: slice, cutoff: float, order: float) -> tuple[Tensor, Tensor, Tensor]:
    """Distances ``(..., T, N, M)`` to the power of ``order``, infinite where one is missing, and how many there are."""
    if not 0 < cutoff < torch.inf or not 1 <= order < torch.inf:
        raise ValueError(
            f"cutoff, order: expected metres above 0 and 1 or more, both finite, received {cutoff}, {order}"
        )
    if min(mean.dim(), truth.dim()) < 3 or mean.shape[-2] != truth.shape[-2]:
        raise ValueError(
            f"mean, truth: expected (..., N, T, n) and (..., M, T, n), received {tuple(mean.shape)} and "
            f"{tuple(truth.shape)}"
        )
    ours, theirs = (x[..., states].movedim(-2, -3) for x in (mean, truth))  # (..., T, N, d)
    distance = (ours.unsqueeze(-2) - theirs.unsqueeze(-3)).square().sum(-1) ** (order / 2)
    there, wanted = ((~x.isnan().any(-1)).sum(-1).to(distance) for x in (ours, theirs))
    return distance.nan_to_num(torch.inf), there, wanted


def _assigned(pairs: Tensor, limit: float, within: bool = False) -> tuple[Tensor, Tensor]:
    """Least sum of ``(..., N, M)`` pairs, each at most ``limit``, over the pairs that exist, and their number.

    With ``within`` pairs at the limit do not count.
    """
    try:
        from scipy.optimize import linear_sum_assignment
    except ImportError:
        raise ImportError("assignments need scipy: pip install torchfra[assignment]") from None
    flat = pairs.detach().cpu().reshape(-1, *pairs.shape[-2:])
    totals, counts = torch.zeros(len(flat), dtype=flat.dtype), torch.zeros(len(flat), dtype=flat.dtype)
    for i, cost in enumerate(flat):
        there = cost[cost.isfinite().any(-1)][:, cost.isfinite().any(-2)].clamp_max(limit)
        if there.numel():
            rows: Any
            rows, columns = linear_sum_assignment(there.numpy())
            chosen = there[rows, columns]
            chosen = chosen[chosen < limit] if within else chosen
            totals[i], counts[i] = chosen.sum(), len(chosen)
    shape = pairs.shape[:-2]
    return totals.to(pairs).reshape(shape), counts.to(pairs).reshape(shape)
