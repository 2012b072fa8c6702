"""The branches of an abnormal step: what FRA carries of them, what it tells of them, and the choice of one."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfra import tree
from torchfra.adaptive.fading import Memory
from torchfra.types import Gaussian

Branches = tuple[Gaussian, Gaussian, Gaussian]
"""Robust, adaptive and plain: the order of all that is said of branches."""
UNDECIDED = ("robust", "adaptive", "plain", "likeliest")
"""What may be the estimate of an abnormal step before anything decides."""


class FRAState(NamedTuple):
    """What FRA knows after a step."""

    belief: Gaussian
    """Provisional estimate of this step: where it was abnormal the robust branch, or that of the largest odds."""
    robust: Gaussian
    """That branch; equal to ``plain`` where the step was normal (but for a soft decision)."""
    adaptive: Gaussian
    """The other branch, likewise."""
    plain: Gaussian
    """The estimate with neither remedy."""
    lagged: Gaussian
    """Final estimate of the step before: this measurement has decided among its branches."""
    excess: Tensor
    """``(...)`` how far the normalised innovation squared is above the gate."""
    memory: Memory

    @property
    def abnormal(self) -> Tensor:
        """``(...)`` bool: this step waits for the next measurement."""
        return self.excess > 0  # eq. (36)

    @property
    def branches(self) -> Branches:
        """The estimates that wait for a decision."""
        return self.robust, self.adaptive, self.plain


class FRAInfo(NamedTuple):
    """Per step and track."""

    abnormal: Tensor
    """``(..., T)`` bool: the innovation failed the gate and the filter forked."""
    adaptive: Tensor
    """``(..., T)`` bool: the adaptive branch was kept (with a soft decision: had the largest weight)."""
    plain: Tensor
    """``(..., T)`` bool: of an abnormal step the plain branch was kept, likewise; never where there is none."""
    fading: Tensor
    """``(..., T)`` fading factor of the adaptive branch, 1 at normal steps (but for a soft decision)."""
    weights: Tensor
    """``(..., T, m)`` Huber weights of the robust branch, 1 at normal steps."""
    provisional: Gaussian
    """``mean (..., T, n)`` and ``scale_tril``: what was known at the step itself."""


class Kept(NamedTuple):
    """Which branch of an abnormal step was kept, ``(...)`` bool each; neither: the robust one."""

    adaptive: Tensor
    plain: Tensor


class Step(NamedTuple):
    """What one step knows: about itself, and now for good about the one before."""

    before: tree.Late
    """Its settled estimate, and which branch was ``Kept``."""
    abnormal: Tensor
    fading: Tensor
    weights: Tensor


def best(scores: Tensor) -> Kept:
    """The branch of the largest score; a tie goes to the first.

    Args:
        scores: ``(branches, ...)`` of robust, adaptive and, if there is one, plain.
    """
    robust, adaptive = scores[0], scores[1]
    better = adaptive > robust
    if len(scores) == 2:
        return Kept(better, torch.zeros_like(better))
    plain = scores[2] > torch.maximum(robust, adaptive)
    return Kept(better & ~plain, plain)


def chosen(kept: Kept, branches: Branches) -> Gaussian:
    """Of robust, adaptive and plain what was kept."""
    robust, adaptive, plain = branches
    belief: Gaussian = tree.where(kept.adaptive, adaptive, tree.where(kept.plain, plain, robust))
    return belief
