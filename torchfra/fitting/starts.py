"""Priors for tracks without one, from the first measurement of each."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.targets.births import OnePoint
from torchfra.targets.places import place
from torchfra.types import Gaussian


class First(NamedTuple):
    """The first measurement of a track, from which its prior is made with the current noise; it is not used again."""

    z: Tensor
    """``(N, m)``."""
    u: Tensor | None
    """``(N, k)`` inputs of the sensor."""
    speed: Tensor
    """``(N,)`` m/s, the standard deviation of the velocity in each direction."""


def from_first_measurement(z: Tensor, *others: Tensor | None) -> tuple[Tensor, ...]:
    """Tracks ``(N, T, ...)`` shifted so that they begin with their first complete measurement.

    Args:
        z: ``(N, T, m)`` measurements; shifted ones are padded with NaN.
        others: further values of the steps, ``(N, T, ...)``, padded with their last step; None is left out.

    Raises:
        ValueError: a track without a complete measurement.
    """
    complete = ~z.isnan().any(-1)
    if not bool(complete.any(1).all()):
        lacking = (~complete.any(1)).nonzero().flatten().tolist()
        raise ValueError(f"data: expected a whole measurement in each track, received none in tracks {lacking[:5]}")
    steps = torch.arange(z.shape[1], device=z.device) + complete.to(torch.int8).argmax(1, keepdim=True)  # (N, T)
    over, steps = steps >= z.shape[1], steps.clamp_max(z.shape[1] - 1)

    def moved(x: Tensor) -> Tensor:
        index = steps.reshape(*steps.shape, *[1] * (x.dim() - 2)).expand(*steps.shape, *x.shape[2:])
        return x.expand(*z.shape[:2], *x.shape[2:]).gather(1, index)

    parts = [moved(x) for x in others if x is not None]
    return torch.where(over.unsqueeze(-1), torch.nan, moved(z)), *parts


def first_measurements(motion: Motion, sensor: Sensor, z: Tensor, dt: Tensor, u: Tensor | None) -> First:
    """The first measurements of tracks ``(N, T, m)``, with twice the speed of a typical first step.

    Args:
        motion: of the targets.
        sensor: one that ``locates``.
        z: measurements, the first of each track complete.
        dt: ``(N, T)`` seconds.
        u: ``(N, T, k)`` inputs of the sensor.

    Raises:
        ValueError: the sensor does not locate targets, or tracks have one step.
    """
    if not sensor.locates:
        expected = f"one belief per track, as {sensor.describe()} does not tell where a target is (locates, locate)"
        raise ValueError(f"prior: expected {expected}, received none")
    if z.shape[1] < 2:
        raise ValueError("data: expected two steps or more in tracks without a prior, received one")
    here, there = (place(motion, sensor, z[:, k], None if u is None else u[:, k]).mean for k in (0, 1))
    speed = ((there - here) / dt[:, 1:2]).square().sum(-1).nanmean().sqrt()
    speed = torch.where(speed > 0, 2.0 * speed, OnePoint().velocity)
    return First(z[:, 0], None if u is None else u[:, 0], speed.expand(len(z)))


def started(motion: Motion, sensor: Sensor, first: First) -> Gaussian:
    """Beliefs ``(..., N, n)`` at the first measurements, with the sensor's current noise and a velocity of 0.

    All other components are those of a birth (``torchfra.targets.births.OnePoint``).
    """
    at = place(motion, sensor, first.z, first.u)
    dims = at.mean.shape[-1]
    free = first.speed[:, None, None] * torch.eye(dims, dtype=at.mean.dtype, device=at.mean.device)
    free = free.expand_as(at.scale_tril)
    both = torch.cat([pad(at.scale_tril, (0, dims)), pad(free, (dims, 0))], -2)
    return OnePoint().belief(motion, pad(at.mean, (0, dims)), both)
