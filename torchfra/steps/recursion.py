"""The recursion of a filter: the two or three functions that it gives, and what a loop over steps calls beside them."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, Generic, NamedTuple, ParamSpec, Protocol

import torch
from torch import Tensor
from typing_extensions import TypeVar

from torchfra.adaptive.fading import Fading
from torchfra.gaussian.arguments import (
    belief_of,
    check,
    check_belief,
    warn_of_degrees,
    warn_of_lost_digits,
    warn_of_width,
)
from torchfra.gaussian.cubature import third_degree
from torchfra.gaussian.inputs import (
    BackwardStep,
    Frame,
    Measurements,
    batch_rank,
    broadcast_with_values,
    make_frames,
    value_batches,
)
from torchfra.gaussian.model import Propagated, compare, predict, propagate
from torchfra.gaussian.rules import Rule
from torchfra.gaussian.smoothing import smooth_step
from torchfra.hyper import Part, hypers
from torchfra.linalg.batches import broadcast_shapes
from torchfra.linalg.triangular import tria
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.steps.models import check_models
from torchfra.steps.records import Past, Record, Smoothed
from torchfra.types import Gaussian, Prediction, Whitened

Mix = Callable[[Gaussian], Gaussian]
"""Mixes the beliefs of interacting models before a step."""


class Limits(NamedTuple):
    """What a filter does not do: the reason; None for what it does."""

    smoothing: str | None = None
    smoothing_several: str | None = None
    """Over several sensors."""
    other_sensors: str | None = None
    """Than its own."""
    zero_dt: bool = True
    """Whether ``dt`` may be 0, as before a second measurement at the same instant."""

    def check_smooths(self, *, several: bool = False) -> None:
        """Checks that the filter can be smoothed, if ``several`` over several sensors.

        Raises:
            NotImplementedError: it cannot, with the reason.
        """
        reason = self.smoothing or (self.smoothing_several if several else None)
        if reason is not None:
            raise NotImplementedError(reason)


class HasBelief(Protocol):
    """The state of a filter."""

    @property
    def belief(self) -> Gaussian:
        """The estimate."""
        ...


S = TypeVar("S", bound=HasBelief, default=Any)  # the states of a filter
P = ParamSpec("P")
R = TypeVar("R")


def in_full_precision(method: Callable[P, R]) -> Callable[P, R]:
    """A method in which ``torch.autocast`` is off: half precision is too coarse for covariance roots."""

    @wraps(method)
    def full(*arguments: P.args, **options: P.kwargs) -> R:
        if not (torch.is_autocast_enabled("cpu") or torch.is_autocast_enabled("cuda")):
            return method(*arguments, **options)
        with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
            return method(*arguments, **options)

    return full


class Recursion(Part, Generic[S]):
    """Abstract: the functions of a filter that a loop over steps calls.  ``Filter`` has what users call.

    Args:
        motion: how targets move; None for a filter around another one.
        sensor: what is measured; None for a filter around another one.
        rule: from a dimension to the rule that carries a Gaussian through a function.

    Raises:
        ValueError: the sensor reads more components than the motion's state has, or the rule is not callable.
    """

    scans = False
    """Whether a measurement is a scan ``(..., T, J, m)``, and beliefs are those of targets ``(..., N, n)``."""
    of_models = False
    """Whether an inner filter has the models of a bank as the last dimension of its batch."""
    limits = Limits()
    motion: Motion
    sensor: Sensor
    fading: Fading | None

    def __init__(
        self, motion: Motion | None = None, sensor: Sensor | None = None, rule: Callable[[int], Rule] = third_degree
    ) -> None:
        super().__init__()
        if torch.empty(0).is_meta:
            raise ValueError("device: expected one with memory to build a filter on, received torch's default of meta")
        if motion is None or sensor is None:
            return
        check_models(motion, sensor)
        if not callable(rule):
            raise ValueError(f"rule: expected torchfra.gaussian.third_degree or the like, received {rule!r}")
        self.motion, self.sensor = motion, sensor
        self.motion_rule = rule(motion.size)
        self.sensor_rule = self.motion_rule.marginal(sensor.reads)

    # ------------------------------------------------------------ three functions of a filter

    def begin(self, belief: Gaussian) -> S:
        """The state for a belief of full batch and triangular root; it has a ``belief``."""
        raise TypeError(f"{type(self).__name__} needs a begin")

    def advance(self, state: S, frame: Frame) -> tuple[S, Record]:
        """One step: the next state, and the record of the step.

        A filter inside of ``IMM`` has one more argument, ``mix``: a function that replaces the belief from which the
        step starts, or None.  By another ``frame.sensor`` than its own a filter neither uses nor changes what it knows
        of its own sensor's measurements.
        """
        raise TypeError(f"{type(self).__name__} needs an advance")

    def retreat(self, step: BackwardStep, after: Any) -> tuple[Any, Smoothed]:
        """One step of the backward pass: its next state, and the smoothed estimate of the step.

        The default is Rauch, Tung & Striebel (1965), with the prediction of the forward pass.  ``after`` is the state
        of the backward pass after the step; with a fixed lag it has one more dimension in front of the batch.
        """
        propagated = self.propagate(step.past.belief, step.frame, step.next.factor)
        smoothed = self.smooth_belief(step.past.belief, propagated, after)
        return smoothed.belief, smoothed

    def finish(self, state: S, belief: Gaussian, info: Any) -> tuple[Gaussian, Any]:
        """Beliefs ``(..., T, ...)`` and info of a sequence that ended in ``state``.

        A filter that decides a step by the next one adds the decision of the last step here.
        """
        return belief, info

    def past(self, belief: Gaussian, info: Any, state: S, steps: Any) -> Any:
        """The past for the backward pass: a tuple of ``(..., T, ...)`` tensors, such as a ``records.Past``.

        One with a method ``of_next`` says by it what ``retreat`` reads of the next step: all else is None.

        Args:
            belief: the estimates of ``forward``.
            info: the info of ``forward``.
            state: after the last step; None for a filter whose ``last`` is the default.
            steps: ``Record.past`` of all steps; None for such a filter.
        """
        return Past(belief, None, info=info)

    def last(self, past: Any) -> tuple[Any, Smoothed]:
        """Where the backward pass begins: its state at the last step, and the smoothed estimate there.

        The default is for a pass over beliefs, which an estimate holds; of a filter with one of its own ``Record.past``
        is kept too.
        """
        repairs = self.motion_rule.signed and not self.motion.linear
        repaired = torch.zeros_like(past.belief.mean[..., 0], dtype=torch.bool) if repairs else None
        return past.belief, Smoothed(past.belief, repaired=repaired)

    # ------------------------------------------------------------ to write a filter with

    def predicted(self, belief: Gaussian, frame: Frame) -> Prediction:
        """The belief one step later."""
        return predict(self.motion, self.motion_rule, belief, frame)

    def compare(self, belief: Gaussian, frame: Frame) -> Whitened:
        """Compares the measurement with a predicted belief."""
        sensor = frame.sensor
        rule = self.sensor_rule if sensor is self.sensor else self.motion_rule.marginal(sensor.reads)
        return compare(sensor, rule, belief, frame)

    def smooth_belief(self, belief: Gaussian, propagated: Propagated, after: Gaussian) -> Smoothed:
        """The smoothed ``belief``, from the smoothed belief ``after`` the step that has ``propagated`` it."""
        (mean, root), repaired = smooth_step(belief, propagated, after, self.motion.difference)
        repaired = None if repaired is None else repaired.expand(mean.shape[:-1])
        return Smoothed(Gaussian(self.motion.canonical(mean), root), repaired=repaired)

    def propagate(self, belief: Gaussian, frame: Frame, factor: Tensor | None = None) -> Propagated:
        """A belief propagated over a step, with the fading factor ``(...)`` of the forward pass, if any."""
        propagated = propagate(self.motion, self.motion_rule, belief, frame)
        if factor is None or self.fading is None:
            return propagated
        return propagated._replace(spread=self.fading.stretch(propagated.spread, factor))

    # ------------------------------------------------------------ where tracks begin

    def other_sensor(self, sensor: Sensor | None) -> Sensor | None:
        """A sensor that is not the filter's own, checked; None for its own, and for None.

        Raises:
            ValueError: no sensor, or a filter that takes its own sensor only, with the reason.
        """
        if sensor is None or sensor is self.sensor:
            return None
        check_models(self.motion, sensor)
        if self.limits.other_sensors is not None:
            raise ValueError(f"sensor: expected None, as {self.limits.other_sensors}, received {sensor.describe()}")
        self.check_noise(sensor, None)
        return sensor

    def check_noise(self, sensor: Sensor, noise: Tensor | None) -> None:
        """Checks roots ``(..., m, m)`` of noise, or that of another sensor; a filter may need what not all noise has.

        Raises:
            ValueError: it is not as the filter needs it.
        """

    @in_full_precision
    def init(self, prior: Gaussian) -> S:
        """The state before the first measurement.

        Args:
            prior: the belief one ``dt`` earlier, ``mean (..., n)`` and any root ``(..., n, n)``; its batch is that of
                the tracks to come.

        Raises:
            ValueError: a shape that does not fit.
        """
        n, (mean, root) = self.motion.size, check_belief(belief_of(prior), size=self.motion.size)
        batch = broadcast_shapes(mean.shape[:-1], root.shape[:-2], (1,) * max(batch_rank(self), int(self.scans)))
        mean = mean.resolve_neg().expand((*batch, n))  # torch makes no new tensor like one that is marked as negated
        begun: S = self.begin(Gaussian(mean, tria(root).expand((*batch, n, n))))  # Wang et al. (2021), eq. (7)
        return begun

    def _batch(self, measurements: Measurements, prior: Gaussian, name: str = "prior") -> torch.Size:
        """Checks arguments; their batch with that of the hyperparameters.  Messages call the prior ``name``."""
        sensor = measurements.sensor or self.sensor
        zero_dt = self.limits.zero_dt
        batch = check(measurements, prior, self.motion, sensor.size, scans=self.scans, name=name, zero_dt=zero_dt)
        if measurements.noise is not None:
            innermost(self).check_noise(sensor, measurements.noise)
        batches = value_batches(self)
        if batches and not torch.compiler.is_compiling():
            note_shared(self)
        if self.scans:  # targets, whose values may differ, are no part of the batch
            count = prior.mean.shape[-2]
            for path, values in batches.items():
                if values[-1] not in (1, count):
                    expected = f"a value for each of {count} targets or one for all"
                    raise ValueError(f"{path}: expected {expected}, received {tuple(values)}")
            batch = torch.Size((1,) * (batch_rank(self) - 1 - len(batch))) + batch
        else:
            batch = broadcast_with_values(batch, batches)
        warn_of_lost_digits(measurements, sensor, len(batch) + self.scans, scans=self.scans)
        warn_of_degrees(measurements.z, sensor)
        if name == "prior":
            mixture = isinstance(self.motion, Bank) and not self.scans
            warn_of_width(prior, measurements, sensor, mixture=mixture)
        return batch

    def _frames(self, measurements: Measurements, rank: int) -> tuple[list[Frame], Tensor]:
        """A frame for each step, and the log norms of the measurement noise, time first."""
        f = innermost(self)
        return make_frames(measurements, f.motion, measurements.sensor or f.sensor, rank)


def note_shared(f: Recursion) -> None:
    """Notes of each value over how many dimensions behind its tracks it is shared: parts may have been replaced."""
    shared = dict.fromkeys(hypers(f).values(), int(f.scans))  # all measurements share the values of their target
    layer = f
    while isinstance(inner := getattr(layer, "inner", None), Recursion):
        own = [part for part in inner.children() if part is not inner.motion and part is not inner.sensor]
        for hyper in {hyper for part in own if layer.of_models for hyper in hypers(part).values()}:
            shared[hyper] += 1  # all models share those of their track
        layer = inner
    for hyper, count in shared.items():
        if hyper.shared_dims != count:
            hyper.shared_dims = count


def innermost(f: Recursion) -> Recursion:
    """The innermost filter: the transition and process noise of its motion are in the frames, and its sensor."""
    while hasattr(f, "inner"):
        f = f.inner  # type: ignore[assignment]  # it is one
    return f
