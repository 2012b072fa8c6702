"""Targets that move, and sensors that measure, as their stated models say; or with noise that is stated wrongly."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from torchfra.hyper import one_of
from torchfra.linalg.triangular import apply
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.motion.polynomial import ConstantAcceleration, ConstantVelocity
from torchfra.motion.turn import CoordinatedTurn
from torchfra.scenarios.base import BLOCK, Scenario, Tracks
from torchfra.scenarios.law import Law, burst_information, mixed_information
from torchfra.scenarios.outliers import SHARE, SIZE, burst_factors, outlier_factors
from torchfra.sensors.base import Sensor
from torchfra.sensors.direction import Bearings, RangeBearing
from torchfra.sensors.position import Position
from torchfra.sensors.ranges import Ranges
from torchfra.types import Gaussian

STD, AWAY, LIMIT = 1.0, 1e4, 100.0
"""Standard deviation of a measured position, distance of the stations, and error above which a run has diverged, m."""
TURN, SELF_TRANSITION = 0.1, 0.95
"""A turn, rad per step; the self-transition probability of a motion of the bank."""
_MOTIONS, _SENSORS = ("velocity", "acceleration", "turn", "bank"), ("position", "bearings", "radar", "ranges")
_OUTLIERS = ("none", "covariance", "std", "bursts")


def as_stated(
    motion: str = "velocity",
    sensor: str = "position",
    *,
    index: float = 0.1,
    dt: float = 1.0,
    steps: int = 100,
    outliers: str = "none",
    q: float = 1.0,
    std: float = 1.0,
    missing: float = 0.0,
) -> Scenario:
    """Tracks drawn from a filter's own models: prior, process noise and measurement noise are as stated to filters.

    Here the models of filters hold, so that an adaptive filter should be as good as a plain Kalman filter.  ``q`` and
    ``std`` are the ratios of the stated values to the true ones.

    A position is measured to 1 m (across a line of sight, and along it), and targets cover 20 m in a step.

    Args:
        motion: ``"velocity"`` or ``"acceleration"``, constant except for noise; a ``"turn"`` of 0.1 rad per step; or a
            ``"bank"`` of constant velocity and turns to both sides, with self-transition probabilities of 0.95.
        sensor: ``"position"``, ``"bearings"`` of two stations, ``"radar"`` for range and bearing, ``"ranges"`` to four
            anchors; stations are 10 km away.
        index: the manoeuvring index squared, ``q dt^4 / std^2``: process noise of a step in units of the measurement
            noise.
        dt: seconds per step.
        steps: measurements of a run.
        outliers: what is ten times larger in one of twenty measurements, of each device by itself: ``"covariance"`` or
            ``"std"``; in ``"bursts"`` the standard deviation of whole measurements, four steps in a row; or ``"none"``.
        q: factor on the variance of the process noise that is stated.
        std: factor on the standard deviation of the measurement noise that is stated.
        missing: share of the steps in which nothing is measured, so that measurements come at irregular times.

    Raises:
        ValueError: an argument out of its range.

    Source: this project; Kalata (1984) for the manoeuvring index.
    """
    one_of(motion=(motion, _MOTIONS), sensor=(sensor, _SENSORS), outliers=(outliers, _OUTLIERS))
    for name, value in (("index", index), ("dt", dt), ("q", q), ("std", std)):
        if not 0 < value < math.inf:
            raise ValueError(f"{name}: expected a finite value above 0, received {value}")
    if steps < 1:
        raise ValueError(f"steps: expected 1 or more, received {steps}")
    if not 0 <= missing < 1:
        raise ValueError(f"missing: expected a share from 0 to below 1, received {missing}")
    variance = index * STD**2 / dt**4
    truths, stated = _motions(motion, variance, dt), _motions(motion, q * variance, dt)
    real, sensed = _sensor(sensor, STD), _sensor(sensor, std * STD)
    speed, size = STD / dt, truths[0].size
    orders = [3 * STD, speed, 0.1 * speed / dt][: truths[0].orders]
    spread = torch.tensor(orders, dtype=torch.float64).repeat_interleave(2)
    mean = torch.tensor([0.0, 0.0, 16 * speed, 12 * speed, 0.0, 0.0], dtype=torch.float64)[:size]
    seconds, root = torch.tensor(dt, dtype=torch.float64), spread.diag()
    moves, pushes = (torch.stack([getattr(m, of)(seconds) for m in truths]) for of in ("transition", "process_noise"))

    def block(rng: np.random.Generator, numbers: Tensor) -> Tracks:
        # The same draws whatever the settings, so that settings can be compared on the same noise.
        state = mean + spread * torch.from_numpy(rng.standard_normal((BLOCK, size)))
        pushed = torch.from_numpy(rng.standard_normal((steps, BLOCK, pushes.shape[-1])))
        noise = torch.from_numpy(rng.standard_normal((BLOCK, steps, real.size)))
        modes = _modes(rng, steps, len(truths))
        path = []
        for push, mode in zip(pushed, modes, strict=True):
            state = apply(moves[mode], state) + apply(pushes[mode], push)
            path.append(state)
        truth = torch.stack(path, 1)
        z = real(truth)
        colour = real.measurement_noise(z).colour((noise * _factors(rng, outliers, steps, real)).unsqueeze(-1))
        z = z + colour.squeeze(-1)
        if missing:
            z[torch.from_numpy(rng.random((BLOCK, steps)) < missing)] = torch.nan
        return Tracks(truth, z, None, Gaussian(mean.expand(BLOCK, -1), root))

    settings = {"motion": motion, "sensor": sensor, "index": index, "outliers": outliers, "q": q,
                "std": std, "missing": missing}  # fmt: skip
    bank = Bank(stated) if len(stated) > 1 else None
    law = None if missing else _law(root, truths, real, seconds, outliers, steps)
    prior = Gaussian(mean, root)
    return Scenario("as-stated", stated[0], sensed, prior, dt, steps, block, settings, bank, limit=LIMIT, law=law)


def _motions(name: str, q: float, dt: float) -> list[Motion]:
    """The motion, or those of the bank."""
    turns: list[Motion] = [CoordinatedTurn(sign * TURN / dt, q) for sign in (1, -1)]
    straight: Motion = ConstantAcceleration(q) if name == "acceleration" else ConstantVelocity(q)
    return {"turn": turns[:1], "bank": [straight, *turns]}.get(name, [straight])


def _sensor(name: str, std: float) -> Sensor:
    """The sensor, which measures a position near the origin to ``std``."""
    places = torch.tensor([[-1.0, 0.0], [0.0, -1.0], [1.0, 0.0], [0.0, 1.0]], dtype=torch.float64) * AWAY
    if name == "position":
        return Position(std)
    if name == "bearings":
        return Bearings(std / AWAY, stations=places[:2])
    if name == "radar":
        return RangeBearing(torch.tensor([std, std / AWAY], dtype=torch.float64), position=places[0])
    return Ranges(places, std)


def _modes(rng: np.random.Generator, steps: int, count: int) -> Tensor:
    """``(steps, BLOCK)`` numbers of the motions, a Markov chain."""
    leaves, other = rng.random((steps, BLOCK)) >= SELF_TRANSITION, rng.integers(1, max(count, 2), (steps, BLOCK))
    return torch.from_numpy(np.where(leaves, other, 0).cumsum(0) % count)


def _factors(rng: np.random.Generator, outliers: str, steps: int, sensor: Sensor) -> Tensor:
    """Factors on the standard deviation of each element, ``(BLOCK, steps, m)``."""
    if outliers == "bursts":
        return burst_factors(rng, BLOCK, steps).expand(-1, -1, sensor.size)
    each = outlier_factors(outliers, SIZE, SHARE)(rng, (BLOCK, steps, len(sensor.blocks)))
    device = [b for i in range(sensor.size) for b, block in enumerate(sensor.blocks) if i in block]
    return each[..., device]


def _law(root: Tensor, truths: list[Motion], sensor: Sensor, seconds: Tensor, outliers: str, steps: int) -> Law | None:
    """The law of the truth; None of a bank, whose motions follow each other at random."""
    if len(truths) > 1:
        return None
    known = (burst_information(steps) if outliers == "bursts"
            else mixed_information(outliers, SIZE, SHARE, len(sensor.blocks[0])))  # fmt: skip
    std = sensor.measurement_noise(torch.zeros(sensor.size, dtype=torch.float64)).std
    return Law(root, truths[0], sensor, std, truths[0].process_noise(seconds), known)
