"""A prior for tracks that come without one: from the first measurement of each."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.targets.births import OnePoint
from torchfra.targets.places import place
from torchfra.types import Gaussian

WIDER = 10.0
"""Standard deviations of the first measurement that a start is wide, so that the measurement itself counts, whatever
the noise is found to be."""


def first_seen(z: Tensor, *others: Tensor | None) -> tuple[Tensor, ...]:
    """Tracks ``(N, T, ...)`` that begin with their first whole measurement, what was before it gone.

    Args:
        z: ``(N, T, m)`` measurements; those moved forward end in NaN.
        others: of the same steps, ``(N, T, ...)``; None stays out.  They end in copies of their last step.

    Raises:
        ValueError: a track without a whole measurement.
    """
    seen = ~z.isnan().any(-1)
    if not bool(seen.any(1).all()):
        lacking = (~seen.any(1)).nonzero().flatten().tolist()
        raise ValueError(f"data: expected a whole measurement in each track, received none in tracks {lacking[:5]}")
    steps = torch.arange(z.shape[1], device=z.device) + seen.to(torch.int8).argmax(1, keepdim=True)  # (N, T)
    over, steps = steps >= z.shape[1], steps.clamp_max(z.shape[1] - 1)

    def moved(x: Tensor) -> Tensor:
        index = steps.reshape(*steps.shape, *[1] * (x.dim() - 2)).expand(*steps.shape, *x.shape[2:])
        return x.expand(*z.shape[:2], *x.shape[2:]).gather(1, index)

    parts = [moved(x) for x in others if x is not None]
    return torch.where(over.unsqueeze(-1), torch.nan, moved(z)), *parts


def started(motion: Motion, sensor: Sensor, z: Tensor, dt: Tensor, u: Tensor | None) -> Gaussian:
    """Beliefs ``(N, n)`` around the first measurement of each track, ten times as wide as it.

    The velocity is unknown: around 0, with twice the root mean square of the first steps' speeds as its standard
    deviation.  Components beside position and velocity begin as births do (``torchfra.targets.births.OnePoint``).

    Args:
        motion: of the targets.
        sensor: one that ``locates``.
        z: ``(N, T, m)`` measurements, the first of each whole.
        dt: ``(N, T)`` seconds.
        u: ``(N, T, k)`` what the sensor needs to know.

    Raises:
        ValueError: the sensor does not tell where a target is.
    """
    if not sensor.locates:
        expected = f"one belief per track, as {sensor.describe()} does not tell where a target is"
        raise ValueError(f"prior: expected {expected}, received none")
    places = [place(motion, sensor, z[:, k], None if u is None else u[:, k]) for k in range(min(2, z.shape[1]))]
    first, dims = places[0], places[0].mean.shape[-1]
    speed = first.mean.new_tensor(torch.nan)
    if len(places) > 1:
        gap = (places[1].mean - first.mean) / dt[:, 1:2]
        speed = gap.square().sum(-1).nanmean().sqrt()
    birth = OnePoint(2.0 * float(speed) if bool(speed > 0) else OnePoint().velocity)
    free = torch.eye(dims, dtype=z.dtype, device=z.device).expand(len(z), -1, -1) * birth.velocity
    root = torch.cat([
        torch.cat([WIDER * first.scale_tril, torch.zeros_like(free)], -1), torch.cat([torch.zeros_like(free), free], -1)
    ], -2)  # fmt: skip
    return birth.belief(motion, torch.cat([first.mean, torch.zeros_like(first.mean)], -1), root)
