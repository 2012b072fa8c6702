"""The square-root cubature Kalman filter, with a robust update, fading factors or an estimate of the noise."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from torch import Tensor, nn

from torchfra.adaptive.fading import Memory, NoFading
from torchfra.adaptive.noise import NoiseMemory, NominalNoise, SageHusa
from torchfra.filters.base import Filter, Mix
from torchfra.filters.checks import check_parts
from torchfra.filters.forecast import one_hypothesis
from torchfra.filters.records import Past, Record
from torchfra.gaussian.cubature import third_degree
from torchfra.gaussian.inputs import Frame
from torchfra.gaussian.model import add_counts, canonical, repairs
from torchfra.gaussian.rules import Rule
from torchfra.gaussian.update import correct, innovation
from torchfra.motion.base import Motion
from torchfra.robust.base import Robust
from torchfra.sensors.base import Sensor
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
    weights, or a robust update that may subtract too much."""
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

    ``Estimate.nis`` and ``log_likelihood`` are those of the plain prediction under the nominal noise, or under the
    noise as estimated before the step.

    Raises:
        ValueError: fading factors and a rule with negative weights; an estimate of the noise beside fading factors or a
            robust update, as both would explain the same large innovations; or see ``Filter``.

    Source: Arasaratnam & Haykin (2009), "Cubature Kalman Filters"; Wang et al. (2021), sections 1-2, whose equation
    numbers stand in the code.  Differs: measurements are in units of their noise from (17) on, and (17), (20) and
    (22)-(24) are one triangularisation; neither changes the result.
    """

    mixes = True

    def __init__(
        self,
        motion: Motion,
        sensor: Sensor,
        *,
        rule: Callable[[int], Rule] = third_degree,
        robust: Robust | None = None,
        fading: NoFading | None = None,
        noise: NominalNoise | None = None,
    ) -> None:
        super().__init__(motion, sensor, rule)
        self.robust = Robust() if robust is None else robust
        self.fading = NoFading() if fading is None else fading
        self.noise = NominalNoise() if noise is None else noise
        check_parts(robust=(self.robust, Robust), fading=(self.fading, NoFading), noise=(self.noise, NominalNoise))
        self.fading = self.fading.for_motion(motion)
        if self.signed and not self.fading.plain:
            raise ValueError(
                "rule: expected one without negative weights beside fading factors, received one with some"
            )
        others = [name for name in ("robust", "fading") if not getattr(self, name).plain]
        if others and not self.noise.plain:
            expected = "none beside an estimate of the measurement noise"
            raise ValueError(f"robust, fading: expected {expected}, received {' and '.join(others)}")
        if isinstance(self.noise, SageHusa) and len(self.noise.block_of) != sensor.size:
            count = len(self.noise.block_of)
            raise ValueError(f"blocks: expected those of a sensor of {sensor.size} elements, received {count}")

    @property
    def plain(self) -> bool:
        """Whether the filter has none of the three parts."""
        parts = self._modules  # every step reads this, and attributes of a module are slow
        return bool(parts["robust"].plain and parts["fading"].plain and parts["noise"].plain)  # type: ignore[union-attr]

    def begin(self, belief: Gaussian) -> State:
        """The state of a belief, with empty memories."""
        return State(belief, self.fading.begin(belief.mean, self.sensor.size), self.noise.begin(belief.mean))

    def parts_for(self, sensor: Sensor) -> dict[str, nn.Module]:
        """The parts, by name, that differ around another sensor.

        Raises:
            ValueError: the filter estimates the measurement noise.
        """
        if not self.noise.plain:
            raise ValueError(
                "sensor: expected None beside an estimate of the measurement noise, which is of the elements of the "
                f"filter's own sensor, received {sensor.describe()}"
            )
        return super().parts_for(sensor)

    def without_memory(self, state: State) -> State:
        """A state with an empty memory of innovations."""
        return state._replace(fading=self.fading.begin(state.belief.mean, self.sensor.size))

    def with_memory_of(self, state: State, before: State) -> State:
        """A state with the memory of innovations of the state ``before``."""
        return state._replace(fading=before.fading)

    def predict_hypotheses(self, state: State, frame: Frame) -> tuple[Gaussian, Tensor]:
        """The only hypothesis of the state after a step, and the log of its weight."""
        return one_hypothesis(self.predicted(state.belief, frame).belief)

    def predict_innovation(self, state: State, beliefs: Gaussian, frame: Frame) -> Gaussian:
        """The innovation ``(H, ..., m)`` of hypotheses ``(H, ..., n)`` under the estimated noise, in nominal units."""
        whitened = self.compare(beliefs, frame)
        root, _ = innovation(self.noise.rescale(whitened, state.noise))
        return Gaussian(whitened.residual, self.noise.nominal(root, state.noise, frame.measured))

    def past(self, belief: Gaussian, info: Info, state: Any, steps: Any) -> Past:
        """The past for the backward pass: beliefs, and the fading factors of the forward pass."""
        return Past(belief, info.fading)

    def advance(self, state: State, frame: Frame, mix: Mix | None = None) -> tuple[State, Record]:
        """One step; equation numbers of Wang et al. (2021)."""
        prediction = self.predicted(state.belief if mix is None else mix(state.belief), frame)  # (8)-(13)
        whitened = self.compare(prediction.belief, frame)  # (14)-(21)
        if not self.plain:
            return self.update(prediction, whitened, state, frame)
        belief, root, normalised = correct(prediction.belief, whitened)  # (17)-(24)
        belief = canonical(self.motion, belief)
        info = Info(repaired=repairs(prediction, whitened, self.motion_rule))
        return State(belief, None, None), Record(belief, whitened.residual, root, normalised, info)

    def update(self, prediction: Prediction, whitened: Whitened, state: State, frame: Frame) -> tuple[State, Record]:
        """The update with robust weights, fading factors or a noise estimate: Wang et al. (2021); Chen, Zou & Wu."""
        rescaled = self.noise.rescale(whitened, state.noise)
        root, normalised = innovation(rescaled)  # (17), (35)
        weights = self.robust(rescaled.residual, normalised.square().sum(-1))  # (25)
        noise = self.noise.learn(state.noise, whitened, frame.measured, "innovation")  # Chen, Zou & Wu (19)
        rescaled = self.noise.rescale(whitened, noise)
        faded, rescaled, memory, factor = self.fade(prediction, rescaled, state.fading, weights, frame)  # (29)-(34)
        corrected = self.robust.correct(faded.belief, rescaled, weights, frame.measurement_noise)  # (26), (17)-(24)
        if self.noise.adapt == "residual":
            noise = self.noise.learn(noise, self.compare(corrected.belief, frame), frame.measured, "residual")
        belief = canonical(self.motion, corrected.belief)
        repaired = add_counts(repairs(prediction, whitened, self.motion_rule), corrected.repaired)
        info = Info(corrected.weights, factor, corrected.iterations, repaired, self.noise.scale(noise))
        root = self.noise.nominal(root, state.noise, frame.measured)
        record = Record(belief, whitened.residual, root, normalised, info, evidence=corrected.evidence)
        return State(belief, memory, noise), record

    def fade(
        self, prediction: Prediction, whitened: Whitened, memory: Memory | None, weights: Tensor, frame: Frame
    ) -> tuple[Prediction, Whitened, Memory | None, Tensor | None]:
        """Prediction and measurement with fading factors, the memory of innovations, and the factors ``(...)``."""
        memory = self.fading.remember(memory, whitened.residual, frame.measured)  # (31)
        factor = self.fading(prediction, whitened, memory, weights)  # (32)-(34)
        if factor is None:
            return prediction, whitened, memory, None
        prediction = self.fading.inflate(prediction, factor)  # (29)
        return prediction, self.compare(prediction.belief, frame), memory, factor
