"""Errors of estimates of single targets, over time and over runs.  Steps whose truth is NaN do not count."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.linalg.triangular import apply, marginal_root, rounding, tria, whiten
from torchfra.types import Estimate


def error(mean: Tensor, truth: Tensor, states: slice) -> Tensor:
    """Distance ``(..., T)`` between two tracks ``(..., T, n)`` in the components ``states``.

    Args:
        mean: the estimate.
        truth: the true states; NaN where unknown, where the error is NaN too.  Where the truth is known and the
            estimate is NaN, the error is infinite.
        states: the components to compare, ``scenario.position`` say; where that raises, ``scenario.truth_position``
            after ``scenario.cartesian``.

    Example:
        >>> torchfra.metrics.error(torch.tensor([[3.0, 4.0]]), torch.zeros(1, 2), slice(0, 2))
        tensor([5.])
    """
    distance = (mean[..., states] - truth[..., states]).square().sum(-1).sqrt()
    failed = distance.isnan() & ~truth[..., states].isnan().any(-1)
    return torch.where(failed, torch.inf, distance)


def rmse(mean: Tensor, truth: Tensor, states: slice) -> Tensor:
    """Root mean square error over the runs, ``(T,)``, of tracks ``(..., T, n)``: Wang et al. (2021), eq. (38).

    Example:
        >>> mean, truth = torch.tensor([[[3.0, 4.0]], [[0.0, 1.0]]]), torch.zeros(2, 1, 2)  # two runs of one step
        >>> torchfra.metrics.rmse(mean, truth, slice(0, 2))
        tensor([3.6056])
    """
    squared = error(mean, truth, states).square()
    return squared.reshape(-1, squared.shape[-1]).nanmean(0).sqrt()


def track_rmse(mean: Tensor, truth: Tensor, states: slice) -> Tensor:
    """Root mean square error over time of each track, ``(...)``; infinity for a track with NaN estimates."""
    return error(mean, truth, states).square().nanmean(-1).sqrt()


def diverged(mean: Tensor, truth: Tensor, states: slice, limit: float = 2000.0) -> Tensor:
    """``(...)`` bool: the track's root mean square error over time is above ``limit``, m, or an estimate is NaN."""
    return track_rmse(mean, truth, states) > limit


def nees(estimate: Estimate, truth: Tensor, states: slice | None = None) -> Tensor:
    """Normalised estimation error squared ``(..., T)``; for a consistent filter its mean is the number of components.

    Where the covariance is singular it is the limit of covariances that are not: infinite for an error that the filter
    rules out, as of an acceleration that it is certain of and that is another; otherwise that of the covariance's span,
    whose mean is the rank.

    Args:
        estimate: of tracks ``(..., T, n)``.
        truth: ``(..., T, n)``.
        states: the components that count, with their marginal covariance, ``scenario.position`` say; where that raises,
            ``scenario.truth_position`` after ``scenario.cartesian``; all if None.

    Source: Bar-Shalom, Li & Kirubarajan (2001), eq. (5.4.2-1).
    """
    states = slice(None) if states is None else states
    error = estimate.mean[..., states] - truth[..., states]
    root = marginal_root(estimate.scale_tril, states)
    if not bool((root.diagonal(dim1=-2, dim2=-1) == 0).any()):
        return whiten(root, error).square().sum(-1)
    root = tria(root)  # nothing depends on a component without variance
    certain = root.diagonal(dim1=-2, dim2=-1) == 0
    normalised = torch.where(certain, 0 * error, whiten(root + torch.diag_embed(certain.to(root)), error))
    left = (error - apply(root, normalised)).abs()
    terms = error.abs() + apply(root.abs(), normalised.abs())
    ruled_out = certain & (left > rounding(root.shape[-1] + 1, root.dtype) * terms)
    return torch.where(ruled_out.any(-1), torch.inf, normalised.square().sum(-1))
