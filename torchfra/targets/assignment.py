"""Linear assignment of two sets, the distance of two beliefs, and chi-squared quantiles, by scipy."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchfra.linalg.triangular import hstack, tria, whiten
from torchfra.motion.base import Motion
from torchfra.running.optional import optional
from torchfra.types import Gaussian


def scipy(part: str) -> Any:
    """A part of scipy, such as ``"optimize"``, imported when it is needed.

    Raises:
        ImportError: scipy is not installed.
    """
    return optional(f"scipy.{part}", "a manager of targets", "assignment")


def assigned(cost: Tensor, allowed: Tensor) -> tuple[Tensor, Tensor]:
    """Rows and columns of the assignment with the most ``allowed (K, L)`` pairs, and among those of least ``cost``.

    Args:
        cost: ``(K, L)`` of each pair, 0 or more.
        allowed: bool, pairs that may be assigned.

    Raises:
        ImportError: scipy is not installed.
    """
    cost = torch.where(allowed, cost.detach(), 0.0)
    cost = torch.where(allowed, cost, 1 + 2 * cost.sum())  # more than all that are allowed together
    found = scipy("optimize").linear_sum_assignment(cost.numpy(force=True))
    i, j = (torch.from_numpy(x).to(cost.device) for x in found)
    chosen = allowed[i, j]
    return i[chosen], j[chosen]


def squared_distance(motion: Motion, one: Gaussian, other: Gaussian) -> Tensor:
    """Squared Mahalanobis distance ``(...)`` of two beliefs ``(..., n)``, by the sum of their covariances."""
    gap = motion.difference(one.mean, other.mean)
    return whiten(tria(hstack(one.scale_tril, other.scale_tril)), gap).square().sum(-1)


def chi_square(probability: float, degrees: int) -> float:
    """Quantile of the chi-squared distribution.

    Raises:
        ImportError: scipy is not installed.
    """
    return float(scipy("special").gammainccinv(degrees / 2, 1 - probability) * 2)
