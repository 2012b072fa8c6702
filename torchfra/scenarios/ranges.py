"""A walker and four anchors whose ranges have errors of metres for some consecutive steps."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchfra.hyper import one_of
from torchfra.motion.bank import Bank
from torchfra.motion.polynomial import ConstantAcceleration, ConstantVelocity
from torchfra.scenarios.base import BLOCK, Scenario, Tracks
from torchfra.scenarios.law import Law
from torchfra.sensors.ranges import Ranges
from torchfra.types import Gaussian

STEPS, DT, Q, STD, HEIGHT = 1000, 0.1, 0.3, 0.15, 0.1
LIMIT = 20.0
"""Position error above which a run has diverged, m."""
_AREA = torch.tensor([[0.0, -5.0], [50.0, 5.0]], dtype=torch.float64)
"""Lowest and highest coordinates of the walker, m."""
_ANCHORS = {
    "together": [[0.7, 0.9, 0.5], [2.6, 0.9, 2.0], [2.6, -0.9, 2.0], [2.6, -0.9, 0.5]],
    "around": [[0.0, -5.0, 0.5], [50.0, -5.0, 2.0], [50.0, 5.0, 2.0], [0.0, 5.0, 0.5]],
}
_SHORTEST = 0.1
"""The shortest range that is measured, m."""
_LEGS, _NEAR, _HASTE, _HARDEST = 64, 1.0, 0.5, 2.0
"""Legs of a walk; how near its end the next one begins, m; seconds to take up a velocity; largest acceleration."""


def ranges_outliers(
    outliers: str = "short",
    *,
    anchors: str = "together",
    share: float = 0.005,
    size: float = 8.0,
    length: int = 3,
    missing: float = 0.1,
) -> Scenario:
    """Someone walks, stops and turns in an area of 50 m by 10 m for 100 s; ranges from four anchors, 10 a second.

    Ranges have errors of 0.15 m.  In a run of some steps the ranges of one anchor are off by the same distance; others
    are missing, also in runs.  A run has diverged if its root mean square error is above 20 m.

    Args:
        outliers: ranges that are off are too ``"short"``, too long as without a line of sight (``"nlos"``), or
            ``"both"``, half of the runs each; or there are ``"none"``.
        anchors: ``"together"``: within 2 m at one end of the area, where directions are hard to tell; ``"around"``: in
            its corners.
        share: of the ranges that are off.
        size: mean error of these, m, of a gamma distribution of shape 2.
        length: consecutive steps of such an error.
        missing: share of the ranges that are missing.

    Raises:
        ValueError: an argument out of its range.

    Source: this project.  Defaults are those of four recordings of ultra-wideband ranges over 15 minutes, with and
    without a line of sight: 0.44 % of the ranges were more than 1 m off, all of them too short, by 7 m in the median
    and 19 m at most, two or three in a row and never from two anchors at once; 5 to 18 % were missing, mostly in runs
    of 1 to 6 steps; the walker's speed was 1 m/s in the median and 2 at most.  Differs: the errors of the other ranges
    changed slowly there, by 1 cm from step to step and 0.2 m in all.
    """
    one_of(outliers=(outliers, ("short", "nlos", "both", "none")), anchors=(anchors, tuple(_ANCHORS)))
    for name, value in (("share", share), ("missing", missing)):
        if not 0 <= value < 1:
            raise ValueError(f"{name}: expected a share from 0 to below 1, received {value}")
    if not size > 0 or length < 1:
        raise ValueError(
            f"size, length: expected a size above 0 m and a length of 1 step or more, received {size}, {length}"
        )
    sensor = Ranges(torch.tensor(_ANCHORS[anchors], dtype=torch.float64), STD, height=HEIGHT)
    root = torch.eye(6, dtype=torch.float64)

    def block(rng: np.random.Generator, numbers: Tensor) -> Tracks:
        # The same draws whatever the settings, so that settings can be compared on the same walks and noise.
        path = _walks(rng)
        start = path[:, 0] + torch.from_numpy(rng.standard_normal((BLOCK, 6)))
        noise = torch.from_numpy(rng.standard_normal((BLOCK, STEPS, sensor.size)))
        away = torch.from_numpy(rng.gamma(2.0, size / 2, noise.shape))
        drawn, one = torch.from_numpy(rng.choice([-1.0, 1.0], noise.shape)), torch.ones_like(noise)
        sign = {"short": -one, "nlos": one, "both": drawn, "none": 0 * one}[outliers]
        off, since = _runs(rng, noise.shape, share, length)
        lost, _ = _runs(rng, noise.shape, missing, length)
        offset = torch.where(off, (sign * away).gather(1, since), 0.0)
        z = (sensor(path[:, 1:]) + STD * noise + offset).clamp_min(_SHORTEST)
        return Tracks(path[:, 1:], torch.where(lost, torch.nan, z), None, Gaussian(start, root))

    settings = {"outliers": outliers, "anchors": anchors, "share": share, "size": size,
                "length": length, "missing": missing}  # fmt: skip
    prior = Gaussian(torch.cat([_AREA.mean(0), torch.zeros(4, dtype=torch.float64)]), root)
    motion, known = ConstantAcceleration(Q), ("accelerations", *(["outliers"] if outliers != "none" else []))
    return Scenario("ranges-outliers", motion, sensor, prior, DT, STEPS, block, settings, walker(Q), limit=LIMIT,
                    law=Law(root, ConstantVelocity(0.0, orders=3), sensor, STD, known=known))  # fmt: skip


def walker(q: float) -> Bank:
    """Constant acceleration with a tenth of this variance of the process noise, with it, and with 50 times as much."""
    models = [ConstantAcceleration(times * q) for times in (0.1, 1.0, 50.0)]
    return Bank(models, neighbours=((1, 2), (0, 2), (0, 1)), first=(0, 1, 2))


def _walks(rng: np.random.Generator) -> Tensor:
    """States ``(BLOCK, STEPS + 1, 6)`` of walks from place to place, at most 2 m/s fast, with a stop at every fourth.

    Velocities follow the wanted ones with a delay, by accelerations that change from step to step and no faster.
    """
    low, high = _AREA
    places = low + (high - low) * torch.from_numpy(rng.random((BLOCK, _LEGS, 2)))
    speeds = torch.from_numpy(rng.uniform(0.6, 1.6, (BLOCK, _LEGS)))
    pauses = torch.from_numpy(np.where(rng.random((BLOCK, _LEGS)) < 0.25, rng.uniform(1.0, 5.0, (BLOCK, _LEGS)), 0.0))
    position, velocity = places[:, 0], torch.zeros(BLOCK, 2, dtype=torch.float64)
    leg, rest, rows = torch.ones(BLOCK, dtype=torch.int64), torch.zeros(BLOCK, dtype=torch.float64), torch.arange(BLOCK)
    states = []
    for _ in range(STEPS + 1):
        there = (places[rows, leg] - position).norm(dim=-1) < _NEAR
        rest = torch.where(there, pauses[rows, leg], rest - DT)
        leg = torch.where(there, (leg + 1) % _LEGS, leg)
        way = torch.nn.functional.normalize(places[rows, leg] - position, dim=-1)
        wanted = torch.where(rest > 0, 0.0, speeds[rows, leg]).unsqueeze(-1) * way
        push = (wanted - velocity) / _HASTE
        push = push * (_HARDEST / push.norm(dim=-1, keepdim=True).clamp_min(_HARDEST))
        states.append(torch.cat([position, velocity, push], -1))
        position, velocity = position + DT * velocity + DT**2 / 2 * push, velocity + DT * push
    return torch.stack(states, 1)


def _runs(rng: np.random.Generator, shape: torch.Size, share: float, length: int) -> tuple[Tensor, Tensor]:
    """Which steps of ``(B, T, k)`` are in runs of ``length``, a share of them all, and where the latest run began."""
    begins = torch.from_numpy(rng.random(tuple(shape))) < 1 - (1 - share) ** (1 / length)
    step = torch.arange(shape[1]).view(-1, 1)
    latest = torch.where(begins, step, -length).cummax(1).values
    return step - latest < length, latest.clamp_min(0)
