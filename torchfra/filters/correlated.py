"""A filter of a target's own states around one that has the errors of its sensor in the state too."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from functools import wraps
from itertools import count
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from torchfra.filters.base import Filter
from torchfra.filters.forecast import Forecast
from torchfra.filters.records import Record, Smoothed
from torchfra.gaussian.inputs import BackwardStep, Frame, Time
from torchfra.linalg.triangular import block_diagonal
from torchfra.motion.augmented import Augmented
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.motion.correlated import GaussMarkov
from torchfra.sensors.base import Sensor
from torchfra.sensors.composed import Biased
from torchfra.sensors.correlated import erring, errors_of, stationary, without_errors
from torchfra.types import Gaussian

P = TypeVar("P", bound=Callable[..., Any])


class WithErrorsState(NamedTuple):
    """State after a step."""

    belief: Gaussian
    """Of the target alone."""
    inner: Any
    """Of the filter inside, the errors included."""


class WithErrorsPast(NamedTuple):
    """What a step has left, the errors included."""

    belief: Gaussian
    info: Any
    past: Any


class WithErrors(Filter[WithErrorsState]):
    """A filter whose sensor has errors that last: they are in the state of the filter ``inner``, and nowhere else.

    Priors, estimates and beliefs in ``info`` are the leading components, of the target; errors begin as they are in the
    long run.  Its presets are those of ``inner``: they make it for a ``sensors.Correlated``.

    Args:
        inner: a filter around ``Augmented`` motions, the target's first, or a ``Bank`` of such, and a ``Biased``
            sensor.
        sensor: the sensor with its errors.
    """

    keeps_past = True

    def __init__(self, inner: Filter, sensor: Sensor) -> None:
        super().__init__()
        self.inner, self.originals = inner, (sensor,)

    # ------------------------------------------------------------ the models

    @property
    def motion(self) -> Motion:  # type: ignore[override]
        """Of the target alone."""
        motion = self.inner.motion
        if isinstance(motion, Bank):
            return Bank([_targets(one) for one in motion[:]], neighbours=motion.neighbours, first=motion.first)
        return _targets(motion)

    @property
    def sensor(self) -> Sensor:  # type: ignore[override]
        """The sensor without its errors."""
        sensor = self.inner.sensor
        return sensor.unbiased if self.home is self else sensor  # type: ignore[return-value]  # it is Biased

    @property
    def frame_motion(self) -> Motion:
        """Of the target and the errors."""
        return self.inner.frame_motion

    @property
    def errors(self) -> list[GaussMarkov]:
        """The errors, behind the target in the state of ``inner``."""
        motion = self.inner.motion
        first: Any = motion[0] if isinstance(motion, Bank) else motion
        return list(first.parts)[1:]

    @property
    def alarms(self) -> bool:  # type: ignore[override]
        """Whether ``inner`` says if the sensor is faulty."""
        return self.inner.alarms

    @property
    def instants(self) -> bool:  # type: ignore[override]
        """Whether steps of ``inner`` may take no time."""
        return self.inner.instants

    @property
    def one_sensor(self) -> str | None:  # type: ignore[override]
        """Why ``inner`` may have no other sensor."""
        return self.inner.one_sensor

    def own(self, tree: Any) -> Any:
        """A tree with its beliefs cut to the target's components: a leading block of a lower root is one."""
        if isinstance(tree, Gaussian):
            n = self.inner.motion.size - sum(error.size for error in self.errors)
            return Gaussian(tree.mean[..., :n], tree.scale_tril[..., :n, :n])
        if isinstance(tree, tuple):
            parts = [self.own(part) for part in tree]
            return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)
        return tree

    # ------------------------------------------------------------ steps

    def begin(self, belief: Gaussian) -> WithErrorsState:
        """The state of a belief of the target: errors are as in the long run, whatever it is."""
        std = stationary(self.errors, belief.mean)
        mean = torch.cat([belief.mean, torch.zeros_like(std)], -1)
        root = block_diagonal([belief.scale_tril, torch.diag_embed(std)])
        return WithErrorsState(belief, self.inner.begin(Gaussian(mean, root)))

    def advance(self, state: WithErrorsState, frame: Frame, *_: Any) -> tuple[WithErrorsState, Record]:
        """One step of the filter inside."""
        inner, record = self.inner.advance(state.inner, frame)
        past = WithErrorsPast(record.belief, record.info, record.past)
        record = record._replace(belief=self.own(record.belief), info=self.own(record.info), past=past)
        return WithErrorsState(self.own(inner.belief), inner), record

    def finish(self, state: WithErrorsState, belief: Gaussian, info: Any) -> tuple[Gaussian, Any]:
        """As the filter inside does, with the target's components."""
        return self.inner.finish(self.own(state.inner), belief, info)

    def predict(
        self, state: WithErrorsState, dt: Time, *, u: Tensor | None = None, sensor: Sensor | None = None
    ) -> Forecast:
        """What is expected after ``dt`` seconds: the target, and a measurement with its errors."""
        forecast = self.with_sensor(sensor).inner.predict(state.inner, dt, u=u)
        return forecast._replace(belief=self.own(forecast.belief))

    def hypotheses(self, known: Any) -> tuple[Gaussian, Tensor]:
        """Those of the filter inside."""
        beliefs, log_weights = self.inner.hypotheses(known.inner if isinstance(known, WithErrorsState) else known)
        return self.own(beliefs), log_weights

    # ------------------------------------------------------------ other sensors

    def parts_for(self, sensor: Sensor) -> dict[str, nn.Module]:
        """The filter inside around another sensor, whose errors are white."""
        return {"inner": self.inner.with_sensor(sensor)}

    # ------------------------------------------------------------ smoothing

    def check_smooths(self) -> None:
        """Raises a ``NotImplementedError`` that says why, if the filter inside cannot be smoothed."""
        self.inner.check_smooths()

    def check_smooths_several(self) -> None:
        """Raises a ``NotImplementedError`` that says why, if it cannot be smoothed over several sensors."""
        self.inner.check_smooths_several()

    def past(self, belief: Gaussian, info: Any, state: WithErrorsState, steps: WithErrorsPast) -> Any:
        """What the filter inside needs."""
        belief, info = self.inner.finish(state.inner, steps.belief, steps.info)
        return self.inner.past(belief, info, state.inner, steps.past)

    def fresh(self, past: Any) -> Any:
        """As of the filter inside."""
        return self.inner.fresh(past)

    def decided(self, past: Any) -> Any:
        """As of the filter inside."""
        return self.inner.decided(past)

    def needed_of_next(self, past: Any) -> Any:
        """As of the filter inside."""
        return self.inner.needed_of_next(past)

    def last(self, past: Any) -> tuple[Any, Smoothed]:
        """Where the backward pass begins."""
        state, smoothed = self.inner.last(past)
        return state, self.own(smoothed)

    def retreat(self, step: BackwardStep, after: Any) -> tuple[Any, Smoothed]:
        """One step back of the filter inside."""
        state, smoothed = self.inner.retreat(step, after)
        return state, self.own(smoothed)


def with_errors(preset: P, takes: bool = True) -> P:
    """A preset ``(motion, sensor, ...)`` that takes a sensor with errors that last, or refuses it."""
    first, second = list(inspect.signature(preset).parameters)[:2]

    @wraps(preset)
    def made(*arguments: Any, **options: Any) -> Any:
        given = dict(zip((first, second), arguments, strict=False)) | options
        motion, sensor = given.get(first), given.get(second)
        if not isinstance(sensor, Sensor) or not errors_of(sensor) or not isinstance(motion, Motion | Sequence):
            return preset(*arguments, **options)
        if not takes:
            expected = f"one without errors that last, as {preset.__name__} has none in its state"
            raise ValueError(f"sensor: expected {expected}, received {sensor.describe()}")
        errors, behind = errors_of(sensor), count(_one(motion).size)
        biased = Biased(without_errors(sensor), [next(behind) if has else None for has in erring(sensor)])
        rest = {name: x for name, x in options.items() if name not in (first, second)}
        return WithErrors(preset(_augmented(motion, errors), biased, *arguments[2:], **rest), sensor)

    return made  # type: ignore[return-value]  # it takes the same, and more


def _one(motion: Motion | Sequence[Motion]) -> Motion:
    """A motion, or the first of several."""
    return motion if isinstance(motion, Motion) else motion[0]


def _augmented(motion: Motion | Sequence[Motion], errors: list[GaussMarkov]) -> Motion | list[Augmented]:
    """The motion, or each of several, with errors behind it."""
    if isinstance(motion, Bank):
        every = [Augmented(one, *errors) for one in motion[:]]
        return Bank(every, neighbours=motion.neighbours, first=motion.first)
    if isinstance(motion, Motion):
        return Augmented(motion, *errors)
    return [Augmented(one, *errors) for one in motion]


def _targets(motion: Any) -> Motion:
    """Of an ``Augmented`` motion the target's own."""
    own: Motion = motion.parts[0]
    return own
