"""All targets of all scenes against a scan: predicted, gated, split into clusters, and each cluster filtered."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfra import tree
from torchfra.filters.scans.jpda import JPDA
from torchfra.filters.scans.managed import among, outlook, stepped
from torchfra.gaussian.inputs import Measurements
from torchfra.targets.clusters import Group, clusters
from torchfra.targets.gating import in_reach
from torchfra.targets.state import rows
from torchfra.types import Gaussian


class Look(NamedTuple):
    """One scan of all scenes."""

    z: Tensor
    """``(R, J, m)``; NaN is missing."""
    dt: Tensor
    """``(R,)`` seconds since the last one."""
    u: Tensor | None
    """``(R, k)``."""


class Said(NamedTuple):
    """What a scan has said of N targets and of its measurements."""

    log_missed: Tensor
    """``(N,)`` log probability that each was missed."""
    density: Tensor
    """``(N,)`` log density of the scan against one of false measurements alone, shared out among them."""
    explained: Tensor
    """``(R, J)`` probability that each measurement is a target's."""


def look_at(filter: JPDA, state: Any, scene: Tensor, look: Look) -> tuple[Any, Said, list[Group]]:
    """One step of all targets.

    Args:
        filter: of scans.
        state: its state, rows of ``(N, ...)``.
        scene: ``(N,)`` of each target.
        look: the scan.

    Returns:
        The next state, what the scan has said, and the clusters that shared measurements.
    """
    there = ~look.z.isnan().all(-1)
    explained = look.z.new_zeros(there.numel())
    if len(scene) == 0:
        return state, Said(explained[:0], explained[:0], explained.reshape(there.shape)), []
    with torch.no_grad():
        groups = clusters(_reach(filter, state, scene, look), scene)
    nothing = look.z.new_full((1, filter.sensor.size), torch.nan)
    table = torch.cat([look.z.flatten(0, 1), nothing])  # the last row is none
    parts, missed, density = [], [], []
    for targets, measurements in groups:
        of, group = scene[targets[:, 0]], rows(state, targets)
        after, (association, evidence) = stepped(filter, among, group, _measured(table[measurements], of, look))
        share = association[..., 1:].sum(-2)
        inside = measurements >= 0
        explained = explained.index_put((measurements[inside],), share[inside], accumulate=True)
        parts.append(tree.map_tensors(lambda x: x.flatten(0, 1), after))
        missed.append(association[..., 0].log().flatten())
        density.append(evidence.flatten())
    order = torch.cat([group.targets.flatten() for group in groups]).argsort()
    state = tree.map_tensors(lambda *xs: torch.cat(xs)[order], *parts)
    said = Said(torch.cat(missed)[order], torch.cat(density)[order], explained.reshape(there.shape))
    return state, said, groups


def _reach(filter: JPDA, state: Any, scene: Tensor, look: Look) -> Tensor:
    """Which measurements ``(N, J)`` of its scene may be in the gate of each target."""
    alone = tree.map_tensors(lambda x: x.unsqueeze(1), state)  # each target in a scene of its own
    anything = look.z.new_zeros(len(scene), 1, filter.sensor.size)
    _, predicted = stepped(filter, outlook, alone, _measured(anything, scene, look))
    predicted = Gaussian(*(x.squeeze(1) for x in predicted))
    return in_reach(filter.gate, filter.sensor, predicted, look.z, scene, filter.temperature)


def _measured(z: Tensor, scene: Tensor, look: Look) -> Measurements:
    """Measurements ``(C, J, m)`` of clusters in their scenes."""
    return Measurements(z, look.dt[scene], None if look.u is None else look.u[scene])
