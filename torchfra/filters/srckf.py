"""The square-root cubature Kalman filter, with a robust update, fading factors or an estimate of the noise."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.adaptive.fading import Fading, Memory
from torchfra.adaptive.noise import NoiseMemory, SageHusa
from torchfra.filters.base import Filter
from torchfra.filters.forecast import Forecast, as_expected, measurement
from torchfra.gaussian.cubature import third_degree
from torchfra.gaussian.inputs import Frame
from torchfra.gaussian.model import canonical, predict_and_compare, repairs
from torchfra.gaussian.rules import Rule
from torchfra.gaussian.update import correct, innovation
from torchfra.motion.base import Motion
from torchfra.robust.base import Corrected, Robust
from torchfra.sensors.base import Sensor
from torchfra.steps.checks import check_parts, check_weights
from torchfra.steps.records import Past, Record
from torchfra.steps.recursion import Limits, Mix
from torchfra.types import Gaussian, Prediction, Whitened


class State(NamedTuple):
    """A belief, and the memories of fading factors and of the noise estimate."""

    belief: Gaussian
    fading: Memory | None
    noise: NoiseMemory | None


class Info(NamedTuple):
    """Per step; each field is None for a filter without that part."""

    weights: Tensor | None = None
    """``(..., T, m)`` weights of a robust update."""
    fading: Tensor | None = None
    """``(..., T)`` fading factors."""
    iterations: Tensor | None = None
    """``(..., T)`` of a robust update that iterates; the maximum where it did not converge."""
    repaired: Tensor | None = None
    """``(..., T)`` number of covariances that were not positive definite and were repaired; for rules with negative
    weights."""
    noise: Tensor | None = None
    """``(..., T, m)`` estimated variances of the measurement noise, as multiples of the nominal ones."""


class SRCKF(Filter[State]):
    """Square-root cubature Kalman filter, optionally robust to outliers and adaptive to manoeuvres.

    Args:
        motion: how targets move; a linear motion is propagated exactly, without points.
        sensor: what is measured.
        rule: from a dimension to the rule that carries a Gaussian through a function (``torchfra.gaussian``).
        robust: robust update, which down-weights outlying innovations (``torchfra.robust``); None for the plain one.
        fading: factors that widen the prediction where the motion no longer holds (``torchfra.adaptive``); None for
            none.
        noise: an estimate of the measurement noise (``torchfra.adaptive``); None for the sensor's own.
        redraw: whether the measurement has points of its own, with the process noise in them; otherwise the points
            of the prediction go on through the sensor, as in some papers: the innovation then lacks the process noise.

    ``Estimate.nis`` and ``log_likelihood`` are those of the plain prediction under the nominal noise, or under the
    noise as estimated before the step.

    Raises:
        ValueError: fading factors and a rule with negative weights; an estimate of the noise beside fading factors or a
            robust update, as both would explain the same large innovations; without ``redraw``, fading factors or a
            rule with negative weights; or see ``Filter``.

    Source: Arasaratnam & Haykin (2009), "Cubature Kalman Filters"; Wang et al. (2021), sections 1-2, whose equation
    numbers stand in the code.  Differs: measurements are in units of their noise from (17) on, and (17), (20) and
    (22)-(24) are one triangularisation; neither changes the result.
    """

    def __init__(
        self,
        motion: Motion,
        sensor: Sensor,
        *,
        rule: Callable[[int], Rule] = third_degree,
        robust: Robust | None = None,
        fading: Fading | None = None,
        noise: SageHusa | None = None,
        redraw: bool = True,
    ) -> None:
        super().__init__(motion, sensor, rule)
        parts: dict[str, tuple[object, type]] = {
            "robust": (robust, Robust),
            "fading": (fading, Fading),
            "noise": (noise, SageHusa),
        }
        check_parts(**{name: part for name, part in parts.items() if part[0] is not None})
        self.robust, self.noise, self.redraw = robust, noise, redraw
        self.fading = None if fading is None else fading.for_motion(motion)
        if fading is not None:
            check_weights(self, " beside fading factors")
        others = [name for name, part in (("robust", robust), ("fading", fading)) if part is not None]
        if others and noise is not None:
            expected = "none beside an estimate of the measurement noise"
            raise ValueError(f"robust, fading: expected {expected}, received {' and '.join(others)}")
        if not redraw and (self.motion_rule.signed or fading is not None):
            beside = "a rule with negative weights" if self.motion_rule.signed else "fading factors"
            raise ValueError(f"redraw: expected True beside {beside}, received False")
        if noise is not None and len(noise.block_of) != sensor.size:
            count = len(noise.block_of)
            raise ValueError(f"blocks: expected those of a sensor of {sensor.size} elements, received {count}")
        if noise is not None:
            self.limits = Limits(other_sensors="the estimate of the measurement noise is of the elements of one sensor")

    def begin(self, belief: Gaussian) -> State:
        """The state of a belief, with empty memories."""
        noise = None if self.noise is None else self.noise.begin(belief.mean)
        fading = None if self.fading is None else self.fading.begin(belief.mean, self.sensor.size)
        return State(belief, fading, noise)

    def predicted(self, belief: Gaussian, frame: Frame) -> Prediction:
        """The belief one step later, by the root that a robust update needs."""
        prediction = super().predicted(belief, frame)
        return prediction if self.robust is None else self.robust.rooted(prediction)

    def faded(self, prediction: Prediction, factor: Tensor) -> Prediction:
        """The prediction with fading factors, by the root that a robust update needs."""
        assert self.fading is not None
        prediction = self.fading.inflate(prediction, factor)
        return prediction if self.robust is None else self.robust.rooted(prediction)

    def forecast(self, state: State, frame: Frame, *mix: Mix) -> Forecast:
        """The prediction of state and measurement, with the estimated noise."""
        before = mix[0](state.belief) if mix else state.belief
        belief = self.predicted(before, frame).belief
        seen = as_expected(frame, belief.mean)
        whitened = self.compare(belief, seen) if self.redraw else self.predict_and_compare(before, seen)[1]
        if self.noise is None or state.noise is None:
            root, _ = innovation(whitened)
        else:
            root, _ = innovation(self.noise.rescale(whitened, state.noise))
            root = self.noise.nominal(root, state.noise, seen.measured)
        return Forecast(canonical(self.motion, belief), measurement(seen, Gaussian(whitened.residual, root)))

    def past(self, belief: Gaussian, info: Info, state: object, steps: object) -> Past:
        """The past for the backward pass: beliefs, and the fading factors of the forward pass."""
        return Past(belief, info.fading)

    def predict_and_compare(self, belief: Gaussian, frame: Frame) -> tuple[Prediction, Whitened]:
        """The prediction of a step, and the measurement compared with it."""
        if not self.redraw:
            return predict_and_compare(self.motion, frame.sensor, self.motion_rule, belief, frame)
        prediction = self.predicted(belief, frame)  # (8)-(13)
        return prediction, self.compare(prediction.belief, frame)  # (14)-(21)

    def advance(self, state: State, frame: Frame, mix: Mix | None = None) -> tuple[State, Record]:
        """One step; equation numbers of Wang et al. (2021)."""
        prediction, whitened = self.predict_and_compare(state.belief if mix is None else mix(state.belief), frame)
        if self.noise is not None:
            return self.learn(self.noise, prediction, whitened, state, frame)
        if self.robust is not None or self.fading is not None:
            return self.update(prediction, whitened, state, frame)
        belief, root, normalised = correct(prediction.belief, whitened)  # (17)-(24)
        belief = canonical(self.motion, belief)
        info = Info(repaired=repairs(prediction, whitened, self.motion_rule))
        return State(belief, None, None), Record(belief, whitened.residual, root, normalised, info)

    def update(self, prediction: Prediction, whitened: Whitened, state: State, frame: Frame) -> tuple[State, Record]:
        """The update with robust weights or fading factors: Wang et al. (2021)."""
        root, normalised = innovation(whitened)  # (17), (35)
        weights, memory, factor = torch.ones_like(normalised), state.fading, None
        predicted, compared = prediction, whitened
        if self.robust is not None:
            weights = self.robust(whitened.residual, normalised.square().sum(-1))  # (25)
        if self.fading is not None and memory is not None:
            own = frame.sensor is self.sensor  # the memory has no innovations of another one
            known = memory if own else self.fading.begin(prediction.belief.mean, frame.sensor.size)
            known = self.fading.remember(known, whitened.residual, frame.measured)  # (31)
            memory = known if own else memory
            factor = self.fading(prediction, whitened, known, weights)  # (32)-(34)
            predicted = self.faded(prediction, factor)  # (29)
            compared = self.compare(predicted.belief, frame)
        if self.robust is None:
            corrected = Corrected(correct(predicted.belief, compared)[0], None)
        else:
            corrected = self.robust.correct(predicted.belief, compared, weights, frame.measurement_noise)  # (26)
        belief = canonical(self.motion, corrected.belief)
        repaired = repairs(prediction, whitened, self.motion_rule)
        info = Info(corrected.weights, factor, corrected.iterations, repaired)
        record = Record(belief, whitened.residual, root, normalised, info, evidence=corrected.evidence)
        return State(belief, memory, None), record

    def learn(
        self, noise: SageHusa, prediction: Prediction, whitened: Whitened, state: State, frame: Frame
    ) -> tuple[State, Record]:
        """The update with an estimate of the noise: Chen, Zou & Wu."""
        assert state.noise is not None
        root, normalised = innovation(noise.rescale(whitened, state.noise))
        memory = noise.learn(state.noise, whitened, frame.measured, "innovation")  # (19)
        belief, _, _ = correct(prediction.belief, noise.rescale(whitened, memory))
        if noise.adapt == "residual":
            memory = noise.learn(memory, self.compare(belief, frame), frame.measured, "residual")
        belief, root = canonical(self.motion, belief), noise.nominal(root, state.noise, frame.measured)
        info = Info(repaired=repairs(prediction, whitened, self.motion_rule), noise=noise.scale(memory))
        return State(belief, None, memory), Record(belief, whitened.residual, root, normalised, info)
