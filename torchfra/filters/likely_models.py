"""The active models of a bank: the likely ones, chosen before every step."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra import tree
from torchfra.filters.interaction import PER_MODEL, identity_at_zero_dt
from torchfra.gaussian.inputs import Frame
from torchfra.hyper import Hyper, Part, Value
from torchfra.linalg.safe import safe_divide, safe_log
from torchfra.motion.bank import Bank
from torchfra.numbers import as_numbers


class LikelyModels(Part):
    """Likely-model set: the active models of a bank, of a fixed number, chosen before every step.

    Principal models have a probability above ``principal``, unlikely ones below ``unlikely``.  The set takes principal
    models first, then their neighbours, then the other active models, then the unlikely ones; within each group by
    probability.  Every track has its own set.

    Args:
        neighbours: for each model of a bank the indices of its neighbours, which it activates as a principal model; at
            most as many as can be active beside it.  Every model must be reached from every other.
        first: the models that are active first.
        unlikely: probability below which a model is unlikely.
        principal: probability above which a model is principal.  The choice has no gradient in either.

    Raises:
        ValueError: thresholds out of order, or a table that does not connect the models.

    Source: Du & Zhang (2020), eq. (4); Li & Zhang (2000), "Multiple-Model Estimation with Variable Structure,
    Part V: Likely-Model Set Algorithm".  Differs: the paper does not say how its set changes; the number is fixed.
    """

    activates: Tensor
    """``(K, K)`` 1 where a principal model activates another."""
    first: Tensor
    """``(A, K)`` with a single 1 in each row: the models that are active first."""

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
        self.register_buffer("activates", _activations(neighbours, count, len(first)))
        self.register_buffer("first", torch.eye(count, dtype=torch.float64)[list(first)])

    def check(self, bank: Bank, transition: Value | None, initial: Value | None) -> None:
        """Checks that the models are those of a bank of linear motions, and that each can follow every other.

        Raises:
            ValueError: a bank, a transition or an initial distribution that does not fit.
        """
        count = len(bank)
        if not bank.linear:
            raise ValueError(f"inner: expected a filter around a Bank of linear motions, received {bank}")
        if len(self.activates) != count:
            raise ValueError(
                f"neighbours: expected one list for each of {count} models, received {len(self.activates)}"
            )
        if initial is not None:
            raise ValueError(f"initial: expected None beside a subset, which starts uniformly, received {initial}")
        if transition is None:
            raise ValueError("transition: expected one beside a subset, received None")
        transition = as_numbers(transition, "transition").double()
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
            log_weights: ``(..., A)`` logs of the probabilities of its models.
            dt: ``(...)`` seconds; where it is 0 the set stays.
            transition: ``(..., K, K)`` between all models.
        """
        after, stays_active = self.choose(active, log_weights)
        instant = (dt == 0).unsqueeze(-1)
        after = torch.where(instant.unsqueeze(-1), active, after)
        stays_active = torch.where(instant, torch.ones_like(stays_active), stays_active)
        return after, identity_at_zero_dt(safe_log(self.matrix(transition, active, after, stays_active)), dt)

    def choose(self, active: Tensor, log_weights: Tensor) -> tuple[Tensor, Tensor]:
        """The set for the next step, ``(..., A, K)``, and ``(..., A)`` 1 where a model stays active.

        A model that stays active keeps its place; new ones take the free places in the order of the bank.
        """
        weight = (log_weights.exp().unsqueeze(-2) @ active).squeeze(-2)  # (..., K), as all that follows
        runs = active.sum(-2)
        high, low = (x(weight).unsqueeze(-1) for x in (self.principal, self.unlikely))
        principal = (weight > high).to(weight)
        activated = ((principal.unsqueeze(-2) @ self.activates.to(weight)).squeeze(-2) > 0).to(weight)
        likely = runs * (weight >= low).to(weight)
        # 4 for principal models, 3 for their neighbours, 2 for active likely ones, 1 for active unlikely ones, else 0;
        # a probability is less than the 2 between tiers, so that it decides within a tier alone.
        tier = torch.where(principal > 0, 4.0, torch.where(activated > 0, 3.0, runs + likely))
        score = 2 * tier + weight
        mine, other = score.unsqueeze(-1), score.unsqueeze(-2)
        # Of equal scores the first in the bank comes first.
        before = torch.ones_like(self.activates).tril(-1).to(weight)
        rank = ((other > mine).to(weight) + (other == mine).to(weight) * before).sum(-1)
        chosen = (rank < active.shape[-2]).to(weight)
        stays_active = (active @ chosen.unsqueeze(-1)).squeeze(-1)
        new, free = chosen * (1 - runs), 1 - stays_active
        # The first new model takes the first free place, and so on.
        paired = (_counted(new).unsqueeze(-2) == _counted(free).unsqueeze(-1)).to(weight)
        return stays_active.unsqueeze(-1) * active + (free.unsqueeze(-1) * new.unsqueeze(-2)) * paired, stays_active

    def matrix(self, every: Tensor, was: Tensor, now: Tensor, stays_active: Tensor) -> Tensor:
        """``P(now j | was i) (..., A, A)`` between two sets ``(..., A, K)``, from that between all models.

        It is eq. (4) where the transition to all other models is uniform.
        """
        diagonal = every.diagonal(dim1=-2, dim2=-1)
        others = was @ (every - diagonal.diag_embed()) @ now.mT
        stay = stays_active * (was @ diagonal.unsqueeze(-1)).squeeze(-1)
        scale = safe_divide(1 - stay, others.sum(-1))  # the rest of each row, in proportion
        matrix: Tensor = stay.diag_embed() + scale.unsqueeze(-1) * others
        return matrix


def _counted(x: Tensor) -> Tensor:
    """The cumulative sum of ones and zeros along the last dimension, by a matrix product."""
    count = x.shape[-1]
    return (x.unsqueeze(-2) @ torch.ones(count, count, dtype=x.dtype, device=x.device).triu()).squeeze(-2)


def of_active(frame: Frame, active: Tensor) -> Frame:
    """The frame with the matrices of the ``active (..., A, K)`` models alone."""

    def pick(rank: int, x: Tensor) -> Tensor:
        rows = x.flatten(-rank) if rank > 1 else x
        chosen: Tensor = (active @ rows).unflatten(-1, x.shape[-rank:])
        return chosen

    return tree.map_ranked(pick, frame, only=PER_MODEL)


def _check_thresholds(unlikely: Value, principal: Value) -> None:
    low, high = as_numbers(unlikely, "unlikely"), as_numbers(principal, "principal")
    if not bool(((low >= 0) & (low < high) & (high < 1)).all()):
        received = f"{low.tolist()}, {high.tolist()}"
        raise ValueError(f"unlikely, principal: expected 0 <= unlikely < principal < 1, received {received}")


def _activations(neighbours: Sequence[Sequence[int]], count: int, active: int) -> Tensor:
    """``(K, K)`` 1 where a model activates another, of ``count`` models of which ``active`` run at a time."""
    if len(neighbours) != count:
        raise ValueError(f"neighbours: expected one list for each of {count} models, received {len(neighbours)}")
    if max(map(len, neighbours)) >= active:
        expected = f"at most {active - 1} for each, which can run beside it"
        raise ValueError(f"neighbours: expected {expected}, received {neighbours}")
    if not all(0 <= activated < count for row in neighbours for activated in row):
        raise ValueError(f"neighbours: expected indices from 0 to {count - 1}, received {neighbours}")
    activates = torch.zeros(count, count, dtype=torch.float64)
    for model, activated in enumerate(neighbours):
        activates[model, list(activated)] = 1
    reached = torch.linalg.matrix_power(activates + torch.eye(count, dtype=torch.float64), count) > 0
    if not bool(reached.all()):
        raise ValueError(f"neighbours: expected every model to be reached from every other, received {neighbours}")
    return activates
