"""Interacting multiple models: a filter for each, whose beliefs are mixed before every step."""

from __future__ import annotations

import copy
import inspect
import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra import tree
from torchfra.filters.around import Around
from torchfra.filters.base import Filter
from torchfra.filters.forecast import Forecast, moments
from torchfra.filters.interaction import (
    IMMState,
    cycle,
    for_each_model,
    identity_at_zero_dt,
    interaction,
    uniform_interaction,
)
from torchfra.filters.likely_models import LikelyModels, of_active
from torchfra.filters.markov import generator, sojourn_times, transition_over
from torchfra.filters.model_smoothing import Models, ModelsPast, ModelsStep, estimate_of_models, past_of_models, retreat
from torchfra.gaussian.inputs import BackwardStep, Frame
from torchfra.gaussian.mixture import models_first, repeated
from torchfra.gaussian.model import canonical
from torchfra.hyper import Hyper, Value
from torchfra.linalg.safe import safe_log
from torchfra.motion.bank import Bank
from torchfra.numbers import as_numbers
from torchfra.steps.records import Record, Smoothed
from torchfra.steps.recursion import Mix, note_shared
from torchfra.types import Gaussian


class IMMInfo(NamedTuple):
    """Per step and track."""

    probabilities: Tensor
    """``(..., T, K)`` of the models, 0 for those that do not run."""
    active: Tensor | None = None
    """``(..., T, K)`` bool: the models that run; None if all do."""


class IMM(Around[IMMState]):
    """Interacting multiple models over ``SRCKF``, ``FRA`` or another filter with ``mixes``, in square-root form.

    Args:
        inner: a filter around a ``Bank`` of K motions; a copy of it runs all K in one batched call.
        transition: ``(K, K)``, ``transition[i, j] = P(now j | was i)``, rows that sum to one; it learns as
            ``transition``, row by row on the simplex.
        self_transition: instead of ``transition``, for two models or more: the self-transition probability of every
            model, from ``1 / K`` to below 1; a model switches to the others with equal probability.  It learns as
            ``self_transition``, one number.  The more models there are, the more time it saves.
        durations: instead of probabilities of a step, whatever its ``dt``: mean sojourn time of a model, s, one number
            for all or ``(K,)``.  The Markov chain is then one in continuous time, ``exp(G dt)`` over a step.  A model
            switches to the others with equal probability, or by the ``transition`` beside it, whose diagonal is 0.
        initial: ``(K,)`` probabilities before the first step; uniform if None.
        subset: chooses the models that run, of a ``transition`` above 0 and linear motions; all run if None.  The
            transition between active models: a model that stays active keeps its self-transition probability, and the
            rest of its row (the whole row of a model that does not) is divided in proportion.

    The models are the last dimension of the inner filter's batch; its hyperparameters are per track, or for all tracks.

    With a robust inner filter the likelihood of a model is that under the down-weighted noise: otherwise one outlier
    would decide between the models.

    ``Estimate.nis`` and the innovation are those of the Gaussian with the moments of all models' predictions,
    ``log_likelihood`` is that of their mixture.

    Raises:
        ValueError: no bank, or a filter that takes no ``mix`` (``GPB``, ``IMM``); ``transition`` and
            ``self_transition`` both or neither (``self_transition`` and ``durations`` both), a matrix that is no
            transition, a model that can never be reached, a ``self_transition`` or a duration out of its range; a
            subset of other models, or beside arguments that it excludes.

    Source: Blom & Bar-Shalom (1988); Du & Zhang (2020), eqs. (5)-(11).  Differs: no probability has a floor.
    """

    of_models = True
    transition: Hyper | None
    """None if ``self_transition`` or ``durations`` alone was given."""
    self_transition: Hyper | None
    """None if ``transition`` or ``durations`` was given."""
    durations: Hyper | None
    """None if probabilities of a step were given."""

    def __init__(
        self, inner: Filter, *, transition: Value | None = None, self_transition: Value | None = None,
        durations: Value | None = None, initial: Value | None = None, subset: LikelyModels | None = None,
    ) -> None:  # fmt: skip
        # A mix has the moments of beliefs alone, for which new points are to be drawn.
        takes_mix = "mix" in inspect.signature(inner.advance).parameters and getattr(inner, "redraw", True)
        if not isinstance(inner.motion, Bank) or not takes_mix:
            received = f"{type(inner).__name__} around {type(inner.motion).__name__}"
            expected = "SRCKF or FRA around a Bank, or a filter whose advance takes a mix"
            raise ValueError(f"inner: expected {expected}, received {received}")
        super().__init__(copy.deepcopy(inner), inner.sensor)
        note_shared(self)
        count = len(self.motion)
        if durations is not None and self_transition is not None:
            raise ValueError("self_transition, durations: expected one of the two, received both")
        if durations is None and (transition is None) == (self_transition is None):
            received = "neither" if self_transition is None else "both"
            raise ValueError(f"transition, self_transition: expected one of the two, received {received}")
        if subset is not None:
            subset.check(self.motion, transition if durations is None else _reachable(count, transition), initial)
        initial = as_numbers([1 / count] * count if initial is None else initial, "initial")
        if initial.shape[-1:] != (count,):
            raise ValueError(f"initial: expected ({count},), received {tuple(initial.shape)}")
        self.transition = None
        if transition is not None:
            self.transition = _as_transition(count, transition, zero_diagonal=durations is not None)
        self.self_transition = None if self_transition is None else _as_self_transition(count, self_transition)
        self.durations = None if durations is None else _as_durations(count, durations)
        self.initial = None if subset else Hyper(initial.double(), constraints.simplex, event_dim=1, name="initial")
        self.subset = subset

    @property
    def motion(self) -> Bank:  # type: ignore[override]
        """The bank."""
        return self.inner.motion  # type: ignore[return-value]

    def begin(self, belief: Gaussian) -> IMMState:
        """The state of a belief: the same for each model."""
        batch = belief.mean.shape[:-1]
        if self.subset is not None:
            active = self.subset.begin(belief.mean)
            count = active.shape[-2]
            uniform = belief.mean.new_full((*batch, count), -math.log(count))
            return IMMState(belief, self.inner.begin(repeated(belief, count)), uniform, active)
        count = len(self.motion)
        assert self.initial is not None
        initial = self.initial(belief.mean).log().expand((*batch, count))
        return IMMState(belief, self.inner.begin(repeated(belief, count)), initial)

    def advance(self, state: IMMState, frame: Frame) -> tuple[IMMState, Record]:
        """One step: interaction, then a cycle of the models' filters."""
        predicted, interact, each, active = self.mixing(state, frame)
        inner, log_weights, record = cycle(self.inner, state.inner, predicted, interact, each)
        info = IMMInfo(log_weights.exp())
        if active is not None:
            info = IMMInfo((info.probabilities.unsqueeze(-2) @ active).squeeze(-2), active.sum(-2) > 0)
        assert record.density is not None
        density = record.density + frame.measurement_noise.log_norm
        record = record._replace(info=info, density=density, past=record.past._replace(active=active))
        return IMMState(record.belief, inner, log_weights, active), record

    def mixing(self, state: IMMState, frame: Frame) -> tuple[Tensor, Mix, Frame, Tensor | None]:
        """The interaction before a step.

        Returns:
            Logs ``(..., K)`` of the models' predicted probabilities, the function that mixes their beliefs, the frame
            for each model, and the active models, None if all are.
        """
        before, motion = state.log_weights, self.motion
        if self.subset is not None:
            active, matrix = self.subset(state.active, before, frame.dt, self.probabilities(before, frame.dt))
            return *interaction(before, matrix, motion), of_active(for_each_model(frame), active), active
        restart = self.restart_probability(frame.dt)
        if restart is None:
            interacting = interaction(before, self.log_transition(before, frame.dt), motion)
        else:
            interacting = uniform_interaction(state, restart, motion)
        return *interacting, for_each_model(frame), None

    def restart_probability(self, dt: Tensor) -> Tensor | None:
        """``e (...)`` of a transition ``(1 - e) I + e / K`` over ``dt (...)`` seconds; None if it has not this form."""
        count = len(self.motion)
        if self.self_transition is not None:
            return torch.where(dt == 0, 0.0, (1 - self.self_transition()) * count / (count - 1))
        if self.durations is None or self.durations.event_dim or self.transition is not None:
            return None
        return -torch.expm1(-dt / self.durations() * (count / (count - 1)))

    def matrix(self, like: Tensor | None = None) -> Tensor:
        """The transition ``(..., K, K)``, ``[was, now]``, with the dtype and on the device of ``like`` if not None.

        With ``durations`` it is the transition at the end of a sojourn time, whose diagonal is 0.
        """
        if self.transition is not None:
            return self.transition(like)  # type: ignore[no-any-return]
        count = len(self.motion)
        diagonal = torch.zeros((), dtype=torch.float64) if self.self_transition is None else self.self_transition()
        diagonal = (diagonal if like is None else diagonal.to(like.device))[..., None, None]
        same = torch.eye(count, dtype=torch.bool, device=diagonal.device)
        matrix = torch.where(same, diagonal, (1 - diagonal) / (count - 1))
        return matrix if like is None else matrix.to(like)

    def probabilities(self, like: Tensor, dt: Tensor) -> Tensor:
        """The transition ``(..., K, K)`` over a step of ``dt (...)`` seconds that are not 0."""
        matrix = self.matrix(like)
        if self.durations is None:
            return matrix
        durations = self.durations(like)
        if not self.durations.event_dim:
            durations = durations.unsqueeze(-1).expand(*durations.shape, len(self.motion))
        return transition_over(generator(durations, matrix), dt)

    def log_transition(self, like: Tensor, dt: Tensor) -> Tensor:
        """Logs of the transition ``(..., K, K)`` over a step of ``dt (...)`` seconds."""
        if self.durations is None:
            return identity_at_zero_dt(self.matrix(like).log(), dt)
        return safe_log(self.probabilities(like, dt))

    def forecast(self, state: IMMState, frame: Frame) -> Forecast:  # type: ignore[override]  # no mix
        """The prediction with the moments of all models."""
        log_weights, interact, each, _ = self.mixing(state, frame)
        forecast = self.inner.forecast(state.inner, each, interact)
        weights, seen = log_weights.movedim(-1, 0), models_first(forecast.measurement)
        belief = canonical(self.motion, moments(models_first(forecast.belief), weights, self.motion.angles))
        z = frame.sensor.at_points(belief.mean, frame.u)
        offset, root = moments(Gaussian(frame.sensor.difference(z, seen.mean), seen.scale_tril), weights)
        return Forecast(belief, Gaussian(z - offset, root))

    def past_transition(self, step: BackwardStep, like: Tensor) -> tuple[Tensor, Frame]:
        """Logs ``(..., K, K)`` of the transition in a step of the forward pass, ``[was, now]``, and its frame."""
        if self.subset is None:
            return self.log_transition(like, step.frame.dt), for_each_model(step.frame)
        was, now = step.past.active, step.next.active
        stays_active = (was * now).sum(-1)  # a model that stays active keeps its place
        every = self.probabilities(like, step.frame.dt)
        matrix = identity_at_zero_dt(safe_log(self.subset.matrix(every, was, now, stays_active)), step.frame.dt)
        return matrix, of_active(for_each_model(step.frame), now)

    def hypotheses(self, source: IMMState | ModelsPast) -> tuple[Gaussian, Tensor]:
        """The models of a state, or of an estimate's past, and logs of their probabilities."""
        return source.inner.belief, source.log_weights

    def past(self, belief: Gaussian, info: IMMInfo, state: IMMState, steps: ModelsStep) -> ModelsPast:
        """The past of every model."""
        return past_of_models(self.inner, state.inner, steps)

    def last(self, past: ModelsPast) -> tuple[Models, Smoothed]:
        """Where the backward pass begins: the filtered models of the last step."""
        models = Models(past.inner.belief, past.log_weights)
        return models, estimate_of_models(models, past.active, self.motion)

    def retreat(self, step: BackwardStep, after: Models) -> tuple[Models, Smoothed]:
        """One step of the backward pass, of all models."""
        if after.log_weights.dim() > step.past.log_weights.dim():
            each = [self.retreat(step, one) for one in tree.unbind(after, len(after.log_weights))]
            return tree.stack(each, 0)
        matrix, frame = self.past_transition(step, after.log_weights)
        models = retreat(self.inner, BackwardStep(step.past, step.next.inner, frame, step.source), matrix, after)
        return models, estimate_of_models(models, step.past.active, self.motion)


def _reachable(count: int, follows: Value | None) -> Tensor:
    """A matrix ``(count, count)`` above 0 where a model may follow another, or itself."""
    eye = torch.eye(count, dtype=torch.float64)
    return torch.ones_like(eye) if follows is None else as_numbers(follows, "transition").double() + eye


def _as_transition(count: int, value: Value, *, zero_diagonal: bool = False) -> Hyper:
    """The transition ``(count, count)`` between models as a hyperparameter.

    Raises:
        ValueError: no such matrix, one that does not reach every model, or a diagonal against ``zero_diagonal``.
    """
    value = as_numbers(value, "transition").double()
    if value.shape[-2:] != (count, count) or not bool((value.sum(-2) > 0).all()):
        expected = f"({count}, {count}) that reaches every model"
        raise ValueError(f"transition: expected {expected}, received {value.tolist()}")
    if zero_diagonal and bool((value.diagonal(dim1=-2, dim2=-1) != 0).any()):
        expected = "a diagonal of 0 beside durations, as another model follows one that ends"
        raise ValueError(f"transition: expected {expected}, received {value.tolist()}")
    return Hyper(value, constraints.simplex, event_dim=2, name="transition")


def _as_durations(count: int, value: Value) -> Hyper:
    """Mean sojourn times of ``count`` models, s, one number or one for each, as a hyperparameter.

    Raises:
        ValueError: a single model, another number of values, or one that is not above 0 or infinite.
    """
    value = as_numbers(value, "durations").double()
    if count < 2:
        raise ValueError(f"durations: expected None for a single model, received {value.tolist()}")
    if value.dim() and value.shape[-1] != count:
        raise ValueError(f"durations: expected a number or ({count},), received {tuple(value.shape)}")
    return sojourn_times(value, min(value.dim(), 1), "durations")


def _as_self_transition(count: int, value: Value) -> Hyper:
    """The self-transition probability of ``count`` models as a hyperparameter.

    Raises:
        ValueError: a single model, or a value out of its range.
    """
    if count < 2:
        raise ValueError(f"self_transition: expected None for a single model, received {value}")
    return Hyper(value, constraints.half_open_interval(1 / count, 1.0), name="self_transition")
