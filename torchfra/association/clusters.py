"""Clusters of targets that share gated measurements, and the types that association works on."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Association(NamedTuple):
    """Marginal probabilities of association of a scan."""

    log_weights: Tensor
    """``(..., N, J + 1)`` log probabilities: that the target was missed, then that each measurement is its own; minus
    infinity where impossible."""
    evidence: Tensor
    """``(..., N)`` log density of the scan relative to one of false measurements alone, divided equally among the
    targets of a cluster: the sum over targets is the log density of the scan."""

    @property
    def probabilities(self) -> Tensor:
        """``(..., N, J)`` probability that each measurement originates from the target; the ``beta`` of the papers."""
        return self.log_weights[..., 1:].exp()


class Clusters(NamedTuple):
    """The cluster that each of N targets belongs to, in R scans."""

    members: Tensor
    """``(R, N, N)`` bool: which targets are in the same cluster, itself included."""
    size: Tensor
    """``(R, N)`` number of targets in the cluster."""
    gated: Tensor
    """``(R, N)`` number of measurements in the gates of the cluster."""
    weight: Tensor
    """``(R, N)`` the same number, each measurement weighted by its membership of soft gates, between 0 and 1."""


class GatedScans(NamedTuple):
    """R scans of J measurements against N targets: the input of each sum over joint events."""

    log_ratio: Tensor
    """``(R, N, J)`` log of detection probability times likelihood over clutter density; minus infinity if not gated."""
    log_miss: Tensor
    """``(R, N)`` log probability of no gated measurement; minus infinity for targets that are always measured."""
    gated: Tensor
    """``(R, N, J)`` bool: which measurements are in the gate of each target."""
    clusters: Clusters
    diffuse: bool
    """Whether any number of false measurements is equally probable a priori; otherwise it is Poisson."""


def same_cluster(gated: Tensor) -> Tensor:
    """The pairs of targets that share measurements, directly or through others.

    Args:
        gated: ``(..., N, J)`` bool, which measurements are in the gate of each target.

    Returns:
        ``(..., N, N)`` bool: the connected components of the graph of targets and gated measurements.
    """
    targets = gated.shape[-2]
    shared = gated.to(torch.float32) @ gated.mT.to(torch.float32)
    linked = (shared > 0) | torch.eye(targets, dtype=torch.bool, device=gated.device)
    for _ in range(max(targets - 2, 0).bit_length()):  # each squaring doubles the length of the paths
        linked = (linked.to(torch.float32) @ linked.to(torch.float32)) > 0
    return linked


def find_clusters(gated: Tensor, membership: Tensor) -> Clusters:
    """The clusters of R scans.

    Args:
        gated: ``(R, N, J)`` bool, which measurements are in the gate of each target.
        membership: ``(R, N, J)`` from 0 (outside) to 1 (inside).
    """
    members = same_cluster(gated)
    # Targets that share a measurement are in one cluster: each measurement is in the gates of a single one.
    inside = (members.to(torch.float32) @ gated.to(torch.float32)) > 0  # (R, N, J)
    weight = torch.where(inside, membership.amax(-2, keepdim=True), 0.0)
    return Clusters(members, members.sum(-1), (weight > 0).sum(-1), weight.sum(-1))


def choose(mask: Tensor, yes: Association, no: Association) -> Association:
    """``yes`` for targets in ``mask (R, N)``, else ``no``."""
    return Association(
        torch.where(mask.unsqueeze(-1), yes.log_weights, no.log_weights), torch.where(mask, yes.evidence, no.evidence)
    )
