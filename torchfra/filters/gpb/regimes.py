"""Regimes of a motion: calm and agile, or the motions of a bank, and jumps."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.distributions import constraints

from torchfra.hyper import Hyper, Value, Values
from torchfra.linalg.triangular import hstack, tria
from torchfra.types import Gaussian

NEVER = -1e30
"""Log weight of what cannot be; not minus infinity, as the gradient of a sum of nothing else would be NaN."""


class EvenChain(nn.Module):
    """The chain in which every level stays with one probability, and every regime jumps with another.

    What does not stay goes to the other levels evenly, and so does the step after a jump.

    Args:
        levels: their number, ``L``.
        jumps: theirs, ``J``.
        stay: self-transition probability of a level.
        jump: probability of each jump.

    Raises:
        ValueError: a value that is no probability.
    """

    def __init__(self, levels: int, jumps: int, *, stay: Value, jump: Value) -> None:
        super().__init__()
        self.stay = Hyper(stay, constraints.unit_interval, name="stay")
        self.jump = Hyper(jump, constraints.unit_interval, name="jump")
        self.levels, self.jumps = levels, jumps
        if bool((jumps * self.jump() >= 1).any()):
            raise ValueError(f"jump: expected that {jumps} jumps leave something for levels, received {jump}")

    def forward(self, like: Tensor) -> Tensor:
        """``(..., R, R)``, rows that sum to one."""
        stay, jump = (x(like)[..., None, None] for x in (self.stay, self.jump))
        eye = torch.eye(self.levels, dtype=stay.dtype, device=stay.device)
        other = (1 - eye) / max(self.levels - 1, 1)
        even = stay * eye + (1 - stay) * other if self.levels > 1 else eye.expand(*stay.shape[:-2], 1, 1)
        after = eye[:1].new_full((self.jumps, self.levels), 1 / self.levels).expand(*even.shape[:-2], -1, -1)
        rows = torch.cat([even, after], -2) * (1 - self.jumps * jump)
        return torch.cat([rows, jump.expand(*rows.shape[:-1], self.jumps)], -1)


class Regimes(nn.Module):
    """How a step may go: a Markov chain over ``L`` levels of process noise and ``J`` jumps.

    Args:
        motions: of each level, the number of its motion in a bank.
        levels: ``(..., L)`` by which the variance of that motion's process noise is multiplied.
        jumps: ``(..., J)`` by which the covariance of the predicted position is multiplied; its correlations stay.
        chain: ``(..., R, R)`` with ``R = L + J``: ``chain[i, j] = P(now j | was i)``, rows that sum to one; or an
            ``EvenChain``.
        first: ``(..., R)`` probabilities of the regimes of the first step.
        home: the number of the level whose prediction jumps.

    Raises:
        ValueError: shapes that do not go together, values that are not positive or do not sum to one.
    """

    def __init__(
        self,
        motions: Sequence[int],
        *,
        levels: Values,
        jumps: Values,
        chain: Values | EvenChain,
        first: Values,
        home: int,
    ) -> None:
        super().__init__()
        levels, jumps, first = (torch.as_tensor(x, dtype=torch.float64) for x in (levels, jumps, first))
        count = len(motions) + jumps.shape[-1]
        if not isinstance(chain, EvenChain):
            matrix = torch.as_tensor(chain, dtype=torch.float64)
            _check("regimes", matrix, (count, count))
            chain = Hyper(matrix, constraints.simplex, event_dim=2, name="regimes")  # type: ignore[assignment]
        _check("levels", levels, (len(motions),))
        _check("first", first, (count,))
        self.home = range(len(motions))[home]
        self.motions = (*motions, *[motions[home]] * jumps.shape[-1])
        self.levels = Hyper(levels, constraints.nonnegative, event_dim=1, name="levels")
        self.jumps = Hyper(jumps, event_dim=1, name="jumps")
        self.chain: nn.Module = chain  # type: ignore[assignment]
        self.first = Hyper(first, constraints.simplex, event_dim=1, name="first")

    @property
    def members(self) -> list[list[int]]:
        """Of each motion, the numbers of its regimes."""
        return [[r for r, k in enumerate(self.motions) if k == motion] for motion in range(max(self.motions) + 1)]

    def predictions(self, mean: Tensor, spread: Tensor, noise: Tensor, position: slice) -> Gaussian:
        """A prediction for each regime, ``(R, ..., n)``, from the parts that ``gaussian.model.propagate`` gives.

        Args:
            mean: ``(..., K, n)`` of each motion.
            spread: ``(..., K, n, p)`` what was uncertain before.
            noise: ``(..., K, n, q)`` process noise.
            position: which components of a state are its position.
        """
        of, rank = self.motions, mean.dim() - 2
        levels = of[: self.levels.raw.shape[-1]]
        every = torch.broadcast_shapes(mean.shape, noise.shape[:-1])  # values of motions may bring a batch
        spread, noise = (torch.stack([x.expand(*every, -1).select(-3, k) for k in levels]) for x in (spread, noise))
        level = tria(hstack(spread, in_front(self.levels(mean).sqrt(), rank)[..., None, None] * noise))
        there = torch.zeros(mean.shape[-1], dtype=mean.dtype, device=mean.device)
        there[position] = 1.0
        widened = 1 + (in_front(self.jumps(mean).sqrt(), rank).unsqueeze(-1) - 1) * there
        root = torch.cat([level, widened.unsqueeze(-1) * level[self.home]])  # scaled rows: still a lower root
        return Gaussian(torch.stack([mean.expand(every).select(-2, k) for k in of]), root)

    def ahead(self, log_weights: Tensor) -> Tensor:
        """Logs ``(..., R, R)`` of the probabilities of this regime and the next, from those ``(..., R)`` of this."""
        pairs: Tensor = log_weights.unsqueeze(-1) + self.chain(log_weights).log()
        return pairs

    def possible(self, log_weights: Tensor, measured: Tensor) -> Tensor:
        """Log weights ``(..., R)`` without jumps where nothing is ``measured (..., 1)``: the levels share theirs.

        A jump that no measurement speaks against would widen the estimate without bound.
        """
        jumps = self.jumps.raw.shape[-1]
        if not jumps:
            return log_weights
        level, jump = log_weights[..., :-jumps], log_weights[..., -jumps:]
        more = log_weights.logsumexp(-1, keepdim=True) - level.logsumexp(-1, keepdim=True)
        return torch.cat([level + torch.where(measured, 0.0, more), torch.where(measured, jump, NEVER)], -1)


def in_front(values: Tensor, rank: int) -> Tensor:
    """Values ``(..., C)`` of tracks as ``(C, ...)``, to go before tensors of ``rank`` dimensions that end in tracks."""
    values = values.movedim(-1, 0)
    return values.reshape(values.shape[:1] + (1,) * (rank + 1 - values.dim()) + values.shape[1:])


def _check(name: str, value: Tensor, shape: tuple[int, ...]) -> None:
    if value.shape[-len(shape) :] != shape:
        raise ValueError(f"{name}: expected (..., {', '.join(map(str, shape))}), received {tuple(value.shape)}")
