"""Interacting models of which only a few run at a time: the likely ones, chosen anew before every step."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra import tree
from torchfra.filters.base import Filter, Mix
from torchfra.filters.imm import MultipleModelFilter
from torchfra.filters.interaction import PER_MODEL, cycle, for_each_model, held, interaction
from torchfra.filters.records import Record
from torchfra.gaussian.inputs import BackwardStep, Frame
from torchfra.gaussian.mixture import repeated
from torchfra.hyper import Hyper, Value
from torchfra.types import Gaussian


class VSIMMState(NamedTuple):
    """What the active models know after a step."""

    belief: Gaussian
    """All of them together."""
    inner: Any
    """Of their filters, whose batch ends in the active models: ``(..., A)``."""
    log_weights: Tensor
    """``(..., A)`` logs of their probabilities."""
    active: Tensor
    """``(..., A, K)`` one in each row: which model of the bank it is."""


class VSIMMInfo(NamedTuple):
    """Per step and track."""

    probabilities: Tensor
    """``(..., T, K)`` of all models, 0 of those that do not run."""
    active: Tensor
    """``(..., T, K)`` bool: the models that run."""


class VSIMM(MultipleModelFilter[VSIMMState]):
    """Interacting multiple models with a model set that changes: the likely-model set, at a fixed number of models.

    Before every step the set is chosen from the probabilities: a model above ``principal`` calls its neighbours, one
    below ``unlikely`` makes room.  First come principal models, then their neighbours, then the others that run, then
    the unlikely; within each by probability.  Every track has its own set.

    Args:
        inner: a filter around a ``Bank`` of K linear motions.
        neighbours: for each model those it calls, by number, as many as can run beside it or fewer; every model must be
            reached from every other.
        first: the models that run first.
        transition: ``(K, K)`` between all models, ``transition[i, j] = P(now j | was i)``, all above 0.  Those that run
            share a row out: a model that goes on keeps its self-transition probability, and the rest (of one that
            goes, all) is divided in proportion.  It learns as ``transition``, row by row on the simplex.
        unlikely: probability below which a model makes room.
        principal: probability above which a model calls its neighbours.  A choice passes no gradient to either.

    Raises:
        ValueError: no bank of linear motions, thresholds out of order, a table that does not connect the models, or a
            matrix that is no transition between all of them.

    Source: Du & Zhang (2020), eqs. (4)-(11); Li & Zhang (2000), "Multiple-Model Estimation with Variable Structure,
    Part V: Likely-Model Set Algorithm".  Differs: the paper does not say how its set changes; the number is fixed.
    """

    calls: Tensor
    """``(K, K)`` 1 where a principal model calls another."""
    first: Tensor
    """``(A, K)`` the models that run first, one in each row."""

    def __init__(
        self,
        inner: Filter,
        *,
        neighbours: Sequence[Sequence[int]],
        first: Sequence[int],
        transition: Value,
        unlikely: Value = 0.05,
        principal: Value = 0.5,
    ) -> None:
        super().__init__(inner)
        count = len(self.motion)
        transition = torch.as_tensor(transition, dtype=torch.float64)
        if not self.motion.linear:
            raise ValueError(f"inner: expected a filter around a Bank of linear motions, received {self.motion}")
        if transition.shape[-2:] != (count, count) or not bool((transition > 0).all()):
            raise ValueError(f"transition: expected ({count}, {count}) above 0, received {transition.tolist()}")
        _check_thresholds(unlikely, principal)
        if len(set(first)) != len(first) or not 1 < len(first) <= count or not set(first) <= set(range(count)):
            raise ValueError(f"first: expected 2 to {count} different models, received {list(first)}")
        self.transition = Hyper(transition, constraints.simplex, event_dim=2, name="transition")
        self.unlikely = Hyper(unlikely, constraints.unit_interval, name="unlikely")
        self.principal = Hyper(principal, constraints.unit_interval, name="principal")
        self.register_buffer("calls", _calls(neighbours, count, len(first)))
        self.register_buffer("first", torch.eye(count, dtype=torch.float64)[list(first)])

    def begin(self, belief: Gaussian) -> VSIMMState:
        """The state of a belief: the first models, all with the same probability."""
        first, batch = self.first.to(belief.mean), belief.mean.shape[:-1]
        log_weights = belief.mean.new_full((*batch, len(first)), -math.log(len(first)))
        inner = self.inner.begin(repeated(belief, len(first)))
        return VSIMMState(belief, inner, log_weights, first.expand(*batch, *first.shape))

    def advance(self, state: VSIMMState, frame: Frame, mix: Mix | None = None) -> tuple[VSIMMState, Record]:
        """One step; ``mix`` is not looked at, as this filter mixes itself."""
        active, matrix, frame = self.chosen(state, frame)
        interacting = interaction(state.log_weights, matrix, self.motion)
        inner, log_weights, record = cycle(self.inner, state.inner, *interacting, frame)
        weights = (log_weights.exp().unsqueeze(-2) @ active).squeeze(-2)
        info = VSIMMInfo(weights, active.sum(-2) > 0)
        record = record._replace(info=info, past=record.past._replace(active=active))
        return VSIMMState(record.belief, inner, log_weights, active), record

    def chosen(self, state: VSIMMState, frame: Frame) -> tuple[Tensor, Tensor, Frame]:
        """The set ``(..., A, K)`` of a step, logs ``(..., A, A)`` of the transition to it, and its frame."""
        active, goes_on = self.choose(state.active, state.log_weights)
        instant = (frame.dt == 0).unsqueeze(-1)  # over no time the set stays
        active = torch.where(instant.unsqueeze(-1), state.active, active)
        goes_on = torch.where(instant, torch.ones_like(goes_on), goes_on)
        matrix = held(self.matrix(state.active, active, goes_on).log(), frame.dt)
        return active, matrix, _of_active(for_each_model(frame), active)

    def lead(self, state: Any, frame: Frame) -> tuple[Tensor, Mix, Frame]:
        """Logs ``(..., A)`` of the active models' probabilities in a step, what mixes them for it, and its frame."""
        _, matrix, frame = self.chosen(state, frame)
        return *interaction(state.log_weights, matrix, self.motion), frame

    def matrix_back(self, step: BackwardStep, like: Tensor) -> tuple[Tensor, Frame]:
        """Logs ``(..., A, A)`` of the transition of a step, ``[was, now]``, and its frame for each active model."""
        was, now = step.past.active, step.ahead.active
        goes_on = (was * now).sum(-1)  # a model that goes on keeps its place
        matrix = held(self.matrix(was, now, goes_on).log(), step.frame.dt)
        return matrix, _of_active(for_each_model(step.frame), now)

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

    def matrix(self, was: Tensor, now: Tensor, goes_on: Tensor) -> Tensor:
        """``P(now j | was i) (..., A, A)`` between two sets ``(..., A, K)``.

        Eq. (4) when all others share what a row leaves.
        """
        transition = self.transition(was)
        diagonal = transition.diagonal(dim1=-2, dim2=-1)
        others = was @ (transition - diagonal.diag_embed()) @ now.mT
        stay = goes_on * (was @ diagonal.unsqueeze(-1)).squeeze(-1)
        left = (1 - stay) / others.sum(-1)
        matrix: Tensor = stay.diag_embed() + left.unsqueeze(-1) * others
        return matrix


def _counted(x: Tensor) -> Tensor:
    """How many there are up to each place, of ones and zeros."""
    count = x.shape[-1]
    return (x.unsqueeze(-2) @ torch.ones(count, count, dtype=x.dtype, device=x.device).triu()).squeeze(-2)


def _of_active(frame: Frame, active: Tensor) -> Frame:
    """Of the matrices of all models those of the active ones."""

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
