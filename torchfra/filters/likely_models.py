"""Which of many models run: the likely ones, chosen anew before every step."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.distributions import constraints

from torchfra import tree
from torchfra.filters.interaction import PER_MODEL, over_time_step
from torchfra.gaussian.inputs import Frame
from torchfra.hyper import Hyper, Value
from torchfra.linalg.safe import safe_divide, safe_log
from torchfra.motion.bank import Bank


class LikelyModels(nn.Module):
    """A model set that changes, at a fixed number of models: the likely-model set.

    Before every step the set is chosen from the probabilities: a model above ``principal`` calls its neighbours, one
    below ``unlikely`` makes room.  First come principal models, then their neighbours, then the others that run, then
    the unlikely; within each by probability.  Every track has its own set.

    Args:
        neighbours: for each model of a bank those it calls, by number, as many as can run beside it or fewer; every
            model must be reached from every other.
        first: the models that run first.
        unlikely: probability below which a model makes room.
        principal: probability above which a model calls its neighbours.  A choice passes no gradient to either.

    Raises:
        ValueError: thresholds out of order, or a table that does not connect the models.

    Source: Du & Zhang (2020), eq. (4); Li & Zhang (2000), "Multiple-Model Estimation with Variable Structure,
    Part V: Likely-Model Set Algorithm".  Differs: the paper does not say how its set changes; the number is fixed.
    """

    calls: Tensor
    """``(K, K)`` 1 where a principal model calls another."""
    first: Tensor
    """``(A, K)`` the models that run first, one in each row."""

    def __init__(
        self, neighbours: Sequence[Sequence[int]], first: Sequence[int], *, unlikely: Value = 0.05,
        principal: Value = 0.5,
    ) -> None:  # fmt: skip
        super().__init__()
        count = len(neighbours)
        _check_thresholds(unlikely, principal)
        if len(set(first)) != len(first) or not 1 < len(first) <= count or not set(first) <= set(range(count)):
            raise ValueError(
                f"first: expected 2 to {count} of the models in neighbours, each once, received {list(first)}"
            )
        self.unlikely = Hyper(unlikely, constraints.unit_interval, name="unlikely")
        self.principal = Hyper(principal, constraints.unit_interval, name="principal")
        self.register_buffer("calls", _calls(neighbours, count, len(first)))
        self.register_buffer("first", torch.eye(count, dtype=torch.float64)[list(first)])

    def check(self, bank: Bank, transition: Value | None, initial: Value | None) -> None:
        """Checks that these models are those of a bank, and that every one can follow every other.

        Raises:
            ValueError: they are not.
        """
        count = len(bank)
        if not bank.linear:
            raise ValueError(f"inner: expected a filter around a Bank of linear motions, received {bank}")
        if len(self.calls) != count:
            raise ValueError(f"neighbours: expected one list for each of {count} models, received {len(self.calls)}")
        if initial is not None:
            raise ValueError(f"initial: expected None beside a subset, which begins evenly, received {initial}")
        if transition is None:
            raise ValueError("transition: expected one beside a subset, received None")
        transition = torch.as_tensor(transition, dtype=torch.float64)
        if transition.shape[-2:] != (count, count) or not bool((transition > 0).all()):
            raise ValueError(f"transition: expected ({count}, {count}) above 0, received {transition.tolist()}")

    def begin(self, mean: Tensor) -> Tensor:
        """The set ``(..., A, K)`` before the first step, for states ``mean (..., n)``."""
        first = self.first.to(mean)
        return first.expand(*mean.shape[:-1], *first.shape)

    def forward(self, active: Tensor, log_weights: Tensor, dt: Tensor, transition: Tensor) -> tuple[Tensor, Tensor]:
        """The set ``(..., A, K)`` of a step of ``dt`` seconds, and logs ``(..., A, A)`` of the transition to it.

        Args:
            active: ``(..., A, K)`` the set before.
            log_weights: ``(..., A)`` of its models.
            dt: seconds; the set stays where it is 0.
            transition: ``(..., K, K)`` that between all models.
        """
        after, goes_on = self.choose(active, log_weights)
        instant = (dt == 0).unsqueeze(-1)
        after = torch.where(instant.unsqueeze(-1), active, after)
        goes_on = torch.where(instant, torch.ones_like(goes_on), goes_on)
        return after, over_time_step(safe_log(self.matrix(transition, active, after, goes_on)), dt)

    def choose(self, active: Tensor, log_weights: Tensor) -> tuple[Tensor, Tensor]:
        """The set for the next step, ``(..., A, K)``, and ``(..., A)`` 1 where a model goes on running.

        A model that goes on keeps its place; new ones take the places of those that went, in the order of the bank.
        """
        weight = (log_weights.exp().unsqueeze(-2) @ active).squeeze(-2)  # (..., K), as all that follows
        runs = active.sum(-2)
        high, low = (x(weight).unsqueeze(-1) for x in (self.principal, self.unlikely))
        principal = (weight > high).to(weight)
        called = ((principal.unsqueeze(-2) @ self.calls.to(weight)).squeeze(-2) > 0).to(weight)
        likely = runs * (weight >= low).to(weight)
        tier = torch.where(principal > 0, 4.0, torch.where(called > 0, 3.0, runs + likely))
        score = 2 * tier + weight
        mine, other = score.unsqueeze(-1), score.unsqueeze(-2)
        before = torch.ones_like(self.calls).tril(-1).to(weight)  # of equals the first in the bank comes first
        rank = ((other > mine).to(weight) + (other == mine).to(weight) * before).sum(-1)
        chosen = (rank < active.shape[-2]).to(weight)
        goes_on = (active @ chosen.unsqueeze(-1)).squeeze(-1)
        new, free = chosen * (1 - runs), 1 - goes_on
        turn = (_counted(new).unsqueeze(-2) == _counted(free).unsqueeze(-1)).to(weight)
        return goes_on.unsqueeze(-1) * active + (free.unsqueeze(-1) * new.unsqueeze(-2)) * turn, goes_on

    def matrix(self, every: Tensor, was: Tensor, now: Tensor, goes_on: Tensor) -> Tensor:
        """``P(now j | was i) (..., A, A)`` between two sets ``(..., A, K)``, from that between all models.

        Eq. (4) when all others share what a row leaves.
        """
        diagonal = every.diagonal(dim1=-2, dim2=-1)
        others = was @ (every - diagonal.diag_embed()) @ now.mT
        stay = goes_on * (was @ diagonal.unsqueeze(-1)).squeeze(-1)
        left = safe_divide(1 - stay, others.sum(-1))
        matrix: Tensor = stay.diag_embed() + left.unsqueeze(-1) * others
        return matrix


def _counted(x: Tensor) -> Tensor:
    """How many there are up to each place, of ones and zeros."""
    count = x.shape[-1]
    return (x.unsqueeze(-2) @ torch.ones(count, count, dtype=x.dtype, device=x.device).triu()).squeeze(-2)


def of_active(frame: Frame, active: Tensor) -> Frame:
    """Of the matrices of all models in a frame those of the ``active (..., A, K)`` ones."""

    def pick(rank: int, x: Tensor) -> Tensor:
        rows = x.flatten(-rank) if rank > 1 else x
        chosen: Tensor = (active @ rows).unflatten(-1, x.shape[-rank:])
        return chosen

    chosen: Frame = tree.map_ranked(pick, frame, only=PER_MODEL)
    return chosen


def _check_thresholds(unlikely: Value, principal: Value) -> None:
    low, high = torch.as_tensor(unlikely), torch.as_tensor(principal)
    if not bool(((low >= 0) & (low < high) & (high < 1)).all()):
        received = f"{low.tolist()}, {high.tolist()}"
        raise ValueError(f"unlikely, principal: expected 0 <= unlikely < principal < 1, received {received}")


def _calls(neighbours: Sequence[Sequence[int]], count: int, active: int) -> Tensor:
    """``(K, K)`` 1 where a model calls another, of ``count`` models of which ``active`` run."""
    if len(neighbours) != count:
        raise ValueError(f"neighbours: expected one list for each of {count} models, received {len(neighbours)}")
    if max(map(len, neighbours)) >= active:
        expected = f"at most {active - 1} for each, which can run beside it"
        raise ValueError(f"neighbours: expected {expected}, received {neighbours}")
    if not all(0 <= called < count for row in neighbours for called in row):
        raise ValueError(f"neighbours: expected numbers from 0 to {count - 1}, received {neighbours}")
    calls = torch.zeros(count, count, dtype=torch.float64)
    for model, called in enumerate(neighbours):
        calls[model, list(called)] = 1
    reached = torch.linalg.matrix_power(calls + torch.eye(count, dtype=torch.float64), count) > 0
    if not bool(reached.all()):
        raise ValueError(f"neighbours: expected every model to be reached from every other, received {neighbours}")
    return calls
