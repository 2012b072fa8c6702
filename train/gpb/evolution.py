"""A search without gradients, for losses that are cheap and noisy."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor


class Evolution:
    """Evolution strategy that adapts a standard deviation for each number: separable CMA-ES.

    Each generation draws candidates around the mean, which moves to the better ones; the random numbers follow from the
    seed and the number of the generation.

    Args:
        mean: ``(n,)`` where the search starts.
        step: standard deviation of the first generation.
        population: candidates of a generation, 4 or more.
        seed: of the random numbers.

    Source: Ros & Hansen (2008), with the constants of Hansen (2016) for the full method.
    """

    def __init__(self, mean: Tensor, *, step: float, population: int, seed: int) -> None:
        n, parents = len(mean), population // 2
        self.population, self.seed, self.generation = population, seed, 0
        self.mean, self.step = mean.detach().clone(), step
        self.variances, self.path, self.step_path = (
            torch.ones_like(mean),
            torch.zeros_like(mean),
            torch.zeros_like(mean),
        )
        weights = math.log((population + 1) / 2) - torch.arange(1, parents + 1, dtype=mean.dtype).log()
        self.weights = weights / weights.sum()
        mass = 1 / self.weights.square().sum().item()
        self.mass, self.length = mass, math.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n**2))  # of a normal vector
        self.step_rate = (mass + 2) / (n + mass + 5)
        self.damping = 1 + self.step_rate + 2 * max(0.0, math.sqrt((mass - 1) / (n + 1)) - 1)
        self.path_rate = (4 + mass / n) / (n + 4 + 2 * mass / n)
        faster = (n + 2) / 3  # because n variances are learned instead of a full matrix
        self.one_rate = min(1.0, faster * 2 / ((n + 1.3) ** 2 + mass))
        many = faster * 2 * (mass - 2 + 1 / mass) / ((n + 2) ** 2 + mass)
        self.many_rate = max(0.0, min(1 - self.one_rate, many))

    def ask(self) -> Tensor:
        """The candidates ``(population, n)`` of this generation."""
        return self.mean + self.step * self.variances.sqrt() * self._draws()

    def tell(self, losses: Tensor) -> None:
        """Updates the distribution by the losses ``(population,)`` of the candidates; NaN is the worst."""
        best = losses.nan_to_num(nan=math.inf, posinf=math.inf).argsort(stable=True)[: len(self.weights)]
        draws = self._draws()[best]
        drawn = self.weights @ draws  # the mean's move, in units of the spread
        self.mean = self.mean + self.step * self.variances.sqrt() * drawn
        self.step_path = _updated_path(self.step_path, drawn, self.step_rate, self.mass)
        self.path = _updated_path(self.path, self.variances.sqrt() * drawn, self.path_rate, self.mass)
        spread = self.weights @ (self.variances * draws.square())
        keep = 1 - self.one_rate - self.many_rate
        self.variances = keep * self.variances + self.one_rate * self.path.square() + self.many_rate * spread
        longer = self.step_path.norm().item() / self.length - 1
        self.step *= math.exp(min(1.0, self.step_rate / self.damping * longer))
        self.generation += 1

    def _draws(self) -> Tensor:
        generator = torch.Generator().manual_seed(hash((self.seed, self.generation)) % 2**63)
        return torch.randn(self.population, len(self.mean), generator=generator, dtype=self.mean.dtype)

    def state_dict(self) -> dict[str, Any]:
        """The values that change from generation to generation."""
        keys = ("mean", "step", "variances", "path", "step_path", "generation")
        return {key: getattr(self, key) for key in keys}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores values of ``state_dict``.

        Raises:
            KeyError: a value is missing.
            TypeError: one is of another type or shape.
        """
        for key, own in self.state_dict().items():
            value = state[key]
            if type(value) is not type(own) or (isinstance(own, Tensor) and value.shape != own.shape):
                raise TypeError(f"{key}: expected a value of state_dict, received {value!s:.100}")
            setattr(self, key, value.to(own.device) if isinstance(own, Tensor) else value)


def _updated_path(path: Tensor, move: Tensor, rate: float, mass: float) -> Tensor:
    """An evolution path with this learning rate, of unit variance if moves are random."""
    return (1 - rate) * path + math.sqrt(rate * (2 - rate) * mass) * move
