"""Regimes of a motion: calm, agile, and a jump after which the prediction is worth little."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.distributions import constraints

from torchfra.hyper import Hyper, Value
from torchfra.linalg.triangular import hstack, tria
from torchfra.types import Gaussian


class Regimes(nn.Module):
    """How uncertain a step is: a Markov chain over levels of process noise, and over jumps.

    Args:
        levels: ``(..., L)`` by which the variance of the motion's process noise is multiplied, the calmest first.
        jumps: ``(..., J)`` by which the covariance of the whole prediction, at the last level, is multiplied.
        chain: ``(..., R, R)`` with ``R = L + J``: ``chain[i, j] = P(now j | was i)``, rows that sum to one.
        first: ``(..., R)`` probabilities of the regimes of the first step.

    Raises:
        ValueError: shapes that do not go together, values that are not positive or do not sum to one.
    """

    def __init__(self, *, levels: Value, jumps: Value, chain: Value, first: Value) -> None:
        super().__init__()
        self.levels = Hyper(_vector(levels), event_dim=1, name="levels")
        self.jumps = Hyper(_vector(jumps), event_dim=1, name="jumps")
        chain, first = _vector(chain), _vector(first)
        count = self.levels.raw.shape[-1] + self.jumps.raw.shape[-1]
        if chain.shape[-2:] != (count, count):
            raise ValueError(f"regimes: expected ({count}, {count}), received {tuple(chain.shape)}")
        if first.shape[-1:] != (count,):
            raise ValueError(f"first: expected ({count},), received {tuple(first.shape)}")
        self.chain = Hyper(chain, constraints.simplex, event_dim=2, name="regimes")
        self.first = Hyper(first, constraints.simplex, event_dim=1, name="first")

    def predictions(self, mean: Tensor, spread: Tensor, noise: Tensor, position: slice) -> Gaussian:
        """A prediction for each regime, ``(R, ..., n)``, from the parts that ``gaussian.model.propagate`` gives.

        Args:
            mean: ``(..., K, n)``.
            spread: ``(..., K, n, p)`` what was uncertain before.
            noise: ``(..., K, n, q)`` process noise.
        """
        rank = spread.dim() - 2
        levels = in_front(self.levels(mean), rank).sqrt()[..., None, None]
        still = tria(hstack(*torch.broadcast_tensors(spread.unsqueeze(0)), levels * noise))
        there = torch.zeros(mean.shape[-1], dtype=mean.dtype, device=mean.device)
        there[position] = 1.0
        jumps = 1 + (in_front(self.jumps(mean), rank).sqrt()[..., None] - 1) * there
        jumped = tria(jumps.unsqueeze(-1) * still[-1:])
        roots = torch.cat([still, jumped])
        return Gaussian(mean.expand(len(roots), *mean.shape), roots)

    def ahead(self, log_weights: Tensor) -> Tensor:
        """Logs ``(..., K, R)`` of the next step's regimes, from those of this one's, of any batch in front of ``K``."""
        return (log_weights.unsqueeze(-1) + self.chain(log_weights).log().unsqueeze(-3)).logsumexp(-2)

    def possible(self, log_weights: Tensor, measured: Tensor) -> Tensor:
        """Log weights ``(..., K, R)`` without jumps where nothing is ``measured (..., 1)``: the others share theirs."""
        levels = self.levels.raw.shape[-1]
        still, jumps = log_weights[..., :levels], log_weights[..., levels:]
        more = log_weights.logsumexp(-1, keepdim=True) - still.logsumexp(-1, keepdim=True)
        measured = measured.unsqueeze(-1)
        return torch.cat([still + torch.where(measured, 0.0, more), torch.where(measured, jumps, -torch.inf)], -1)


def in_front(values: Tensor, rank: int) -> Tensor:
    """Values ``(..., C)`` of tracks as ``(C, ...)``, to go before tensors of ``rank`` dimensions that end in models."""
    values = values.movedim(-1, 0).unsqueeze(-1)
    return values.reshape(values.shape[:1] + (1,) * (rank + 1 - values.dim()) + values.shape[1:])


def _vector(value: Value) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64)
