"""Probabilities of joint association: exact for small clusters, by belief propagation beyond."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.association.clusters import Association, Clusters, clusters
from torchfra.association.events import _enumerated
from torchfra.association.messages import propagate
from torchfra.linalg.tracing import is_traced

_UNROLLED = 50
"""Rounds of messages at most where they are traced one by one."""


def associate(
    log_ratio: Tensor,
    log_miss: Tensor,
    *,
    diffuse: bool = False,
    inside: Tensor | None = None,
    exact: tuple[int, int] = (4, 10),
    iterations: int = 200,
) -> Association:
    """Probabilities of association, summed over all joint events.

    Args:
        log_ratio: ``(..., N, J)`` log of ``P_D L / c`` for target and measurement: likelihood against the density of
            false measurements there; minus infinity outside the gate.
        log_miss: ``(..., N)``, or what broadcasts with it: log of the probability to have no measurement in the gate.
            Minus infinity for targets that are always measured: then as few as can be are missed.
        diffuse: any number of false measurements is equally likely beforehand (non-parametric), counted in the gates of
            each cluster; else they are Poisson, and ``c`` is their expected density.
        inside: ``(..., N, J)`` log of how far each measurement is inside each gate, where gates have soft edges: it is
            counted so far.
        exact: targets and gated measurements up to which the events of a cluster are enumerated; larger clusters run
            belief propagation, as do single targets, for which it is exact.
        iterations: of belief propagation at most; it stops when all messages have settled.

    Raises:
        ValueError: no target or no measurement at all, or ``exact`` asks for more than 300,000 choices, ``(measurements
            + 1)^targets``.

    Under ``torch.compile`` and transforms, where clusters may be too large for events, belief propagation has 50 rounds
    at most.

    Source: Fortmann, Bar-Shalom & Scheffe (1983); Chen, Zou & Wu, eqs. (25)-(27).
    """
    targets, count = log_ratio.shape[-2:]
    if min(targets, count) < 1:
        raise ValueError(
            f"log_ratio: expected (..., N, J) of one target and measurement or more, received {targets, count}"
        )
    log_miss = torch.as_tensor(log_miss, dtype=log_ratio.dtype, device=log_ratio.device)
    batch = torch.broadcast_shapes(log_ratio.shape[:-2], log_miss.shape[:-1])
    ratio = log_ratio.expand(*batch, targets, count).reshape(-1, targets, count)
    miss = log_miss.expand(*batch, targets).reshape(-1, targets)
    gated = ratio > -torch.inf
    together = clusters(gated)
    member = gated.to(ratio) if inside is None else inside.expand(*batch, targets, count).reshape(ratio.shape).exp()
    # How far each measurement is in a gate of each target's cluster: (R, N, J).
    shared = torch.where(together.unsqueeze(-1), member.unsqueeze(-3), 0.0).amax(-2)
    within = Clusters(together, together.sum(-1), (shared > 0).sum(-1), shared.sum(-1))
    table = min(exact[0], targets), min(exact[1], count)
    by_events = (within.size > 1) & (within.size <= exact[0]) & (within.gated <= exact[1])
    beyond = (within.size > 1) & ~by_events
    traced = is_traced(log_ratio)
    # Single targets are done without, and where all clusters are small nothing else is left.
    crowded = (targets, count) != table if traced else bool(beyond.any())
    rounds = (min(iterations, _UNROLLED) if traced else iterations) if crowded else 0
    found = propagate(ratio, miss, within, diffuse=diffuse, iterations=rounds)
    if targets > 1 and min(table) >= 1 and (traced or bool(by_events.any())):
        found = _enumerated(ratio, miss, gated, within, by_events, table, diffuse, found, traced)
    return Association(found.log_weights.reshape(*batch, targets, count + 1), found.evidence.reshape(*batch, targets))
