"""Losses to train filters by.

Each loss is one number per track, ``(...)``, the mean over its steps, so that a track that diverged can be recognised
and left out; take ``.mean()`` for a batch.  Only ``calibration`` is a property of many tracks together and gives one
number.  Steps whose truth is NaN, or without a measurement where only measurements count, do not count: padding and
gaps change nothing.

``states`` are the components that count, the same in estimate and truth, ``scenario.position`` say; where that raises,
``scenario.truth_position`` after ``scenario.cartesian``.  ``angles`` are those of the state's components that are
angles, rad: their differences are taken within half a turn.
"""

from __future__ import annotations

import math
from collections.abc import Collection

import torch
from torch import Tensor

from torchfra.angles import wrap
from torchfra.linalg.triangular import marginal_root, whiten
from torchfra.types import Estimate


def mse(mean: Tensor, truth: Tensor, states: slice, *, angles: Collection[int] = ()) -> Tensor:
    """Mean squared distance, m^2 for positions.

    Args:
        mean: ``(..., T, n)`` estimates.
        truth: ``(..., T, n)``; NaN where unknown.
        states: the components that count.
        angles: the components of the state that are angles.

    Example:
        >>> torchfra.losses.mse(torch.tensor([[3.0, 4.0]]), torch.zeros(1, 2), slice(0, 2))
        tensor(25.)
    """
    gap, known = _gap(mean, truth, states, angles)
    return _over_time(gap.square().sum(-1), known)


def robust_mse(mean: Tensor, truth: Tensor, states: slice, scale: float, *, angles: Collection[int] = ()) -> Tensor:
    """``log(1 + mse / scale^2)``: the mean squared distance with a bounded influence of each track.

    A track with an error far above ``scale`` counts by the logarithm of its error, so that one that diverged does not
    dominate the batch; one far below counts by its mean squared error.  With a small scale the relative error of each
    track counts.

    Args:
        mean: ``(..., T, n)`` estimates.
        truth: ``(..., T, n)``; NaN where unknown.
        states: the components that count.
        scale: the error above which the loss grows slowly, in the unit of the components.
        angles: the components of the state that are angles.

    Raises:
        ValueError: ``scale`` not above 0.

    Source: the Cauchy (Lorentzian) loss, Black & Anandan (1996).
    """
    if not scale > 0:
        raise ValueError(f"scale: expected a value above 0, received {scale}")
    return torch.log1p(mse(mean, truth, states, angles=angles) / scale**2)


def nll(estimate: Estimate, truth: Tensor, states: slice | None = None, *, angles: Collection[int] = ()) -> Tensor:
    """Negative log density of the truth under the estimate: rewards small errors and consistent covariances.

    Args:
        estimate: of tracks ``(..., T, n)``.
        truth: ``(..., T, n)``; NaN where unknown.
        states: the components that count, with their marginal covariance; all if None.
        angles: the components of the state that are angles.
    """
    normalised, log_det, known = _normalised(estimate, truth, states, angles)
    size = normalised.shape[-1]
    return _over_time(0.5 * normalised.square().sum(-1) + log_det + 0.5 * size * math.log(2 * math.pi), known)


def innovation_nll(estimate: Estimate) -> Tensor:
    """Negative log density of a measurement under its prediction, the mean over measured steps.  It needs no truth.

    A step without a measurement does not count; of several targets a scan without any is a miss of all, and counts.  A
    network that makes the measurements itself must not learn by it alone: constant measurements are easy to predict.

    Where the model is linear its gradient is, to rounding, the one made of smoothed moments (Fisher's identity), so
    that a loss of smoothed estimates would add nothing but the backward pass.

    Source: the prediction error decomposition, Schweppe (1965); Cappe, Moulines & Ryden (2005), section 10.1, for
    the identity.
    """
    density = estimate.log_likelihood
    # A step without a measurement has a likelihood of 1, of mixtures but for rounding, and nothing that differs.
    nothing = (estimate.nis == 0) & (density.abs() <= 64 * torch.finfo(density.dtype).eps)
    return -_over_time(density, ~nothing)


def calibration(
    estimate: Estimate, truth: Tensor, states: slice | None = None, *, angles: Collection[int] = ()
) -> Tensor:
    """Inconsistency of the covariances: the squared log of the mean NEES per component; one number.

    0 when the mean over all tracks and known steps is the number of components; covariances that are too large or too
    small by the same factor have the same loss.

    Args:
        estimate: of tracks ``(..., T, n)``.
        truth: ``(..., T, n)``; NaN where unknown.
        states: the components that count, with their marginal covariance; all if None.
        angles: the components of the state that are angles.

    Source: Bar-Shalom, Li & Kirubarajan (2001), eq. (5.4.2-1), for the NEES.
    """
    normalised, _, known = _normalised(estimate, truth, states, angles)
    nees = normalised.square().sum(-1).sum() / known.sum()
    return (nees / normalised.shape[-1]).log().square()


def _gap(mean: Tensor, truth: Tensor, states: slice, angles: Collection[int]) -> tuple[Tensor, Tensor]:
    """Estimate minus truth, 0 at steps whose truth is NaN, and which steps ``(..., T)`` are known."""
    is_angle = torch.zeros(mean.shape[-1], dtype=torch.bool, device=mean.device)
    is_angle[list(angles)] = True
    known = ~truth[..., states].isnan().any(-1)
    gap = mean[..., states] - torch.where(known.unsqueeze(-1), truth[..., states], mean.detach()[..., states])
    return torch.where(is_angle[states], wrap(gap), gap), known


def _normalised(
    estimate: Estimate, truth: Tensor, states: slice | None, angles: Collection[int]
) -> tuple[Tensor, Tensor, Tensor]:
    """Errors in units of their covariance's root, half its log determinant (0 where unknown), and known steps."""
    states = slice(None) if states is None else states
    gap, known = _gap(estimate.mean, truth, states, angles)
    root = marginal_root(estimate.scale_tril, states)
    log_det = root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return whiten(root, gap), log_det * known, known


def _over_time(values: Tensor, known: Tensor) -> Tensor:
    """Mean over the known steps, 0 for a track that has none."""
    return torch.where(known, values, 0.0).sum(-1) / known.sum(-1).clamp_min(1)
