"""Moment matching in square-root form, and operations on the beliefs of several models."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchfra.angles import near
from torchfra.linalg.safe import safe_log
from torchfra.linalg.tracing import batchwise, has_caller
from torchfra.linalg.triangular import hstack, tria
from torchfra.types import Gaussian


def moment_match(beliefs: Gaussian, log_weights: Tensor, angles: Sequence[int] = ()) -> Gaussian:
    """The Gaussian with the mean and the covariance of a mixture.

    ``tria([sqrt(w_i) S_i, sqrt(w_i) (mean_i - mean)])`` over all i, and ``tria([sqrt(w_1) S_1, sqrt(w_2) S_2,
    sqrt(w_1 w_2) (mean_1 - mean_2)])`` of two: no covariance is formed.

    Args:
        beliefs: ``mean (K, ..., n)`` and ``scale_tril (K, ..., n, n)``, the K beliefs on the first dimension; any
            roots ``(K, ..., n, p)`` are allowed.
        log_weights: ``(K, ...)``, whose exponentials sum to one over the first dimension; minus infinity for a belief
            of zero weight, which may then be NaN.
        angles: components that are angles, rad.  Each angle is taken within half a turn of the likeliest belief's; if
            all lie in one half of the circle, the moments do not depend on that choice.

    Source: Bar-Shalom, Li & Kirubarajan (2001), section 1.4.16, for the moments.

    Example:
        >>> two = torchfra.Gaussian(torch.tensor([[-1.0], [1.0]]), torch.zeros(2, 1, 1))
        >>> torchfra.gaussian.moment_match(two, torch.log(torch.tensor([0.5, 0.5]))).covariance.round(decimals=3)
        tensor([[1.]])
    """
    roots = (0.5 * log_weights).exp()  # not the root of a weight: its gradient at 0 is infinite
    return matched(beliefs, roots, angles)


def matched(beliefs: Gaussian, roots: Tensor, angles: Sequence[int] = (), *, triangular: bool = True) -> Gaussian:
    """``moment_match`` with square roots ``(K, ...)`` of the weights.

    If not ``triangular``, its root is ``(..., n, p)`` and saves a triangularisation: enough for a linear motion, whose
    prediction has a triangularisation of its own.
    """
    root = roots.unsqueeze(-1)
    mean = torch.where(root != 0, beliefs.mean, 0.0)  # true for NaN, which must show in the result
    mean = _near_likeliest(mean, roots, angles) if angles else mean
    if triangular and len(roots) > _TOGETHER and has_caller():
        return _in_turn(Gaussian(mean, beliefs.scale_tril), roots)
    if len(root) == 2:  # one column for both means, as their shares sum to one
        (one, other), (first, second) = root.unbind(), mean.unbind()
        between = second - first
        middle = first + other.square() * between
        of_means = [(one * other * between).unsqueeze(-1)]
    else:
        middle = _mean(mean, roots)
        of_means = list((root * (mean - middle)).unsqueeze(-1).unbind())
    each = roots[..., None, None]
    weighted = each * torch.where(each != 0, beliefs.scale_tril, 0.0)
    spread = torch.cat([*weighted.unbind(), *of_means], -1)
    return Gaussian(middle, tria(spread, graded=False) if triangular else spread)


def _mean(means: Tensor, roots: Tensor) -> Tensor:
    """The mean of means ``(K, ..., n)``, with square roots ``(K, ...)`` of the weights.

    What the sum of the weights differs from one by rounding moves a mean far from the origin: the second term takes it
    back.
    """
    weights = roots.unsqueeze(-1).square()
    about = (weights * means).sum(0)
    return about + (weights * (means - about)).sum(0)


_TOGETHER = 4
"""Beliefs that a step of many merges at once: the function is short, and called for all parts."""


def _in_turn(beliefs: Gaussian, roots: Tensor) -> Gaussian:
    """``matched`` of many beliefs without angles, none of no weight that is NaN, some after others."""
    mean = beliefs.mean
    middle = _mean(mean, roots)
    root = middle.new_zeros(*middle.shape, middle.shape[-1])
    values = (roots, 0), (mean, 1), (beliefs.scale_tril, 2)
    parts = (x.movedim(0, -1 - event).split(_TOGETHER, -1 - event) for x, event in values)
    for more in zip(*parts, strict=True):
        root = _with_more(root, middle, *more)
    return Gaussian(middle, root)


@batchwise(2, 1, 1, 2, 3)
def _with_more(root: Tensor, middle: Tensor, roots: Tensor, mean: Tensor, spread: Tensor) -> Tensor:
    """The ``root (..., n, n)`` of some beliefs together with ``K`` others, around the mean of all."""
    of_means, each = (roots.unsqueeze(-1) * (mean - middle.unsqueeze(-2))).mT, roots[..., None, None]
    return tria(hstack(root, *(each * torch.where(each != 0, spread, 0.0)).unbind(-3), of_means), graded=False)


def share_roots(log_weights: Tensor, factors: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Square roots ``(K, ...)`` of the normalised weights, and the log ``(...)`` of their sum.

    With ``factors (K, ...)`` above 0 the weights are ``factors exp(log_weights)``.
    """
    if len(log_weights) == 1 and factors is None:
        return torch.ones_like(log_weights), log_weights[0]
    top = largest(log_weights, 0)
    roots = (0.5 * (log_weights - top)).exp()
    roots = roots if factors is None else factors.sqrt() * roots
    total = roots.square().sum(0)
    return roots / total.sqrt(), top + total.log()


def log_sum(log_weights: Tensor, dim: int) -> Tensor:
    """Log of the sum of weights, from their logs; minus infinity, with a gradient of 0, where all weights are 0."""
    top = largest(log_weights, dim, keepdim=True)
    return safe_log((log_weights - top).exp().sum(dim)) + top.squeeze(dim)


def largest(log_weights: Tensor, dim: int | tuple[int, ...], keepdim: bool = False) -> Tensor:
    """The largest of the logs of weights, without a gradient; 0 where all weights are 0."""
    top = log_weights.detach().amax(dim, keepdim)
    return torch.where(top == -torch.inf, 0.0, top)


def _near_likeliest(mean: Tensor, weights: Tensor, angles: Sequence[int]) -> Tensor:
    """Means ``(K, ..., n)`` with their angles within half a turn of the likeliest mean's."""
    columns = list(mean.unbind(-1))
    for i in angles:
        if i < len(columns):  # otherwise the sensor does not read the component
            column, weight = torch.broadcast_tensors(columns[i], weights)
            likeliest, most = column[0], weight[0]
            for angle, w in zip(column[1:], weight[1:], strict=True):
                likeliest, most = torch.where(w > most, angle, likeliest), torch.maximum(w, most)
            columns[i] = near(column, likeliest)
    return torch.stack(torch.broadcast_tensors(*columns), -1)


def repeated(belief: Gaussian, count: int) -> Gaussian:
    """The belief, repeated for each of ``count`` models: ``(..., K)``."""
    mean, root = belief.mean.unsqueeze(-2), belief.scale_tril.unsqueeze(-3)
    return Gaussian(mean.expand(*mean.shape[:-2], count, -1), root.expand(*root.shape[:-3], count, -1, -1))


def models_first(belief: Gaussian) -> Gaussian:
    """Beliefs ``(..., K)`` of models as ``(K, ...)``."""
    return Gaussian(belief.mean.movedim(-2, 0), belief.scale_tril.movedim(-3, 0))


def without_failed(log_density: Tensor) -> Tensor:
    """The log likelihoods, with zero likelihood for a hypothesis that failed (NaN)."""
    return torch.where(log_density.isnan(), -torch.inf, log_density)


def nearest(log_density: Tensor, normalised: Tensor) -> Tensor:
    """The log likelihoods; where squares overflow under every model, 0 for the nearest and minus infinity for others.

    That is their limit up to a common constant: the log likelihood of the nearest exceeds others by more than any
    number holds.

    Args:
        log_density: ``(..., K)``, minus infinity where it overflows or the model has failed.
        normalised: ``(..., K, m)`` residuals divided by their roots.
    """
    small = float(torch.finfo(normalised.dtype).tiny) ** 0.5
    distance = (small * normalised.detach()).square().sum(-1)
    distance = torch.where(distance.isnan(), torch.inf, distance)
    least = distance.amin(-1, keepdim=True)
    overflows = (log_density == -torch.inf).all(-1, keepdim=True) & (least < torch.inf)
    return torch.where(overflows, torch.where(distance == least, 0.0, -torch.inf).to(log_density), log_density)
