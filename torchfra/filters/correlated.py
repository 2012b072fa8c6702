"""A filter for sensors with time-correlated errors: the errors are in the state of an inner filter."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from functools import wraps
from itertools import count
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from torchfra import tree
from torchfra.filters.around import Around
from torchfra.filters.base import Filter
from torchfra.filters.forecast import Forecast
from torchfra.gaussian.inputs import BackwardStep, Frame
from torchfra.linalg.triangular import block_diagonal
from torchfra.motion.augmented import Augmented
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.motion.correlated import GaussMarkov
from torchfra.sensors.base import Sensor
from torchfra.sensors.composed import Biased
from torchfra.sensors.correlated import errors_of, have_errors, stationary, without_errors
from torchfra.steps.records import Record, Smoothed
from torchfra.steps.recursion import HasBelief
from torchfra.types import Gaussian

T = TypeVar("T")  # a tree
P = TypeVar("P", bound=Callable[..., Any])


class WithCorrelatedErrorsState(NamedTuple):
    """State after a step."""

    belief: Gaussian
    """The estimate of the target alone."""
    inner: HasBelief
    """State of the inner filter, with the errors."""

    @property
    def duration(self) -> Tensor | None:
        """Seconds for which the sensor has been faulty, if the inner filter counts them: see ``Alarm``."""
        seconds: Tensor | None = getattr(self.inner, "duration", None)
        return seconds


class WithCorrelatedErrorsPast(NamedTuple):
    """The parts of a step of the inner filter that the backward pass needs, with the errors."""

    belief: Gaussian
    info: object
    past: object


class WithCorrelatedErrors(Around[WithCorrelatedErrorsState]):
    """A filter whose sensor has time-correlated errors: only the state of ``inner`` holds them.

    Priors, estimates and beliefs in ``info`` have the components of the target alone; errors start from their
    stationary distribution.  A preset makes this filter if its sensor is a ``sensors.Correlated``.

    Source: Bar-Shalom, Li & Kirubarajan (2001), chapter 8, for state augmentation.

    Args:
        inner: a filter around an ``Augmented`` motion, the target's first, or a ``Bank`` of such motions, and a
            ``Biased`` sensor.
        sensor: the sensor with its errors.
    """

    def __init__(self, inner: Filter, sensor: Sensor) -> None:
        super().__init__(inner, sensor)
        self.limits = inner.limits

    # ------------------------------------------------------------ the models

    @property
    def motion(self) -> Motion:  # type: ignore[override]
        """The motion of the target alone."""
        motion = self.inner.motion
        if isinstance(motion, Bank):
            return Bank([_parts(one)[0] for one in motion[:]], neighbours=motion.neighbours, first=motion.first)
        return _parts(motion)[0]

    @property
    def sensor(self) -> Sensor:  # type: ignore[override]
        """The sensor without its errors."""
        return self.inner.sensor.unbiased  # type: ignore[return-value]  # it is Biased

    @property
    def errors(self) -> list[GaussMarkov]:
        """The errors, behind the target in the state of ``inner``."""
        motion = self.inner.motion
        return _parts(motion[0] if isinstance(motion, Bank) else motion)[1:]  # type: ignore[return-value]  # they are

    def of_target(self, trees: T) -> T:
        """Trees whose beliefs have the target's components alone: the leading block of a lower root is their root."""
        n = self.inner.motion.size - sum(error.size for error in self.errors)
        return tree.map_parts(lambda x: Gaussian(x.mean[..., :n], x.scale_tril[..., :n, :n]), trees, Gaussian)

    # ------------------------------------------------------------ steps

    def begin(self, belief: Gaussian) -> WithCorrelatedErrorsState:
        """The state of a belief of the target, with errors in their stationary distribution."""
        std = stationary(self.errors, belief.mean)
        mean = torch.cat([belief.mean, torch.zeros_like(std)], -1)
        root = block_diagonal([belief.scale_tril, torch.diag_embed(std)])
        return WithCorrelatedErrorsState(belief, self.inner.begin(Gaussian(mean, root)))

    def advance(self, state: WithCorrelatedErrorsState, frame: Frame) -> tuple[WithCorrelatedErrorsState, Record]:
        """One step of the inner filter."""
        inner, record = self.inner.advance(state.inner, frame)
        past = WithCorrelatedErrorsPast(record.belief, record.info, record.past)
        record = record._replace(belief=self.of_target(record.belief), info=self.of_target(record.info), past=past)
        return WithCorrelatedErrorsState(self.of_target(inner.belief), inner), record

    def finish(self, state: WithCorrelatedErrorsState, belief: Gaussian, info: object) -> tuple[Gaussian, Any]:
        """The estimates of the inner filter, with the target's components alone."""
        return self.inner.finish(self.of_target(state.inner), belief, info)

    def forecast(self, state: WithCorrelatedErrorsState, frame: Frame) -> Forecast:  # type: ignore[override]  # no mix
        """The prediction of the target, and of a measurement with its errors."""
        forecast = self.inner.forecast(state.inner, frame)
        return forecast._replace(belief=self.of_target(forecast.belief))

    def hypotheses(self, source: HasBelief) -> tuple[Gaussian, Tensor]:
        """The hypotheses of the inner filter, with the target's components alone."""
        beliefs, log_weights = self.inner.hypotheses(
            source.inner if isinstance(source, WithCorrelatedErrorsState) else source
        )
        return self.of_target(beliefs), log_weights

    # ------------------------------------------------------------ smoothing

    def past(
        self, belief: Gaussian, info: object, state: WithCorrelatedErrorsState, steps: WithCorrelatedErrorsPast
    ) -> Any:
        """The past of the inner filter."""
        belief, info = self.inner.finish(state.inner, steps.belief, steps.info)
        return self.inner.past(belief, info, state.inner, steps.past)

    def last(self, past: Any) -> tuple[Any, Smoothed]:
        """Where the backward pass begins: the last step of the inner filter."""
        state, smoothed = self.inner.last(past)
        return state, self.of_target(smoothed)

    def retreat(self, step: BackwardStep, after: Any) -> tuple[Any, Smoothed]:
        """One step of the backward pass of the inner filter."""
        state, smoothed = self.inner.retreat(step, after)
        return state, self.of_target(smoothed)


def with_errors(preset: P, takes: bool = True) -> P:
    """A preset ``(motion, sensor, ...)`` that takes sensors with time-correlated errors, or refuses them."""
    first, second = list(inspect.signature(preset).parameters)[:2]

    @wraps(preset)
    def made(*arguments: Any, **options: Any) -> Any:
        named = dict(zip((first, second), arguments, strict=False)) | options
        motion, sensor = named.get(first), named.get(second)
        if not isinstance(sensor, Sensor) or not errors_of(sensor) or not isinstance(motion, Motion | Sequence):
            return preset(*arguments, **options)
        if not takes:
            expected = f"one without time-correlated errors, as {preset.__name__} has none in its state"
            raise ValueError(f"sensor: expected {expected}, received {sensor.describe()}")
        # Each element with an error gets the next component behind those of the target.
        first_motion = motion if isinstance(motion, Motion) else motion[0]
        errors, behind = errors_of(sensor), count(first_motion.size)
        biased = Biased(without_errors(sensor), [next(behind) if has else None for has in have_errors(sensor)])
        options = {name: x for name, x in options.items() if name not in (first, second)}
        return WithCorrelatedErrors(preset(_augmented(motion, errors), biased, *arguments[2:], **options), sensor)

    return made  # type: ignore[return-value]  # it takes all that the preset takes


def _augmented(motion: Motion | Sequence[Motion], errors: list[GaussMarkov]) -> Motion | list[Augmented]:
    """The motion, or each of several, with errors behind it."""
    if isinstance(motion, Bank):
        models = [Augmented(one, *errors) for one in motion[:]]
        return Bank(models, neighbours=motion.neighbours, first=motion.first)
    if isinstance(motion, Motion):
        return Augmented(motion, *errors)
    return [Augmented(one, *errors) for one in motion]


def _parts(motion: Motion) -> list[Motion]:
    """The target's motion, and those of its errors."""
    assert isinstance(motion, Augmented)
    return list(motion.parts)  # type: ignore[arg-type]  # motions
