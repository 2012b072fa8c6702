"""A target of the model of ``filters.GPB``: process noise that switches between levels, outliers in bursts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchfra.motion.polynomial import ConstantAcceleration
from torchfra.scenarios.base import BLOCK, Scenario, Tracks
from torchfra.sensors.position import Position
from torchfra.types import Gaussian

STEPS, DT, Q, STD = 200, 1.0, 0.01, 1.0
_ROOT = torch.tensor([1.0, 1.0, 1.0, 1.0, 0.1, 0.1], dtype=torch.float64).diag()


def regimes(
    noise_levels: Sequence[float] = (1.0, 100.0),
    self_transition: Sequence[float] = (0.94, 0.8),
    restart: Sequence[float] = (5 / 9, 4 / 9),
    outlier_transition: Sequence[Sequence[float]] = ((0.97, 0.03), (0.4, 0.6)),
    size: float = 100.0,
) -> Scenario:
    """Positions with errors of 1 m, every second for 200 s.

    Args:
        noise_levels: factors on the variance of the process noise, whose acceleration changes by 0.1 m/s^2 per step.
        self_transition: self-transition probabilities of the levels; the first step has the first level.
        restart: restart distribution of the levels.
        outlier_transition: ``(2, 2)`` of inlier and outlier; the first measurement is an inlier.
        size: factor on the covariance of an outlier's noise.
    """
    transition = np.diag(self_transition) + (1 - np.asarray(self_transition))[:, None] * np.asarray(restart)
    motion, sensor, dt = ConstantAcceleration(Q), Position(STD), torch.tensor(DT, dtype=torch.float64)
    step, root = motion.transition(dt), motion.process_noise(dt)
    scales = torch.tensor(noise_levels, dtype=torch.float64).sqrt()

    def block(rng: np.random.Generator, numbers: Tensor) -> Tracks:
        start, noise = (torch.from_numpy(rng.standard_normal(shape)) for shape in ((BLOCK, 6), (BLOCK, STEPS, 2)))
        push = torch.from_numpy(rng.standard_normal((STEPS, BLOCK, root.shape[-1])))
        push = push * scales[_states(rng, transition)].mT.unsqueeze(-1)
        outlier = _states(rng, outlier_transition).unsqueeze(-1)
        state, path = start @ _ROOT, []
        for shock in push:
            state = state @ step.mT + shock @ root.mT
            path.append(state)
        truth = torch.stack(path, 1)
        z = truth[..., :2] + STD * noise * torch.where(outlier > 0, size**0.5, 1.0)
        return Tracks(truth, z, None, Gaussian(torch.zeros_like(start), _ROOT))

    settings: dict[str, object] = {
        "noise_levels": noise_levels,
        "self_transition": self_transition,
        "restart": restart,
        "outlier_transition": outlier_transition,
        "size": size,
    }
    return Scenario("regimes", motion, sensor, Gaussian(torch.zeros_like(_ROOT[0]), _ROOT), DT, STEPS, block, settings)


def _states(rng: np.random.Generator, transition: ArrayLike) -> Tensor:
    """``(BLOCK, STEPS)`` numbers of the states of a Markov chain, from the first state on."""
    upper, draw = np.cumsum(np.asarray(transition), -1)[:, :-1], rng.random((STEPS, BLOCK, 1))
    states = [np.zeros(BLOCK, dtype=np.int64)]
    for u in draw[1:]:
        states.append((u > upper[states[-1]]).sum(-1))
    return torch.from_numpy(np.stack(states, -1))
