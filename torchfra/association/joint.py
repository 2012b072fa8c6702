"""Probabilities of joint association: exact for small clusters, by belief propagation for larger ones."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.association.clusters import Association, GatedScans, choose, find_clusters
from torchfra.association.events import sum_over_events
from torchfra.association.messages import belief_propagation, each_alone, sum_by_messages
from torchfra.association.sets import check_sets, sum_over_sets
from torchfra.linalg.batches import broadcast_shapes
from torchfra.linalg.tracing import is_elementary, is_traced
from torchfra.numbers import as_tensor

Solve = Callable[[Tensor, Tensor, Tensor, bool], tuple[Tensor, Tensor]]
"""From ``log_ratio (K, n, j)``, ``log_miss (K, n)`` and ``weight (K,)`` of clusters, and whether they are diffuse, to
log probabilities ``(K, n, j + 1)`` and the log ``(K,)`` of the sum over all joint events."""


def associate(
    log_ratio: Tensor,
    log_miss: Tensor | float,
    *,
    diffuse: bool = False,
    log_membership: Tensor | None = None,
    exact: tuple[int, int] = (4, 10),
    permutations: bool = True,
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
            Larger clusters use belief propagation, of 200 rounds at most (50 under ``torch.compile`` and
            ``torch.func``), as do single targets, for which it is exact.
        permutations: whether all joint events count.  False keeps, of those in which the same targets have the same
            measurements, the most probable one alone, all of them where several are as probable (JPDA*): estimates of
            targets that stay beside one another then do not move together.  The evidence is that of all events, and
            clusters larger than ``exact`` count all.

    Raises:
        NotImplementedError: a kernel without permutations.
        ValueError: no target or no measurement, or ``exact`` allows more than 300,000 combinations, ``(measurements
            + 1)^targets``.

    Source: Fortmann, Bar-Shalom & Scheffe (1983); Chen, Zou & Wu, eqs. (25)-(27); Blom & Bloem (2000), "Probabilistic
    Data Association Avoiding Track Coalescence", for JPDA*.
    """
    targets, count = log_ratio.shape[-2:]
    if min(targets, count) < 1:
        raise ValueError(f"log_ratio: expected (..., N, J) with N and J of 1 or more, received {targets, count}")
    log_miss = as_tensor(log_miss, log_ratio)
    batch = broadcast_shapes(log_ratio.shape[:-2], log_miss.shape[:-1])
    scans = _gated_scans(log_ratio, log_miss, log_membership, batch, diffuse)
    log_weights, evidence = _associate(scans, exact, permutations)
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


def _associate(scans: GatedScans, exact: tuple[int, int], permutations: bool) -> Association:
    """The association of all clusters, each by the method for its size."""
    (targets, count), clusters, traced = scans.log_ratio.shape[-2:], scans.clusters, is_traced(scans.log_ratio)
    if is_elementary():
        check_sets(targets, count, exact, permutations)
        return sum_over_sets(scans)
    table = min(exact[0], targets), min(exact[1], count)
    several = clusters.size > 1
    small = several & (clusters.size <= exact[0]) & (clusters.gated <= exact[1])
    large = several & ~small
    association = each_alone(scans)
    if traced:
        if (targets, count) != table:
            association = choose(several, belief_propagation(scans), association)
    elif bool(large.any()):
        association = _associate_by_tables(scans, large, (targets, count), sum_by_messages, association)
    if targets > 1 and min(table) >= 1 and (traced or bool(small.any())):
        solve = partial(sum_over_events, permutations=permutations)
        association = _associate_by_tables(scans, small, table, solve, association)
    return association


class _Table(NamedTuple):
    """K clusters, each as a table of n targets and j measurements at most; each is known by its first target."""

    first: Tensor
    """``(R, N)`` number of the first target of each target's cluster."""
    place: Tensor
    """``(K,)`` number of the first target among those of all scans, ``scan * N + head``."""
    scan: Tensor
    """``(K,)`` number of the scan."""
    head: Tensor
    """``(K,)`` number of the first target in its scan."""
    log_ratio: Tensor
    """``(K, n, j)``."""
    log_miss: Tensor
    """``(K, n)``."""
    gated: Tensor
    """``(K, J)`` bool: which measurements are in the gates of the cluster."""


def _associate_by_tables(
    scans: GatedScans, chosen: Tensor, table: tuple[int, int], solve: Solve, otherwise: Association
) -> Association:
    """Association of some clusters, all by the same sum over their joint events.

    Args:
        scans: measurements against targets.
        chosen: ``(R, N)`` bool: whether the target's cluster is one of them.
        table: number of targets and of gated measurements that the largest of them has, or more.
        solve: sums over the events of each.
        otherwise: the association of the other targets.
    """
    packed = _pack(scans, chosen, table)
    weight = scans.clusters.weight[packed.scan, packed.head]
    solved = solve(packed.log_ratio, packed.log_miss, weight, scans.diffuse)
    return choose(chosen, _unpack(scans, packed, *solved), otherwise)


def _pack(scans: GatedScans, chosen: Tensor, table: tuple[int, int]) -> _Table:
    """The chosen clusters as tables; where code is traced, a table for every target, since shapes must be known."""
    scan_count, targets, _ = scans.log_ratio.shape
    first = scans.clusters.members.to(torch.int64).argmax(-1)
    numbers = torch.arange(scan_count * targets, device=chosen.device)
    if is_traced(scans.log_ratio):
        place = numbers
    else:
        heads = chosen & (first == numbers[:targets])
        place = numbers[heads.flatten()]
        table = int(scans.clusters.size[heads].amax()), max(int(scans.clusters.gated[heads].amax()), 1)
    scan, head = place // targets, place % targets
    members = scans.clusters.members[scan, head]  # (K, N)
    gated = (members.unsqueeze(-1) & scans.gated[scan]).any(-2)  # (K, J)
    rows, columns = _true_first(members, table[0]), _true_first(gated, table[1])  # (K, n), (K, j)
    used = members.gather(-1, rows)
    log_ratio = scans.log_ratio[scan.unsqueeze(-1), rows].gather(-1, columns.unsqueeze(-2).expand(-1, table[0], -1))
    log_ratio = torch.where(used.unsqueeze(-1), log_ratio, -torch.inf)
    log_miss = torch.where(used, scans.log_miss[scan.unsqueeze(-1), rows], 0.0)
    return _Table(first, place, scan, head, log_ratio, log_miss, gated)


def _true_first(mask: Tensor, count: int) -> Tensor:
    """``(..., count)`` indices of ``mask (..., n)``: first the true entries in order, then the false ones."""
    return mask.to(torch.int8).sort(dim=-1, descending=True, stable=True)[1][..., :count]


def _unpack(scans: GatedScans, packed: _Table, log_weights: Tensor, log_total: Tensor) -> Association:
    """Each target looks up its cluster's table, its row there, and the column of each measurement."""
    scan_count, targets, _ = scans.log_ratio.shape
    slots, columns = log_weights.shape[-2], log_weights.shape[-1] - 1
    numbers = torch.arange(scan_count * targets, device=log_weights.device)
    tables = torch.zeros_like(numbers).index_put((packed.place,), numbers[: len(packed.place)])
    table = tables[numbers[:scan_count].unsqueeze(-1) * targets + packed.first]  # (R, N)
    row = (scans.clusters.members.cumsum(-1) - 1).diagonal(dim1=-2, dim2=-1).clamp(0, slots - 1)
    target = log_weights[table, row]  # (R, N, j + 1)
    column = (packed.gated.cumsum(-1) * packed.gated)[table]  # 0 for measurements in no gate of the cluster
    column = torch.where(column <= columns, column, 0)
    measured = torch.where(column > 0, target.gather(-1, column), -torch.inf)
    return Association(torch.cat([target[..., :1], measured], -1), log_total[table] / scans.clusters.size)
