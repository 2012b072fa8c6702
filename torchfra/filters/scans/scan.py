"""State and info of a filter of scans, and the pairs ``(..., N, J)`` of targets and measurements in a scan."""

from __future__ import annotations

from collections.abc import Callable, Collection
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
from torchfra.linalg.tracing import is_elementary, is_traced
from torchfra.types import Gaussian, Prediction, Whitened

C = TypeVar("C", Whitened, Frame)


class JPDAState(NamedTuple):
    """State after a scan."""

    inner: Any
    """State of the targets' filters, ``(..., N)``."""
    missed: Tensor
    """``(..., N)`` expected number of scans since the last measurement of each."""
    inflations: Tensor
    """``(..., N)`` number of times that the covariance of each has been quadrupled as that of a lost track."""

    @property
    def belief(self) -> Gaussian:
        """The estimates ``(..., N)``."""
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
    """``(..., N, T, J, m)`` weights of a robust inner filter, which divide the noise covariance of each measurement."""
    repaired: Tensor | None = None
    """``(..., N, T)`` number of covariances that were not positive definite and were repaired; for rules with negative
    weights."""
    inner: Any = None
    """``(..., N, T)`` expectation over the association hypotheses of the ``info`` of an inner filter of several models
    or regimes.  None for an ``SRCKF``."""


class Scan(NamedTuple):
    """The measurements of a scan ``(..., N, J)`` compared with the prediction of each target."""

    whitened: Whitened
    root: Tensor
    """``(..., N, J, m, m)`` root of the innovation's covariance, in units of the nominal noise."""
    normalised: Tensor
    """``(..., N, J, m)`` residual divided by its root."""
    candidates: Candidates
    log_density: Tensor
    """``(..., N, J)`` of each measurement if it is the target's."""


def associate_uncertain(
    exists: Tensor, log_ratio: Tensor, log_miss: Tensor, solve: Callable[[Tensor, Tensor], Association] = associate
) -> Association:
    """The association of measurements with targets that may not exist.

    Args:
        exists: ``(..., N)`` probability that each target exists, before the scan.
        log_ratio: ``(..., N, J)`` for targets that exist, see ``torchfra.association.associate``.
        log_miss: a number or ``(..., N)``, for targets that exist.
        solve: ``associate`` with its options.

    Returns:
        The association of each target conditional on its existence; the evidence is not conditional.

    Source: Musicki & Evans (2004), "Joint Integrated Probabilistic Data Association: JIPDA".
    """
    none = torch.log1p(exists * torch.expm1(log_miss))  # it exists and was missed, or it does not exist
    association = solve(log_ratio + exists.log().unsqueeze(-1), none)
    missed = association.log_weights[..., 0] + exists.log() + log_miss - none
    both = torch.cat([missed.unsqueeze(-1), association.log_weights[..., 1:]], -1)
    return association._replace(log_weights=both - both.logsumexp(-1, keepdim=True))


def gated_first(inside: Tensor) -> Tensor:
    """Indices ``(..., N, K)`` of measurements, those ``inside (..., N, J)`` the gate first.

    K is the largest number of measurements in a gate; while code is traced it is J.
    """
    if is_elementary():
        return torch.arange(inside.shape[-1]).expand(inside.shape)  # all measurements; their order does not matter
    order = inside.to(torch.int8).sort(dim=-1, descending=True, stable=True)[1]
    if is_traced(inside) or inside.numel() == 0:
        return order
    return order[..., : max(int(inside.sum(-1).amax()), 1)]


def target_repairs(prediction: Prediction, whitened: Whitened) -> Tensor | None:
    """Number of covariances of a target that were repaired; None for rules without negative weights."""
    measured = None if whitened.subtracted is None else repaired_root(whitened)[1].any(-1)
    return add_counts(None if prediction.repaired is None else prediction.repaired.squeeze(-1), measured)


def chosen(trees: C, order: Tensor, shape: torch.Size, only: Collection[str] | None = None) -> C:
    """The measurements with the indices ``order (..., N, K)``, of those of ``shape = (..., N, J)``.

    With ``only``, all other fields of the tuple stay as they are.
    """
    return tree.map_ranked(lambda rank, x: _taken(x, rank, order, shape), trees, only=only)


def _taken(x: Tensor, rank: int, order: Tensor, shape: torch.Size) -> Tensor:
    """``chosen`` of one tensor, whose entry for a measurement has ``rank`` dimensions."""
    event = x.shape[x.dim() - rank :]
    if x.shape[-rank - 1] == 1:
        return x  # all measurements share it
    rows = order[(..., *[None] * rank)].expand(*order.shape, *event)
    return x.expand(*shape, *event).gather(-rank - 1, rows)
