"""Many aircraft that appear and disappear among false measurements, watched as in ``scenarios.clutter_straight``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchfra.association.clutter import Clutter
from torchfra.coordinates import belief_from_cartesian
from torchfra.motion.polynomial import ConstantVelocity
from torchfra.motion.spherical import Spherical
from torchfra.numbers import is_integer
from torchfra.scenarios.base import BLOCK, Scenario, Tracks
from torchfra.scenarios.clutter import DT, REGION, ROOT, STEPS, Conditions, Q, cartesian, scanned, targets
from torchfra.types import Gaussian

_CORNERS = torch.tensor([[500.0, 500.0, 500.0], [3500.0, 3500.0, 1500.0]], dtype=torch.float64)
"""Corners of the box in which aircraft begin, m."""
_SPEEDS = 20.0, 60.0
"""Least and largest ground speed of the aircraft, m/s."""
_CLIMB = 5.0
"""Standard deviation of the vertical speed, m/s."""
_LATEST, _EARLIEST = 0.3, 0.7
"""Fractions of the scans at which the last aircraft appears at the latest, and the first disappears at the earliest."""


def clutter_many(
    *,
    count: int = 10,
    clutter: int = 30,
    detection: float = 0.95,
    std: Sequence[float] = (1e-3, 1e-3, 5.0),
    truth_noise: float = 0.25,
) -> Scenario:
    """Aircraft that begin anywhere, fly anywhere at 20 to 60 m/s, and appear and disappear; 100 scans, 1 s apart.

    Each appears at a scan in the first 30 % and disappears at one in the last 30 %: its truth is NaN outside.  The
    prior is the belief of each one step before the first scan.

    Args:
        count: number of aircraft.
        clutter: false measurements per scan, divided among the aircraft, present or not.
        detection: probability that an aircraft is measured.
        std: of azimuth, elevation (rad) and range (m).
        truth_noise: variance of the aircraft's random acceleration, m^2/s^4.

    Raises:
        ValueError: an argument out of its range.

    Source: sensor, clutter and motion of Chen, Zou & Wu.  Differs: the aircraft and their lives are drawn here.
    """
    if not is_integer(count, 1):
        raise ValueError(f"count: expected 1 aircraft or more, received {count!r}")
    if not clutter >= 1:
        raise ValueError(f"clutter: expected 1 measurement or more, received {clutter}")
    motion, conditions = ConstantVelocity(Q, 3), Conditions(1.0, 0, tuple(std), truth_noise, clutter, detection)

    def block(rng: np.random.Generator, numbers: Tensor) -> Tracks:
        starts, there = _starts(rng, count), _lives(rng, count).unsqueeze(-1)
        truth, z, prior = targets(rng, motion, DT, starts, conditions)
        z = scanned(rng, truth, torch.where(there, z, torch.nan), conditions)
        return Tracks(torch.where(there, truth, torch.nan), z, None, prior)

    middle = torch.cat([_CORNERS.mean(0), torch.zeros(3, dtype=torch.float64)]).expand(count, 6)
    settings = {"count": count, "clutter": clutter, "detection": detection, "truth_noise": truth_noise}
    return Scenario(
        "clutter-many", Spherical(motion), conditions.sensor(), belief_from_cartesian(Gaussian(middle, ROOT)), DT,
        STEPS, block, settings, clutter=Clutter(volume=count * (2 * REGION) ** 3, rate=float(clutter)),
        detection=detection, conversion=cartesian,
    )  # fmt: skip


def _starts(rng: np.random.Generator, count: int) -> Tensor:
    """Cartesian states ``(BLOCK, count, 6)`` one step before the first scan."""
    low, high = _CORNERS
    position = low + (high - low) * torch.from_numpy(rng.random((BLOCK, count, 3)))
    speed = torch.from_numpy(rng.uniform(*_SPEEDS, (BLOCK, count)))
    course = torch.from_numpy(rng.uniform(0, 2 * np.pi, (BLOCK, count)))
    climb = _CLIMB * torch.from_numpy(rng.standard_normal((BLOCK, count)))
    return torch.cat([position, torch.stack([speed * course.sin(), speed * course.cos(), climb], -1)], -1)


def _lives(rng: np.random.Generator, count: int) -> Tensor:
    """Whether each aircraft is present, ``(BLOCK, count, STEPS)``."""
    first = torch.from_numpy(rng.uniform(0, _LATEST * STEPS, (BLOCK, count, 1)))
    last = torch.from_numpy(rng.uniform(_EARLIEST * STEPS, STEPS, (BLOCK, count, 1)))
    step = torch.arange(STEPS)
    return (step >= first.floor()) & (step <= last)
