"""Checks of angles: what jumps by a turn is declared, in rad."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.testing.expectations import expect
from torchfra.testing.part import Part

CIRCLES = (1e2, 1e4, 1e6, 1e8)
"""Radii, m, of the ways round the origin: of a station inside, the bearing jumps, wherever it stands."""
UNITS = ((2 * math.pi, "rad"), (360.0, "degrees"))


def angles(part: Part) -> None:
    """Of a sensor: elements that jump by a turn where the target goes round are declared as angles, in rad."""
    sensor, x = part.model, part.x[:1]
    assert isinstance(sensor, Sensor)
    if sensor.reads < 2:
        return
    turn = torch.linspace(0, 2 * math.pi, 721, dtype=torch.float64)
    u = None if part.u is None else part.u[:1].expand(len(turn), -1)
    for radius in CIRCLES:
        circle = radius * torch.stack([turn.cos(), turn.sin()], -1)
        round_about = torch.cat([circle, x[:, 2:].expand(len(turn), -1)], -1)
        measured = part.function(round_about, part.dt[:1].expand(len(turn)), u)
        for i, declared in enumerate(sensor.angles.tolist()):
            what = f"element {i} of a measurement, of a target that goes round"
            for size, unit in UNITS:
                right = not _jumps(measured[:, i], size) or (declared and unit == "rad")
                expect(right, what, "an angle in rad, declared in angles=", f"a jump by a turn in {unit}")


def angles_of_states(part: Part) -> None:
    """Of a motion: components that it writes within a turn are declared as angles, in rad."""
    motion = part.model
    assert isinstance(motion, Motion)
    u = None if part.u is None else part.u[:1]
    for i in range(motion.size):
        for size, unit in UNITS:
            x = part.x[:1].repeat(721, 1)
            x[:, i] = torch.linspace(-size, size, 721, dtype=torch.float64)
            moved = part.function(x, part.dt[:1].expand(721), None if u is None else u.expand(721, -1))[:, i]
            right = not _jumps(moved, size) or (i in motion.angles and unit == "rad")
            what = f"component {i}, {motion.components[i]!r}, of a state that goes round"
            expect(right, what, "an angle in rad, declared in angles=", f"a jump by a turn in {unit}")


def _jumps(values: Tensor, size: float) -> bool:
    """Whether one after the other they are near, but for jumps by a turn."""
    gaps = values.diff().abs()
    jumps = (gaps - size).abs() < 0.01 * size
    return bool(jumps.any()) and bool((gaps[~jumps] < 0.2 * size).all())
