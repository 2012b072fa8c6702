"""Regimes of a motion: calm and agile, or the motions of a bank, and jumps after which the prediction is worth little."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.distributions import constraints

from torchfra.hyper import Hyper, Value
from torchfra.linalg.triangular import hstack, tria
from torchfra.types import Gaussian


class Regimes(nn.Module):
    """How a step may go: a Markov chain over ``L`` levels of process noise and ``J`` jumps.

    Args:
        motions: of each level, the number of its motion in a bank.
        levels: ``(..., L)`` by which the variance of that motion's process noise is multiplied.
        jumps: ``(..., J)`` by which the covariance of the predicted position is multiplied; its correlations stay.
        chain: ``(..., R, R)`` with ``R = L + J``: ``chain[i, j] = P(now j | was i)``, rows that sum to one.
        first: ``(..., R)`` probabilities of the regimes of the first step.
        home: the number of the level whose prediction jumps.

    Raises:
        ValueError: shapes that do not go together, values that are not positive or do not sum to one.
    """

    def __init__(
        self, motions: Sequence[int], *, levels: Value, jumps: Value, chain: Value, first: Value, home: int
    ) -> None:
        super().__init__()
        levels, jumps, chain, first = (torch.as_tensor(x, dtype=torch.float64) for x in (levels, jumps, chain, first))
        count = len(motions) + jumps.shape[-1]
        for name, value, shape in (
            ("levels", levels, (len(motions),)), ("regimes", chain, (count, count)), ("first", first, (count,)),
        ):  # fmt: skip
            if value.shape[-len(shape) :] != shape:
                raise ValueError(f"{name}: expected {shape}, received {tuple(value.shape)}")
        self.home = range(len(motions))[home]
        self.motions = (*motions, *[motions[home]] * jumps.shape[-1])
        self.levels = Hyper(levels, constraints.nonnegative, event_dim=1, name="levels")
        self.jumps = Hyper(jumps, event_dim=1, name="jumps")
        self.chain = Hyper(chain, constraints.simplex, event_dim=2, name="regimes")
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
        of = self.motions
        levels = of[: self.levels.raw.shape[-1]]
        spread, noise = (torch.stack([x.expand(*mean.shape, -1).select(-3, k) for k in levels]) for x in (spread, noise))
        level = tria(hstack(spread, in_front(self.levels(mean).sqrt(), mean.dim() - 2)[..., None, None] * noise))
        there = torch.zeros(mean.shape[-1], dtype=mean.dtype, device=mean.device)
        there[position] = 1.0
        widened = 1 + (in_front(self.jumps(mean).sqrt(), mean.dim() - 2).unsqueeze(-1) - 1) * there
        root = torch.cat([level, tria(widened.unsqueeze(-1) * level[self.home])])
        return Gaussian(torch.stack([mean.select(-2, k) for k in of]), root)

    def ahead(self, log_weights: Tensor) -> Tensor:
        """Logs ``(..., R, R)`` of the probabilities of this regime and the next, from those ``(..., R)`` of this."""
        return log_weights.unsqueeze(-1) + self.chain(log_weights).log()

    def possible(self, log_weights: Tensor, measured: Tensor) -> Tensor:
        """Log weights ``(..., R)`` without jumps where nothing is ``measured (..., 1)``: the levels share theirs.

        A jump that no measurement speaks against would widen the estimate without bound.
        """
        jumps = self.jumps.raw.shape[-1]
        if not jumps:
            return log_weights
        level, jump = log_weights[..., :-jumps], log_weights[..., -jumps:]
        more = log_weights.logsumexp(-1, keepdim=True) - level.logsumexp(-1, keepdim=True)
        return torch.cat([level + torch.where(measured, 0.0, more), torch.where(measured, jump, -torch.inf)], -1)


def in_front(values: Tensor, rank: int) -> Tensor:
    """Values ``(..., C)`` of tracks as ``(C, ...)``, to go before tensors of ``rank`` dimensions that end in tracks."""
    values = values.movedim(-1, 0)
    return values.reshape(values.shape[:1] + (1,) * (rank + 1 - values.dim()) + values.shape[1:])
