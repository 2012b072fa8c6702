"""Targets against the measurements of a scan: batches ``(..., N)``, ``(..., N, 1)`` and ``(..., N, J)``."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from torchfra import tree
from torchfra.association.clusters import Association
from torchfra.association.gates import Candidates
from torchfra.association.joint import associate
from torchfra.gaussian.inputs import Frame
from torchfra.gaussian.model import add_counts
from torchfra.gaussian.update import repaired_root
from torchfra.linalg.safe import safe_divide
from torchfra.linalg.tracing import is_elementary, is_traced
from torchfra.types import Gaussian, Prediction, Whitened

C = TypeVar("C", Whitened, Frame)


class JPDAState(NamedTuple):
    """What is known of the targets after a scan."""

    inner: Any
    """Of the filters, ``(..., N)``."""
    missed: Tensor
    """``(..., N)`` expected number of scans since each was measured last."""
    searched: Tensor
    """``(..., N)`` how often the covariance of each has been quadrupled for that."""

    @property
    def belief(self) -> Gaussian:
        """``(..., N)``."""
        belief: Gaussian = self.inner.belief
        return belief


class JPDAInfo(NamedTuple):
    """Per step and target."""

    association: Tensor
    """``(..., N, T, J + 1)`` probabilities: that the target was missed, and that each measurement is its own."""
    fading: Tensor | None = None
    """``(..., N, T)`` fading factors, if the inner filter has them."""
    noise: Tensor | None = None
    """``(..., N, T, m)`` estimated variances of the measurement noise, as multiples of the nominal ones; or None."""
    weights: Tensor | None = None
    """``(..., N, T, J, m)`` of a robust inner filter: by which it would divide the noise of each measurement."""
    repaired: Tensor | None = None
    """``(..., N, T)`` covariances that were not positive definite and were repaired; of rules with negative
    weights."""
    inner: Any = None
    """What a filter of several models or regimes says of each target, ``(..., N, T)``: its ``info``, as expected over
    what may have happened.  None of an ``SRCKF``."""


class Scan(NamedTuple):
    """The measurements of a scan ``(..., N, J)`` against the prediction of each target."""

    whitened: Whitened
    root: Tensor
    """``(..., N, J, m, m)`` of the innovation's covariance, in units of the nominal noise."""
    normalised: Tensor
    candidates: Candidates
    log_density: Tensor
    """``(..., N, J)`` of each measurement if it is the target's."""


def associate_uncertain(exists: Tensor, log_ratio: Tensor, log_miss: Tensor, **options: Any) -> Association:
    """Whose the measurements are, where targets claim them only as probably as they exist.

    Args:
        exists: ``(..., N)`` probability that each target exists, before the scan.
        log_ratio: ``(..., N, J)`` of targets that exist, as of ``torchfra.association.associate``.
        log_miss: a number or ``(..., N)``, of targets that exist.
        options: of ``associate``.

    Returns:
        Of each target the association given that it exists; the evidence is that of targets that may not.

    Source: Musicki & Evans (2004), "Joint Integrated Probabilistic Data Association: JIPDA".
    """
    none = torch.log1p(exists * torch.expm1(log_miss))  # there, and missed, or not there
    association = associate(log_ratio + exists.log().unsqueeze(-1), none, **options)
    missed = association.log_weights[..., 0] + exists.log() + log_miss - none
    both = torch.cat([missed.unsqueeze(-1), association.log_weights[..., 1:]], -1)
    return association._replace(log_weights=both - both.logsumexp(-1, keepdim=True))


def missed_or_measured(predicted: Gaussian, each: Gaussian) -> Gaussian:
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
    if is_traced(log_weights):
        return log_weights, whitened
    order = gated_first(inside)
    if order.shape == inside.shape:
        return log_weights, whitened
    chances = _taken(log_weights[..., 1:], 0, order, inside.shape)
    return torch.cat([log_weights[..., :1], chances], -1), chosen(whitened, order, inside.shape)


def gated_first(inside: Tensor) -> Tensor:
    """Numbers ``(..., N, K)`` of measurements, first of those ``inside (..., N, J)`` the gate.

    K is what the fullest gate holds; all of them where code is traced.
    """
    if is_elementary():
        return torch.arange(inside.shape[-1]).expand(inside.shape)  # all of them, in any order
    order = inside.to(torch.int8).sort(dim=-1, descending=True, stable=True)[1]
    if is_traced(inside) or inside.numel() == 0:
        return order
    return order[..., : max(int(inside.sum(-1).amax()), 1)]


def likeliest(share: Tensor, whitened: Whitened) -> Whitened:
    """Of the measurements ``(..., N, J)`` the one with the largest ``share (..., N, J)``, ``(..., N, 1)``."""
    return chosen(whitened, share.argmax(-1, keepdim=True), share.shape)


def weighted_mean(x: Tensor, share: Tensor, measured: Tensor) -> tuple[Tensor, Tensor]:
    """Mean ``(..., N, 1, m)`` of ``x (..., N, J, m)`` by the probability of each measurement, and their sum.

    0 where the sum is below a half: nothing is learned from it then.

    Args:
        x: of each measurement.
        share: ``(..., N, J)`` probability that it is the target's.
        measured: ``(..., 1, J, m)`` 1 where measured.
    """
    weight = share.unsqueeze(-1) * measured
    x = torch.where(weight > 0, x, 0.0)  # others may be infinite
    total = weight.sum(-2, keepdim=True)
    return safe_divide((weight * x).sum(-2, keepdim=True), torch.where(total >= 0.5, total, 0.0)), total


def combined(
    share: Tensor, residual: Tensor, root: Tensor, normalised: Tensor, frame: Frame
) -> tuple[Tensor, Tensor, Tensor]:
    """What all measurements together say, in their own units, by the probabilities ``share (..., N, J)``.

    Args:
        share: probability that a measurement is the target's.
        residual: ``(..., N, J, m)`` in units of the measurement noise.
        root: ``(..., N, J, m, m)`` of its covariance, in units of the measurement noise.
        normalised: ``(..., N, J, m)`` residual divided by its root.
        frame: of the scan; tells the units.

    Returns:
        The weighted innovation ``(..., N, m)``, the root of the likeliest one's covariance, and the weighted normalised
        innovation.
    """
    noise = frame.measurement_noise
    weight, best = share.unsqueeze(-1), share.argmax(-1)[..., None, None, None]
    coloured, root = noise.colour(residual.unsqueeze(-1)).squeeze(-1), noise.colour(root)
    if root.shape[-3] > 1:  # else it is the same for all
        root = root.expand(*share.shape, *root.shape[-2:])
        root = root.gather(-3, best.expand(*share.shape[:-1], 1, *root.shape[-2:]))
    return (weight * coloured).sum(-2), root.squeeze(-3), (weight * normalised).sum(-2)


def target_repairs(prediction: Prediction, whitened: Whitened) -> Tensor | None:
    """How many covariances of a target had to be repaired; None for rules that never need it."""
    measured = None if whitened.subtracted is None else repaired_root(whitened)[1].any(-1)
    return add_counts(None if prediction.repaired is None else prediction.repaired.squeeze(-1), measured)


def chosen(trees: C, order: Tensor, shape: torch.Size, only: Collection[str] | None = None) -> C:
    """Of measurements ``shape = (..., N, J)`` those whose numbers are in ``order (..., N, K)``.

    With ``only``, other fields of the tuple stay as they are.
    """
    taken: C = tree.map_ranked(lambda rank, x: _taken(x, rank, order, shape), trees, only=only)
    return taken


def _taken(x: Tensor, rank: int, order: Tensor, shape: torch.Size) -> Tensor:
    event = x.shape[x.dim() - rank :]
    if x.shape[-rank - 1] == 1:
        return x  # the same for all
    rows = order[(..., *[None] * rank)].expand(*order.shape, *event)
    return x.expand(*shape, *event).gather(-rank - 1, rows)
