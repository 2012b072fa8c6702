"""Interacting multiple models: one filter for each, that exchange what they know before every step."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import constraints

from torchfra.filters.base import Filter, Mix, Record
from torchfra.gaussian.inputs import Frame
from torchfra.gaussian.mixture import moment_match
from torchfra.gaussian.update import density
from torchfra.hyper import Hyper, Value
from torchfra.linalg.triangular import whiten
from torchfra.motion.bank import Bank
from torchfra.sensors.base import MeasurementNoise
from torchfra.types import Gaussian


class IMMState(NamedTuple):
    """What the models know after a step."""

    belief: Gaussian
    """All models together."""
    inner: Any
    """Of their filters, whose batch ends in the models: ``(..., K)``."""
    log_weights: Tensor
    """``(..., K)`` logs of the models' probabilities."""


class IMMInfo(NamedTuple):
    """Per step and track."""

    probabilities: Tensor
    """``(..., T, K)`` of the models."""


class Around(Filter):
    """Abstract: a filter around another that runs all models of a ``Bank`` in one batched call.

    Args:
        inner: that other; motion and sensor are its own.

    Raises:
        ValueError: it has no bank, or is one of these itself.
    """

    def __init__(self, inner: Filter) -> None:
        nn.Module.__init__(self)
        if not isinstance(inner.motion, Bank) or isinstance(inner, Around):
            raise ValueError(
                f"inner: expected a plain filter around a Bank, received {type(inner).__name__} around "
                f"{type(inner.motion).__name__}"
            )
        self._compiled = None
        self.inner = inner
        for part in inner.children():
            if part is not inner.motion and part is not inner.sensor:
                for hyper in (h for h in part.modules() if isinstance(h, Hyper)):
                    hyper.shared_dims = 1

    @property
    def motion(self) -> Bank:  # type: ignore[override]
        """The bank."""
        return self.inner.motion  # type: ignore[return-value]

    @property
    def sensor(self) -> Any:  # type: ignore[override]
        """The sensor."""
        return self.inner.sensor


class IMM(Around):
    """Interacting multiple models over any filter of this package, in the log domain and in square-root form.

    Args:
        inner: a filter around a ``Bank`` of K motions; all K run in one batched call.
        transition: ``(K, K)``, ``transition[i, j] = P(now j | was i)``, rows that sum to one; it learns as
            ``transition``, row by row on the simplex.
        initial: ``(K,)`` probabilities before the first step; all the same if None.

    The models are the last dimension of the inner filter's batch; its hyperparameters are those of a track, or of all.

    A filter that is robust judges its model by the measurement as it trusts it: or one outlier would decide.

    ``Estimate.nis`` and the innovation are those of the Gaussian with the moments of all models' predictions,
    ``log_likelihood`` is that of their mixture.

    Raises:
        ValueError: no bank, a matrix that is no transition, or a model that can never be reached.

    Source: Blom & Bar-Shalom (1988); Du & Zhang (2020), eqs. (5)-(11).  Differs: no probability has a floor.
    """

    def __init__(self, inner: Filter, *, transition: Value, initial: Value | None = None) -> None:
        super().__init__(inner)
        count = len(self.motion)
        transition = torch.as_tensor(transition, dtype=torch.float64)
        initial = torch.full((count,), 1 / count, dtype=torch.float64) if initial is None else torch.as_tensor(initial)
        if transition.shape[-2:] != (count, count) or not bool((transition.sum(-2) > 0).all()):
            raise ValueError(
                f"transition: expected ({count}, {count}) that reaches every model, received {transition.tolist()}"
            )
        if initial.shape[-1:] != (count,):
            raise ValueError(f"initial: expected ({count},), received {tuple(initial.shape)}")
        self.transition = Hyper(transition, constraints.simplex, event_dim=2, name="transition")
        self.initial = Hyper(initial.double(), constraints.simplex, event_dim=1, name="initial")

    def begin(self, belief: Gaussian) -> IMMState:
        """See ``Filter``."""
        count = len(self.motion)
        initial = self.initial(belief.mean).log().expand((*belief.mean.shape[:-1], count))
        return IMMState(belief, self.inner.begin(repeated(belief, count)), initial)

    def advance(self, state: IMMState, frame: Frame, mix: Mix | None = None) -> tuple[IMMState, Record]:
        """See ``Filter``; it mixes, and is not mixed."""
        matrix = self.transition(state.log_weights).log()
        inner, log_weights, record = cycle(self.inner, state.inner, state.log_weights, matrix, for_each(frame))
        record = record._replace(info=IMMInfo(log_weights.exp()))
        return IMMState(record.belief, inner, log_weights), record


def repeated(belief: Gaussian, count: int) -> Gaussian:
    """The same belief for each of so many models, ``(..., K)``."""
    mean, root = belief.mean.unsqueeze(-2), belief.scale_tril.unsqueeze(-3)
    return Gaussian(mean.expand(*mean.shape[:-2], count, -1), root.expand(*root.shape[:-3], count, -1, -1))


def cycle(inner: Filter, state: Any, log_weights: Tensor, matrix: Tensor, frame: Frame) -> tuple[Any, Tensor, Record]:
    """Interaction, filtering, probabilities and fusion: eqs. (5)-(11).

    Args:
        inner: the filter of all models.
        state: its own, whose batch ends in the models.
        log_weights: ``(..., K)`` before.
        matrix: ``(..., K, K)`` logs of the transition, ``[was, now]``.
        frame: for each model.

    Returns:
        The filter's state, the log weights after, and what all models together keep of the step.
    """
    joint = matrix + log_weights.unsqueeze(-1)
    ahead = joint.logsumexp(-2)  # eq. (5): (..., K) before the measurement
    shares = (joint - ahead.unsqueeze(-2)).movedim(-2, 0)  # eq. (6): [was, ..., now]

    def interact(belief: Gaussian) -> Gaussian:
        """Eqs. (7), (8)."""
        mean, root = belief.mean.movedim(-2, 0).unsqueeze(-2), belief.scale_tril.movedim(-3, 0).unsqueeze(-3)
        count = len(mean)
        every = Gaussian(mean.expand(*mean.shape[:-2], count, -1), root.expand(*root.shape[:-3], count, -1, -1))
        return moment_match(every, shares)

    state, record = inner.advance(state, frame, interact)
    own = _or_none(density(record.root, record.normalised))
    log_weights = ahead + (own if record.evidence is None else _or_none(record.evidence))
    log_weights = log_weights - log_weights.logsumexp(-1, keepdim=True)  # eq. (9)
    belief = _together(record.belief, log_weights)  # eqs. (10), (11)
    seen = _together(Gaussian(record.residual, record.root), ahead)
    normalised, whole = whiten(seen.scale_tril, seen.mean), (ahead + own).logsumexp(-1)
    return state, log_weights, Record(belief, *seen, normalised, None, whole)


def _or_none(score: Tensor) -> Tensor:
    """Nothing speaks for a model that lost its numbers; the others go on."""
    return torch.where(score.isnan(), -torch.inf, score)


def _together(belief: Gaussian, log_weights: Tensor) -> Gaussian:
    """Of ``(..., K)`` beliefs the one with their moments."""
    first = Gaussian(belief.mean.movedim(-2, 0), belief.scale_tril.movedim(-3, 0))
    return moment_match(first, log_weights.movedim(-1, 0))


def for_each(frame: Frame) -> Frame:
    """The same for every model: a batch that ends in the models, which matrices of a ``Bank`` have already."""

    def wide(x: Any, event: int) -> Any:
        return x if x is None or x.dim() == event else x.unsqueeze(-1 - event)

    noise = MeasurementNoise(
        *(wide(x, event) for x, event in zip(frame.measurement_noise, (1, 1, 2, 2, 0), strict=True))
    )
    z, seen, dt = frame.z.unsqueeze(-2), frame.seen.unsqueeze(-2), wide(frame.dt, 0)
    return frame._replace(z=z, seen=seen, measurement_noise=noise, dt=dt, u=wide(frame.u, 1))
