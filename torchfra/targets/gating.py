"""Coarse gates that find, before a filter runs, which measurements may be a target's."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.association.gates import Candidates, ChiSquare, Gate
from torchfra.linalg.triangular import tria
from torchfra.sensors.base import Sensor
from torchfra.targets.assignment import chi_square
from torchfra.types import Gaussian

_WIDER = 1.25
"""Factor by which these gates are wider than the filter's own: they use the covariance of the predicted measurement to
first order only."""


def in_reach(gate: Gate, sensor: Sensor, predicted: Gaussian, scans: Tensor, scene: Tensor, heat: float) -> Tensor:
    """Measurements of its scene that may be in the gate of each target: ``(N, J)`` bool, False for missing ones.

    Args:
        gate: the gate of the filter.
        sensor: the sensor of the scan.
        predicted: measurements ``(N,)``, see ``filters.scans.managed.predict_measurements``.
        scans: ``(R, J, m)``; NaN is missing.
        scene: ``(N,)`` number of each target's scene.
        heat: temperature of the gate.
    """
    z = scans.expand(len(scene), -1, -1) if len(scans) == 1 else scans[scene]
    measured, centre = ~scans.isnan(), predicted.mean.unsqueeze(-2)
    gap = sensor.difference(z, centre)
    kind = measured.to(torch.int64) @ (2 ** torch.arange(sensor.size, device=z.device))  # which elements, as bits
    kinds = [bits for bits in kind.unique().tolist() if bits]
    nis = torch.full_like(gap[..., 0], torch.inf)
    for bits in kinds:  # one, unless devices measure parts of it
        some = [i for i in range(sensor.size) if bits >> i & 1]
        root, part = predicted.scale_tril, gap
        if len(some) < sensor.size:
            root, part = tria(root[:, some]), gap[..., some]
        white = torch.linalg.solve_triangular(_WIDER * root, part.mT, upper=False)
        squared = torch.stack(white.unbind(-2)).square().sum(0)  # NaN, which no gate holds, where it is missing
        nis = squared if len(kinds) == 1 else torch.where((kind == bits)[scene], squared, nis)
    number = measured.sum(-1)
    if isinstance(gate, ChiSquare) and heat == 0:
        inside: Tensor = nis <= _quantiles(gate, z)[number][scene]
        return inside
    there = measured[scene]
    candidates = Candidates(torch.where(there, z, centre), centre.expand_as(z), there.to(z), nis)
    membership: Tensor = gate(candidates, sensor, heat)
    return (membership > -torch.inf) & (number > 0)[scene]


def _quantiles(gate: ChiSquare, like: Tensor) -> Tensor:
    """``(m + 1,)`` largest normalised innovation squared in the gate, by the number of measured elements."""
    probability = gate.probability(like).item()
    return like.new_tensor([-1.0, *(chi_square(probability, k) for k in range(1, like.shape[-1] + 1))])
