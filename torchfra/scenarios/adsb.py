"""An aircraft that flies straight, turns slowly, and turns fast, seen by position reports: Du & Zhang (2020)."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from torchfra.hyper import one_of
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.motion.correlated import CurrentStatistical
from torchfra.motion.polynomial import ConstantAcceleration, ConstantVelocity
from torchfra.motion.turn import CoordinatedTurn
from torchfra.scenarios.base import BLOCK, Scenario, Tracks
from torchfra.scenarios.law import Law
from torchfra.sensors.position import Position
from torchfra.types import Gaussian

DT, SAMPLES, SPEED = 2.0, 450, 15.0
_LEGS = ((400.0, 0.0), (200.0, 1.0), (10.0, 0.0), (50.0, -1.0), (240.0, 0.0))
"""Seconds of each leg, and the sign of its quarter turn; 0 if it is straight."""


def adsb_turns(turns: str = "acceleration", *, std: float = 30.0) -> Scenario:
    """Position reports every 2 s for 900 s: straight, a quarter turn in 200 s, straight, one back in 50 s, straight.

    Filters start from the first two reports: position from the second, velocity from their difference.  Measurements
    and truth begin with the third.

    Args:
        turns: ``"acceleration"``: constant acceleration turns the velocity, as in the textbook example; ``"arc"``:
            circular arcs at constant speed.
        std: of a reported position, m per axis.

    Raises:
        ValueError: an argument out of its range.

    Source: Du & Zhang (2020), section 3.  Differs: measurement noise and the form of the turns are an interpretation.
    """
    one_of(turns=(turns, ("acceleration", "arc")))
    if not std > 0:
        raise ValueError(f"std: expected metres above 0, received {std}")
    path, sensor = _path(turns), Position(std)
    axis = torch.tensor([[std, 0, 0], [std / DT, std / DT, 0], [0, 0, 0.05]], dtype=torch.float64)
    root = torch.kron(axis, torch.eye(2, dtype=torch.float64))

    def block(rng: np.random.Generator, numbers: Tensor) -> Tracks:
        z = path[:, :2] + std * torch.from_numpy(rng.standard_normal((BLOCK, SAMPLES, 2)))
        first, second = z[:, 0], z[:, 1]
        mean = torch.cat([second, (second - first) / DT, torch.zeros_like(second)], -1)
        return Tracks(path[2:].expand(BLOCK, -1, -1), z[:, 2:], None, Gaussian(mean, root))

    prior = Gaussian(path[1], root)
    settings = {"turns": turns, "std": std}
    motion, bank = ConstantAcceleration(0.02**2), adsb_models()
    rates = [side * math.pi / 2 / seconds for seconds, side in _LEGS for _ in range(round(seconds / DT))]
    moves = [CoordinatedTurn(rate if turns == "arc" else 0.0, 0.0, orders=3) for rate in rates]
    law = Law(root, moves[2:], sensor, std, known=("manoeuvres",))
    return Scenario("adsb-turns", motion, sensor, prior, DT, SAMPLES - 2, block, settings, bank, law=law)


def adsb_models() -> Bank:
    """Constant velocity and acceleration, current statistical, slow turn and fast turn, in one state of six.

    Source: Du & Zhang (2020), section 1; the values and ``Bank.neighbours`` are additions.
    """
    models: list[Motion] = [
        ConstantVelocity(0.01**2, orders=3),
        ConstantAcceleration(0.02**2),
        CurrentStatistical(1 / 20, 1.0),
        CoordinatedTurn(math.pi / 400, 0.02**2, orders=3),
        CoordinatedTurn(-math.pi / 100, 0.02**2, orders=3),
    ]
    return Bank(models, neighbours=((1, 3), (2, 4), (0, 4), (0, 1), (2, 0)), first=(0, 2, 3))


def _path(turns: str) -> Tensor:
    """States ``(SAMPLES, 6)`` after 2, 4, ... s."""
    state, path = torch.tensor([0, 2000, SPEED, 0], dtype=torch.float64), []
    for seconds, side in _LEGS:
        rate = side * math.pi / 2 / seconds
        pull = side * SPEED / seconds * torch.tensor([-1.0, 1.0], dtype=torch.float64)
        matrix = CoordinatedTurn(rate, 0.0).transition(torch.tensor(DT, dtype=torch.float64))
        for _ in range(round(seconds / DT)):
            position, velocity = state[:2], state[2:]
            if turns == "arc":
                state = matrix @ state
                acceleration = rate * torch.stack([-state[3], state[2]])
            else:
                state = torch.cat([position + DT * velocity + DT**2 / 2 * pull, velocity + DT * pull])
                acceleration = pull
            path.append(torch.cat([state, acceleration]))
    return torch.stack(path)
