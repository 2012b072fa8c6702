"""A target in the plane that turns, seen by a lidar.

Source: Greenberg, Yannay & Mannor (2023), "Optimization or Architecture: How to Hack Kalman Filtering", for the target,
the lidar and the start of a track; numbers that the paper does not print are those of the example that its authors have
published with it ("simple lidar").
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from learned.okf import Cholesky, Model, Tracks, draws
from torchfra.sensors import Position
from torchfra.sensors.base import MeasurementNoise

PLACE, SPEEDS = 600.0, (30.0, 90.0)
"""A start is at most so far off in x and y, m, and has one of these speeds, m/s."""
INTERVALS, LENGTHS = (4, 6), (5, 8)
"""How many parts of constant acceleration a track has, and how many steps of a second each, the ends included."""
ALONG, ACROSS = 2.0, 15.0
"""Accelerations of a part, m/s^2: the standard deviation along the path, and the largest across."""
RANGE, BEARING = 2.0, math.radians(1.5)
"""Standard deviations of the lidar, m and rad."""
MODEL = Model(lambda place: torch.eye(2, 4, dtype=place.dtype), lambda z: torch.cat([z, torch.zeros_like(z)], -1), 1e3)
"""Positions are measured, of a target that is at rest at first."""


def simulate(runs: int, seed: int) -> Tracks:
    """Tracks of a target that goes straight and turns in parts of constant acceleration."""
    uniform, normal = draws(runs, seed)
    most, steps = INTERVALS[1], INTERVALS[1] * LENGTHS[1]
    parts = uniform(INTERVALS[0], INTERVALS[1] + 1, 1).long()
    ends = uniform(LENGTHS[0], LENGTHS[1] + 1, most).long().cumsum(-1)
    part = (torch.arange(steps) >= ends.unsqueeze(-1)).sum(1)  # (B, T) number of the part that a step is in
    lasts = part < parts
    along, across = (
        x.gather(1, part.clamp_max(most - 1)) for x in (ALONG * normal(most), uniform(-ACROSS, ACROSS, most))
    )
    heading, speed = uniform(0.0, 2 * math.pi), uniform(*SPEEDS)
    place, velocity = uniform(-PLACE, PLACE, 2), speed.unsqueeze(-1) * torch.stack([heading.cos(), heading.sin()], -1)
    states = [torch.cat([place, velocity], -1)]
    for forward, aside in zip(along.unbind(-1), across.unbind(-1), strict=True):
        heading_unit = velocity / velocity.norm(dim=-1, keepdim=True)
        left = torch.stack([-heading_unit[:, 1], heading_unit[:, 0]], -1)
        acceleration = forward.unsqueeze(-1) * heading_unit + aside.unsqueeze(-1) * left
        place, velocity = place + velocity + acceleration / 2, velocity + acceleration
        states.append(torch.cat([place, velocity], -1))
    there = torch.cat([torch.ones(runs, 1, dtype=torch.bool), lasts], 1)
    truth = torch.where(there.unsqueeze(-1), torch.stack(states, 1), torch.nan)
    distance = truth[..., :2].norm(dim=-1) + RANGE * normal(steps + 1)
    bearing = torch.atan2(truth[..., 1], truth[..., 0]) + BEARING * normal(steps + 1)
    return Tracks(truth, distance.unsqueeze(-1) * torch.stack([bearing.cos(), bearing.sin()], -1))


def polar(z: Tensor) -> Tensor:
    """Positions ``(..., 2)`` as ranges, m, and bearings clockwise from +y, rad."""
    return torch.stack([z.norm(dim=-1), torch.atan2(z[..., 0], z[..., 1])], -1)


class AnyPosition(Position):
    """The position, with noise of any covariance ``(2, 2)``."""

    def __init__(self, covariance: Tensor) -> None:
        super().__init__(noise=torch.linalg.cholesky(covariance))
        self.noise = Cholesky(covariance)

    def measurement_noise(self, z: Tensor, std: Tensor | None = None, root: Tensor | None = None) -> MeasurementNoise:
        """As it is learned, where a measurement has none of its own."""
        return super().measurement_noise(z, std, self.noise(z) if std is None and root is None else root)
