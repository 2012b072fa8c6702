"""Clusters of targets that share measurements, and what association gives."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Association(NamedTuple):
    """What a scan says about its targets."""

    log_weights: Tensor
    """``(..., N, J + 1)`` logs of the probabilities: missed, then of each measurement; minus infinity for none."""
    evidence: Tensor
    """``(..., N)`` log density of the scan against one of false measurements alone; each target of a cluster has an
    equal share, so that their sum is that of the scan."""

    @property
    def share(self) -> Tensor:
        """``(..., N, J)`` probability that each measurement is the target's own."""
        return self.log_weights[..., 1:].exp()


class Clusters(NamedTuple):
    """Of every target its cluster."""

    together: Tensor
    """``(R, N, N)`` bool, which targets are in it."""
    size: Tensor
    """``(R, N)`` how many."""
    gated: Tensor
    """``(R, N)`` measurements in their gates."""
    counted: Tensor
    """``(R, N)`` those, each as far as it is inside."""


def clusters(gated: Tensor) -> Tensor:
    """``(..., N, N)`` bool: which targets share measurements, directly or through others, by ``gated (..., N, J)``."""
    n = gated.shape[-2]
    share = gated.to(torch.float32) @ gated.mT.to(torch.float32)
    linked = (share > 0) | torch.eye(n, dtype=torch.bool, device=gated.device)
    for _ in range(max(n - 1, 1).bit_length()):
        linked = (linked.to(torch.float32) @ linked.to(torch.float32)) > 0
    return linked
