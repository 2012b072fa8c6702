"""Which measurements may be a target's: gates before any filter runs."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.association.gates import Candidates, ChiSquare, Gate
from torchfra.linalg.triangular import hstack, tria, whiten
from torchfra.sensors.base import Sensor
from torchfra.targets.assignment import scipy
from torchfra.types import Gaussian

_WIDER = 1.25
"""How many times wider than the filter's own gates those are that clusters are made by: these look at the covariance to
first order and at the nominal noise only."""


def expected(sensor: Sensor, belief: Gaussian, u: Tensor | None) -> Gaussian:
    """What a sensor will measure: mean ``(N, m)`` and root of the innovation's covariance, by points of third degree.

    Args:
        sensor: it measures.
        belief: predictions ``(N,)``.
        u: ``(N, k)`` or None.
    """
    mean, root = belief
    n = mean.shape[-1]
    offsets = (n**0.5 * root).movedim(-1, 0)  # (n, N, n)
    points = torch.cat([mean.unsqueeze(0), mean + offsets, mean - offsets])
    z = sensor.at_points(points, u)
    spread = sensor.difference(z[1:], z[:1]).movedim(0, -1) / (2 * n) ** 0.5  # (N, m, 2n)
    unit = sensor.measurement_noise(torch.zeros_like(z[0]))
    noise = unit.colour(torch.eye(sensor.size, dtype=mean.dtype, device=mean.device).expand(len(mean), -1, -1))
    return Gaussian(z[0], tria(hstack(spread, noise)))


def in_reach(gate: Gate, sensor: Sensor, predicted: Gaussian, z: Tensor, temperature: float) -> Tensor:
    """Which measurements ``(N, J, m)`` may be in the gate of each target: ``(N, J)`` bool; none that is missing.

    Args:
        gate: the filter's.
        sensor: it measured.
        predicted: measurements ``(N,)``, see ``expected``.
        z: NaN is missing.
        temperature: of the gate.
    """
    seen = ~z.isnan()
    centre = predicted.mean.unsqueeze(-2)
    gap = torch.where(seen, sensor.difference(torch.where(seen, z, centre), centre), 0.0)
    nis = torch.full(z.shape[:-1], torch.inf, dtype=z.dtype, device=z.device)
    patterns = torch.unique(seen.reshape(-1, seen.shape[-1]), dim=0)
    for pattern in patterns[patterns.any(-1)]:  # one, unless devices measure parts of it
        root = tria(predicted.scale_tril[:, pattern])
        squared = whiten(root.unsqueeze(-3), gap[..., pattern]).square().sum(-1)
        nis = torch.where((seen == pattern).all(-1), squared / _WIDER**2, nis)
    if isinstance(gate, ChiSquare) and temperature == 0:
        largest: Tensor = _quantiles(gate, z)[seen.sum(-1)]
        return nis <= largest
    candidates = Candidates(torch.where(seen, z, centre), centre.expand_as(z), seen.to(z), nis)
    membership: Tensor = gate(candidates, sensor, temperature)
    return (membership > -torch.inf) & seen.any(-1)


def _quantiles(gate: ChiSquare, like: Tensor) -> Tensor:
    """``(m + 1,)`` largest normalised innovation squared in the gate, by the number of elements; none for 0."""
    special = scipy("special")
    probability = gate.probability(like).item()
    numbers = [special.gammainccinv(k / 2, 1 - probability) * 2 for k in range(1, like.shape[-1] + 1)]
    return like.new_tensor([-1.0, *numbers])
