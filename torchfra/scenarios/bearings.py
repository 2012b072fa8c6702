"""Two moving stations take bearings of one target: the two experiments of Wang et al. (2021), section 3.

Filters assume constant acceleration.  100 steps of 1 s, bearings with errors of 1 degree, stations at 100 m/s to the
north-east.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchfra.hyper import one_of
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.motion.polynomial import ConstantAcceleration, ConstantVelocity
from torchfra.motion.turn import CoordinatedTurn
from torchfra.scenarios.base import BLOCK, Scenario, Tracks
from torchfra.scenarios.law import Law, burst_information
from torchfra.scenarios.outliers import burst_factors
from torchfra.sensors.direction import Bearings
from torchfra.types import Gaussian

STEPS, DT, Q, STD = 100, 1.0, 1e-2, math.radians(1.0)
LIMIT = 2000.0
"""Position error above which a run has diverged, m."""
_START = torch.tensor([2000.0, 4000.0, 6.0, -10.0, 0.2, -0.3], dtype=torch.float64)
_BAD_PRIOR = torch.tensor([2400.0, 1500.0, 10.0, 15.0, 1.0, 1.0], dtype=torch.float64)
_ROOT = torch.tensor([10.0, 10.0, 1.0, 1.0, 0.1, 0.1], dtype=torch.float64).diag()


def bearings_outliers(outliers: str = "covariance", *, truth_noise: float = 0.0, initial: str = "paper") -> Scenario:
    """Scenario 1: constant acceleration, outliers at 40, 50, 60 (10 sigma) and 70 s (40 sigma).

    Args:
        outliers: reading of "10 sigma": ``"covariance"`` or ``"std"`` times 10, or an ``"offset"`` of 10 std of random
            sign; ``"bursts"`` for others instead: runs of four steps with 10 times the std, at any time, about 5 % of
            all steps; ``"none"`` for none.
        truth_noise: variance of the targets' random acceleration, m^2/s^4; the paper has 0.
        initial: ``"paper"`` for its initial state, 2.5 km off; ``"truth"`` for one drawn around the true state.

    Raises:
        ValueError: an argument out of its range.

    Source: Wang et al. (2021), section 3.1 and table 1.
    """
    truth, moves = _constant_acceleration(_START, STEPS), [ConstantAcceleration(Q)] * STEPS
    sizes = {40: 10.0, 50: 10.0, 60: 10.0, 70: 40.0}
    return _scenario("bearings-outliers", truth, moves, sizes, outliers, truth_noise, initial)


def bearings_manoeuvre(outliers: str = "covariance", *, truth_noise: float = 0.0, initial: str = "truth") -> Scenario:
    """Scenario 2: constant acceleration, a turn of pi/10 rad/s from 30 to 80 s; outliers at 50, 60, 70 s.

    Args:
        outliers: as in ``bearings_outliers``.
        truth_noise: as in ``bearings_outliers``.
        initial: ``"truth"`` (the paper's "near the truth"): each run starts from a state drawn around the true one;
            ``"paper"`` from that of scenario 1.

    Raises:
        ValueError: an argument out of its range.

    Source: Wang et al. (2021), section 3.2.
    """
    before = _constant_acceleration(_START, 30)
    rate = math.pi / 10
    turn = CoordinatedTurn(rate, 0.0).transition(torch.tensor(DT, dtype=torch.float64))
    state, turning = before[-1, :4], []
    for _ in range(50):
        state = turn @ state
        vx, vy = state[2:]
        turning.append(torch.cat([state, rate * torch.stack([-vy, vx])]))
    after = _constant_acceleration(torch.cat([state, _START[4:]]), 20)
    truth = torch.cat([before, torch.stack(turning), after])
    straight = ConstantAcceleration(Q)
    known = ConstantVelocity(Q, orders=3)  # the acceleration after the turn is
    moves = [*[straight] * 30, *[CoordinatedTurn(rate, Q, orders=3)] * 50, known, *[straight] * 19]
    sizes = {50: 10.0, 60: 10.0, 70: 10.0}
    return _scenario("bearings-manoeuvre", truth, moves, sizes, outliers, truth_noise, initial)


def stations(steps: int = STEPS) -> Tensor:
    """``(steps, 4)`` positions of both stations at 1, 2, ... s, m: what ``Bearings`` takes as ``u``."""
    start = torch.tensor([0.0, 0.0, 2000.0, 0.0], dtype=torch.float64)
    return start + 100 / math.sqrt(2) * DT * torch.arange(1, steps + 1, dtype=torch.float64).unsqueeze(-1)


def _constant_acceleration(state: Tensor, steps: int) -> Tensor:
    """States ``(steps, 6)`` after 1, 2, ... steps."""
    t = DT * torch.arange(1, steps + 1, dtype=torch.float64).unsqueeze(-1)
    p, v, a = state[:2], state[2:4], state[4:]
    return torch.cat([p + v * t + a * t**2 / 2, v + a * t, a.expand(steps, 2)], -1)


def _scenario(name: str, path: Tensor, moves: Sequence[Motion], sizes: dict[int, float], outliers: str,
              truth_noise: float, initial: str) -> Scenario:  # fmt: skip
    known = ("covariance", "std", "offset", "bursts", "none")
    one_of(outliers=(outliers, known), initial=(initial, ("paper", "truth")))
    if not truth_noise >= 0:
        raise ValueError(f"truth_noise: expected a variance of 0 or more, received {truth_noise}")
    motion, sensor, u = ConstantAcceleration(Q), Bearings(STD), stations()
    size = torch.ones(STEPS, 1, dtype=torch.float64)
    for second, times in sizes.items():
        size[second - 1] = times
    centre = _BAD_PRIOR if initial == "paper" else _START

    def block(rng: np.random.Generator, numbers: Tensor) -> Tracks:
        # One draw holds all that any setting may need, so that settings can be compared on the same noise.
        draw = torch.from_numpy(rng.standard_normal((BLOCK, 6 + STEPS * 6)))
        start, (bearing, sign, jerk) = draw[:, :6], draw[:, 6:].unflatten(1, (STEPS, 6)).split(2, -1)
        truth = path + _disturbance(jerk, truth_noise) if truth_noise else path.expand(BLOCK, -1, -1)
        noise = STD * bearing * {"covariance": size.sqrt(), "std": size}.get(outliers, torch.ones_like(size))
        if outliers == "offset":
            noise = noise + STD * torch.where(size > 1, size, 0.0) * sign.sign()
        elif outliers == "bursts":
            noise = noise * burst_factors(rng, BLOCK, STEPS)
        mean = centre.expand(BLOCK, -1) if initial == "paper" else centre + start @ _ROOT
        return Tracks(truth, sensor(truth, u) + noise, u, Gaussian(mean, _ROOT))

    settings = {"outliers": outliers, "truth_noise": truth_noise, "initial": initial}
    law = _law(moves, sensor, size, outliers, truth_noise, initial)
    return Scenario(name, motion, sensor, Gaussian(centre, _ROOT), DT, STEPS, block, settings, _bank(), limit=LIMIT,
                    law=law)  # fmt: skip


def _law(
    moves: Sequence[Motion], sensor: Bearings, size: Tensor, outliers: str, truth_noise: float, initial: str
) -> Law:
    """Paths that are known except for their start, and for what ``truth_noise`` adds; so are the outliers."""
    std = STD * {"covariance": size.sqrt(), "std": size}.get(outliers, torch.ones_like(size))
    root = ConstantAcceleration(truth_noise).process_noise(torch.tensor(DT, dtype=torch.float64))
    information = burst_information(STEPS) if outliers == "bursts" else 1.0
    known = ["manoeuvres", *(["outliers"] if outliers != "none" else []), *(["start"] if initial == "paper" else [])]
    return Law(_ROOT, moves, sensor, std, root if truth_noise else None, information, tuple(known))


def _bank() -> Bank:
    """Constant acceleration, and turns of the rate of scenario 2 to both sides."""
    turns = [CoordinatedTurn(side * math.pi / 10, Q, orders=3) for side in (1, -1)]
    return Bank([ConstantAcceleration(Q), *turns], neighbours=((1, 2), (0, 2), (0, 1)), first=(0, 1, 2))


def _disturbance(jerk: Tensor, variance: float) -> Tensor:
    """Deviation of the state ``(B, T, 6)`` from its path under process noise ``(B, T, 2)`` of this variance."""
    model = ConstantAcceleration(variance)
    dt = torch.tensor(DT, dtype=torch.float64)
    matrix, root = model.transition(dt), model.process_noise(dt)
    state, states = torch.zeros(len(jerk), 6, dtype=torch.float64), []
    for noise in jerk.unbind(1):
        state = state @ matrix.mT + noise @ root.mT
        states.append(state)
    return torch.stack(states, 1)
