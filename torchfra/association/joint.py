"""Probabilities of joint association: exact for small clusters, by belief propagation for larger ones."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from torchfra.association.clusters import Association, GatedScans, choose, find_clusters
from torchfra.association.events import sum_over_events
from torchfra.association.messages import belief_propagation, each_alone, sum_by_messages
from torchfra.association.sets import check_sets, sum_over_sets
from torchfra.association.tables import associate_by_tables
from torchfra.linalg.batches import broadcast_shapes
from torchfra.linalg.tracing import is_elementary, is_traced

_TRACED_ITERATIONS = 50
"""Largest number of rounds of messages where code is traced, which cannot stop early."""


def associate(
    log_ratio: Tensor,
    log_miss: Tensor | float,
    *,
    diffuse: bool = False,
    log_membership: Tensor | None = None,
    exact: tuple[int, int] = (4, 10),
    iterations: int = 200,
) -> Association:
    """Marginal probabilities of association, summed over all joint events of targets and measurements.

    In a joint event each target is missed or has one measurement, and each measurement belongs to one target or is
    false.

    Args:
        log_ratio: ``(..., N, J)`` log of ``P_D L / c`` of each target and measurement: detection probability times
            likelihood, divided by the density of false measurements there.  Minus infinity outside the gate.
        log_miss: ``(..., N)``, or a number, log probability that a target has no measurement in its gate.  Minus
            infinity for targets that are always measured: then only events with the fewest misses are possible.
        diffuse: whether any number of false measurements in the gates of a cluster is equally probable a priori
            (non-parametric JPDA).  Otherwise their number is Poisson, and ``c`` is their expected density.
        log_membership: ``(..., N, J)`` log of how far each measurement is inside each gate, if gates have soft edges: 0
            inside, minus infinity outside.  ``diffuse`` counts measurements by it.
        exact: largest number of targets and of gated measurements of a cluster whose joint events are enumerated.
            Larger clusters use belief propagation, as do single targets, for which it is exact.
        iterations: largest number of rounds of belief propagation; it stops earlier once its messages have converged.
            Under ``torch.compile`` and ``torch.func`` there are 50 at most.

    Raises:
        ValueError: no target or no measurement, or ``exact`` allows more than 300,000 combinations, ``(measurements
            + 1)^targets``.

    Source: Fortmann, Bar-Shalom & Scheffe (1983); Chen, Zou & Wu, eqs. (25)-(27).
    """
    targets, count = log_ratio.shape[-2:]
    if min(targets, count) < 1:
        raise ValueError(f"log_ratio: expected (..., N, J) with N and J of 1 or more, received {targets, count}")
    log_miss = torch.as_tensor(log_miss, dtype=log_ratio.dtype, device=log_ratio.device)
    batch = broadcast_shapes(log_ratio.shape[:-2], log_miss.shape[:-1])
    scans = _gated_scans(log_ratio, log_miss, log_membership, batch, diffuse)
    log_weights, evidence = _associate(scans, exact, iterations)
    return Association(log_weights.reshape(*batch, targets, count + 1), evidence.reshape(*batch, targets))


def _gated_scans(
    log_ratio: Tensor, log_miss: Tensor, log_membership: Tensor | None, batch: torch.Size, diffuse: bool
) -> GatedScans:
    """All scans of a batch along one dimension."""
    targets, count = log_ratio.shape[-2:]
    ratio = log_ratio.expand(*batch, targets, count).reshape(-1, targets, count)
    miss = log_miss.expand(*batch, targets).reshape(-1, targets)
    gated = ratio > -torch.inf
    if log_membership is None:
        membership = gated.to(ratio)
    else:
        membership = log_membership.expand(*batch, targets, count).reshape(ratio.shape).exp()
    return GatedScans(ratio, miss, gated, find_clusters(gated, membership), diffuse)


def _associate(scans: GatedScans, exact: tuple[int, int], iterations: int) -> Association:
    """Each cluster the way that its size asks for."""
    (targets, count), clusters, traced = scans.log_ratio.shape[-2:], scans.clusters, is_traced(scans.log_ratio)
    if is_elementary():
        check_sets(targets, count, exact)
        return sum_over_sets(scans)
    table = min(exact[0], targets), min(exact[1], count)
    several = clusters.size > 1
    small = several & (clusters.size <= exact[0]) & (clusters.gated <= exact[1])
    large = several & ~small
    association = each_alone(scans)
    if traced:
        if (targets, count) != table:
            found = belief_propagation(scans, min(iterations, _TRACED_ITERATIONS))
            association = choose(several, found, association)
    elif bool(large.any()):
        solve = partial(sum_by_messages, iterations=iterations)
        association = associate_by_tables(scans, large, (targets, count), solve, association)
    if targets > 1 and min(table) >= 1 and (traced or bool(small.any())):
        association = associate_by_tables(scans, small, table, sum_over_events, association)
    return association
