"""An aircraft that flies level and then manoeuvres hard, with two outliers: the alpha-beta bank's experiment."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from torchfra.hyper import one_of
from torchfra.motion.bank import aircraft
from torchfra.motion.polynomial import ConstantAcceleration, ConstantVelocity
from torchfra.scenarios.base import BLOCK, Scenario, Tracks
from torchfra.scenarios.law import Law
from torchfra.sensors.position import Position
from torchfra.types import Gaussian

STEPS, BEGIN, LENGTH, PEAK, STD = 120, 73.0, 47.0, 30.0, 20.0
PLANTED, OFFSET = (100, 101), 2000.0
_ROOT = torch.tensor([100.0] * 3 + [20.0] * 3 + [2.0] * 3, dtype=torch.float64).diag()


def level_then_weave(outliers: str = "planted") -> Scenario:
    """Level for 73 s, then an acceleration along x that rises to 30 m/s^2 and falls again; a position each second.

    Args:
        outliers: ``"planted"``: 2 km on x at 100 and 101 s; ``"none"``.

    Raises:
        ValueError: ``outliers`` that are neither.

    Source: Xu et al., section 4.  Numbers of the track that the paper does not state are chosen here.
    """
    one_of(outliers=(outliers, ("planted", "none")))
    truth = _path()
    planted = torch.zeros(STEPS, 3, dtype=torch.float64)
    if outliers == "planted":
        planted[[k - 1 for k in PLANTED], 0] = OFFSET

    def block(rng: np.random.Generator, runs: Tensor) -> Tracks:
        draw = torch.from_numpy(rng.standard_normal((BLOCK, STEPS, 3)))
        start = torch.from_numpy(rng.standard_normal((BLOCK, 9)))
        z = truth[1:, :3] + STD * draw + planted
        return Tracks(truth[1:].expand(BLOCK, -1, -1), z, None, Gaussian(truth[0] + start @ _ROOT, _ROOT))

    settings = {"outliers": outliers}
    motion, prior = ConstantAcceleration(4.0, 3), Gaussian(truth[0], _ROOT)
    sensor, known = Position(STD, dims=3), ("accelerations", *(["outliers"] if outliers == "planted" else []))
    law = Law(_ROOT, ConstantVelocity(0.0, 3, orders=3), sensor, STD, known=known)
    return Scenario("alpha-beta", motion, sensor, prior, 1.0, STEPS, block, settings, aircraft(4.0, 3), law=law)


def _path() -> Tensor:
    """States ``(STEPS + 1, 9)`` at 0, 1, ... s."""
    time = torch.arange(STEPS + 1, dtype=torch.float64)
    into, rate = (time - BEGIN).clamp_min(0.0), math.pi / LENGTH
    push = PEAK / rate  # of sin(rate t), integrated
    start = torch.tensor([-20000.0, 15000.0, 8000.0], dtype=torch.float64)
    velocity = torch.tensor([250.0, 30.0, 0.0], dtype=torch.float64).repeat(STEPS + 1, 1)
    position = start + time.unsqueeze(-1) * velocity
    position[:, 0] += push * (into - (rate * into).sin() / rate)
    velocity[:, 0] += push * (1 - (rate * into).cos())
    acceleration = torch.zeros_like(velocity)
    acceleration[:, 0] = PEAK * (rate * into).sin()
    return torch.cat([position, velocity, acceleration], -1)
