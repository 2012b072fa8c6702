"""The square-root cubature Kalman filter and its three seams: a robust, an adaptive and a noise side."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.adaptive.fading import Fading, Memory
from torchfra.adaptive.noise import NoiseMemory, SageHusa
from torchfra.filters.base import Filter, Mix, Record
from torchfra.gaussian.cubature import third_degree
from torchfra.gaussian.inputs import Frame
from torchfra.gaussian.model import compare, count_repaired, predict
from torchfra.gaussian.rules import Rule
from torchfra.gaussian.update import correct, innovation, repaired_root
from torchfra.motion.base import Motion
from torchfra.robust.base import Robust
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian, Whitened


class State(NamedTuple):
    """A belief, and the memory of the innovations if the filter adapts."""

    belief: Gaussian
    memory: Memory | NoiseMemory | None


class Info(NamedTuple):
    """Per step; None for what the filter does not do."""

    weights: Tensor | None = None
    """``(..., T, m)`` of a robust filter."""
    fading: Tensor | None = None
    """``(..., T)`` factors of an adaptive one."""
    iterations: Tensor | None = None
    """``(..., T)`` of a robust side that iterates; as many as it may where it did not settle."""
    repaired: Tensor | None = None
    """``(..., T)`` covariances that were not positive and had to be mended; of rules with negative weights, or a robust
    side that may take off more than there is."""
    noise: Tensor | None = None
    """``(..., T, m)`` of a noise side: the estimated variances, as multiples of the nominal ones."""


class SRCKF(Filter):
    """Square-root cubature Kalman filter, optionally robust to outliers and adaptive to manoeuvres.

    Args:
        motion: how targets move; a linear motion is carried exactly, without points.
        sensor: what is measured.
        rule: from a number of states to the rule that carries a Gaussian through a function (``torchfra.cubature``).
        robust: what trusts a wild innovation less (``torchfra.robust``), at every step.
        adaptive: fading factors for the prediction, or an estimate of the measurement noise (``torchfra.adaptive``), at
            every step.

    ``Estimate.nis`` and ``log_likelihood`` judge the measurement before either side has acted, under the nominal noise,
    or under the noise as it was estimated before the step.

    Raises:
        ValueError: fading factors and a rule with negative weights; an estimate of the noise and a robust side, as one
            would explain away what the other looks at; or see ``Filter``.

    Source: Arasaratnam & Haykin (2009), "Cubature Kalman Filters"; Wang et al. (2021), sections 1-2, whose equation
    numbers stand in the code.  Differs: measurements count in units of their noise from (17) on, and (17), (20) and
    (22)-(24) are one triangularisation; both leave the result as it is.
    """

    def __init__(
        self,
        motion: Motion,
        sensor: Sensor,
        *,
        rule: Callable[[int], Rule] = third_degree,
        robust: Robust | None = None,
        adaptive: Fading | SageHusa | None = None,
    ) -> None:
        super().__init__(motion, sensor)
        whole = rule(motion.size)
        self.motion_rule, self.sensor_rule = whole, whole.marginal(sensor.reads)
        self.robust = robust
        self.adaptive = None if isinstance(adaptive, SageHusa) else adaptive
        self.noise = adaptive if isinstance(adaptive, SageHusa) else None
        if self.adaptive is not None and (self.motion_rule.signed or self.sensor_rule.signed):
            raise ValueError("rule: expected one without negative weights for an adaptive filter")
        if self.noise is not None and robust is not None:
            raise ValueError("robust: expected none beside an estimate of the noise, received both")
        if self.noise is not None and len(self.noise.element) != sensor.size:
            raise ValueError(
                f"blocks: expected those of a sensor of {sensor.size} elements, received {len(self.noise.element)}"
            )

    def begin(self, belief: Gaussian) -> State:
        """See ``Filter``."""
        if self.noise is not None:
            return State(belief, self.noise.begin(belief.mean))
        return State(belief, None if self.adaptive is None else self.adaptive.begin(belief.mean, self.sensor.size))

    def advance(self, state: State, frame: Frame, mix: Mix | None = None) -> tuple[State, Record]:
        """See ``Filter``."""
        state, record = self._advance(state, frame, mix)
        if not self.motion.angles:
            return state, record
        belief = record.belief._replace(mean=self.motion.canonical(record.belief.mean))
        return state._replace(belief=belief), record._replace(belief=belief)

    def _advance(self, state: State, frame: Frame, mix: Mix | None) -> tuple[State, Record]:
        start = state.belief if mix is None else mix(state.belief)
        prediction = predict(self.motion, self.motion_rule, start, frame)
        whitened = compare(self.sensor, self.sensor_rule, prediction.belief, frame)
        repaired = count_repaired(prediction.repaired, None if whitened.lost is None else repaired_root(whitened)[1])
        memory = state.memory
        if self.noise is not None and isinstance(memory, NoiseMemory):
            return self._estimating(self.noise, memory, prediction.belief, whitened, frame, repaired)
        if self.robust is None and self.adaptive is None:
            belief, root, normalised = correct(prediction.belief, whitened)
            info = Info(repaired=repaired)
            return State(belief, None), Record(belief, whitened.residual, root, normalised, info)
        root, normalised = innovation(whitened)
        residual, factor = whitened.residual, None
        weights = (
            torch.ones_like(residual) if self.robust is None else self.robust(residual, normalised.square().sum(-1))
        )
        if self.adaptive is not None and isinstance(memory, Memory):
            memory = self.adaptive.remember(memory, residual, frame.seen)
            factor = self.adaptive(prediction, whitened, memory, weights)
            prediction = self.adaptive.inflate(prediction, factor)  # eq. (29)
            whitened = compare(self.sensor, self.sensor_rule, prediction.belief, frame)
        if self.robust is None:
            belief, _, _ = correct(prediction.belief, whitened)
            return State(belief, memory), Record(belief, residual, root, normalised, Info(fading=factor))
        done = self.robust.correct(prediction.belief, whitened, weights, frame.measurement_noise)
        info = Info(done.weights, factor, done.iterations, count_repaired(repaired, done.repaired))
        evidence = None if mix is None else done.evidence
        return State(done.belief, memory), Record(done.belief, residual, root, normalised, info, evidence=evidence)

    def _estimating(
        self, noise: SageHusa, memory: NoiseMemory, predicted: Gaussian, whitened: Whitened, frame: Frame,
        repaired: Tensor | None,
    ) -> tuple[State, Record]:  # fmt: skip
        """The update with a noise side: Chen, Zou & Wu, eqs. (19)-(24)."""
        known, size = noise.known(whitened, memory, frame.seen)
        root, normalised = innovation(known)
        if noise.adapt == "innovation":
            memory = noise(memory, noise.excess(whitened), frame.seen)  # eq. (19)
            known, _ = noise.known(whitened, memory, frame.seen)
        belief, _, _ = correct(predicted, known)
        if noise.adapt == "residual":
            left = compare(self.sensor, self.sensor_rule, belief, frame)
            memory = noise(memory, noise.excess(left), frame.seen)
        info = Info(noise=memory.scale, repaired=repaired)
        return State(belief, memory), Record(belief, whitened.residual, size * root, normalised, info)
