"""Filters of tracks: one target, whose measurements are known to be its own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torchfra.adaptive.fading import NoFading
from torchfra.filters.ahead import Ahead, look_ahead
from torchfra.filters.base import Filter, S
from torchfra.filters.checks import check_state
from torchfra.filters.precision import in_full_precision
from torchfra.filters.records import Record, Smoothed, scores
from torchfra.gaussian.cubature import third_degree
from torchfra.gaussian.inputs import BackwardStep, Frame, Measurements, Time, make_frames
from torchfra.gaussian.model import Carried, compare, predict, propagate
from torchfra.gaussian.rules import Rule
from torchfra.gaussian.smoothing import reverse
from torchfra.gaussian.update import innovation
from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian, Innovation, Prediction, Whitened


class Past(NamedTuple):
    """What the way back needs of a step; ``(..., T, ...)`` of a whole track."""

    belief: Gaussian
    """As it was carried on."""
    factor: Tensor | None
    """``(...)`` fading factor of the prediction that led to it."""
    fresh: tuple[Gaussian, Tensor] | None = None
    """Both as they were at the step itself, of a filter that decides late."""


class TrackFilter(Filter[S]):
    """Abstract: measurements ``z (..., T, m)``, beliefs ``(..., n)``."""

    mixes = False
    """Whether ``advance`` starts from what its ``mix`` makes of a belief, as filters inside of ``IMM`` have to."""

    @in_full_precision
    def predict(self, state: Any, dt: Time, *, u: Tensor | None = None, sensor: Sensor | None = None) -> Ahead:
        """What is expected after ``dt`` seconds, without a measurement; it runs interpreted.

        Of several models or hypotheses it has the moments.  ``FRA`` looks ahead from its provisional estimate, ``GPB``
        counts on manoeuvres that may begin.

        Args:
            state: from ``init`` or ``step``; it is not changed.
            dt: seconds from there, 0 or more, a number or ``(...)``.
            u: ``(..., k)`` what the models need to know then.
            sensor: whose measurement is expected, if it is not the filter's own.

        Returns:
            The state's mean and root, and those of a measurement.

        Raises:
            ValueError: a shape or a value that does not fit.
        """
        f = self.with_sensor(sensor)
        check_state(f, state)
        mean = state.belief.mean
        nothing = mean.new_full((*mean.shape[:-1], f.sensor.size), torch.nan)
        return look_ahead(f, state, f._frame(state, Measurements(nothing, dt, u)))

    def predict_hypotheses(self, state: Any, frame: Frame) -> tuple[Gaussian, Tensor]:
        """Hypotheses ``(K, ..., n)`` of the state after a step, and logs ``(K, ...)`` of their weights."""
        raise TypeError(f"{type(self).__name__} needs a predict_hypotheses and a predict_innovation to predict")

    def predict_innovation(self, state: Any, beliefs: Gaussian, frame: Frame) -> Gaussian:
        """What is measured, less what hypotheses ``(K, ..., n)`` expect: ``(K, ..., m)`` in units of the noise."""
        raise TypeError(f"{type(self).__name__} needs a predict_hypotheses and a predict_innovation to predict")

    def _frames(self, measurements: Measurements, rank: int) -> tuple[list[Frame], Tensor]:
        """A frame for each step, and the log norms of the measurement noise, time first."""
        return make_frames(measurements, self.motion, self.sensor, rank)

    def _scores(self, record: Record, log_norm: Tensor) -> tuple[Tensor, Tensor]:
        """Normalised innovation squared and log likelihood."""
        return scores(record.normalised, record.root, log_norm, record.density)

    def innovation_of(self, record: Record, frame: Frame) -> Innovation:
        """What the measurement of a step said, in its own units."""
        noise = frame.measurement_noise
        assert record.residual is not None
        residual, root = noise.colour(record.residual.unsqueeze(-1)).squeeze(-1), noise.colour(record.root)
        return Innovation(residual, root, *self._scores(record, noise.log_norm))


class GaussianFilter(TrackFilter[S]):
    """Abstract: carries a Gaussian through motion and sensor by a rule.

    Args:
        motion: how targets move; a linear motion is carried exactly, without points.
        sensor: what is measured.
        rule: from a number of states to the rule (``torchfra.gaussian``).
    """

    fading: NoFading

    def __init__(self, motion: Motion, sensor: Sensor, rule: Callable[[int], Rule] = third_degree) -> None:
        super().__init__(motion, sensor)
        if not callable(rule):
            raise ValueError(f"rule: expected torchfra.gaussian.third_degree or the like, received {rule!r}")
        self.motion_rule = rule(motion.size)
        self.sensor_rule = self.motion_rule.marginal(sensor.reads)

    def parts_for(self, sensor: Sensor) -> dict[str, nn.Module]:
        """Its parts, by name, that are others around another sensor."""
        return {"sensor": sensor, "sensor_rule": self.motion_rule.marginal(sensor.reads)}  # type: ignore[dict-item]

    @property
    def signed(self) -> bool:
        """Whether some weights of the rule are negative, so that covariances may need repair."""
        return self.motion_rule.signed or self.sensor_rule.signed

    def predicted(self, belief: Gaussian, frame: Frame) -> Prediction:
        """The belief one step later."""
        return predict(self.motion, self.motion_rule, belief, frame)

    def compare(self, belief: Gaussian, frame: Frame) -> Whitened:
        """The measurement against a predicted belief."""
        return compare(self.sensor, self.sensor_rule, belief, frame)

    def predict_hypotheses(self, state: Any, frame: Frame) -> tuple[Gaussian, Tensor]:
        """The only hypothesis of the state after a step, and the log of its weight."""
        belief = self.predicted(state.belief, frame).belief
        mean, root = (x.unsqueeze(0) for x in belief)
        return Gaussian(mean, root), torch.zeros_like(mean[..., 0])

    def predict_innovation(self, state: Any, beliefs: Gaussian, frame: Frame) -> Gaussian:
        """What is measured, less what hypotheses ``(K, ..., n)`` expect: ``(K, ..., m)`` in units of the noise."""
        whitened = self.compare(beliefs, frame)
        return Gaussian(whitened.residual, innovation(whitened)[0])

    def past(self, belief: Gaussian, info: Any, state: Any, steps: Any) -> Past:
        """What the way back needs: beliefs, and the fading factors that were chosen."""
        return Past(belief, info.fading)

    def fresh(self, past: Past) -> Past:
        """The past of a step as it was at the step itself."""
        return past if past.fresh is None else Past(*past.fresh)

    def decided(self, past: Past) -> Past:
        """The past of a last step, of which no later measurement will decide anything."""
        return past._replace(fresh=None)

    def needed_ahead(self, past: Past) -> Past:
        """The fading factor."""
        return past._replace(belief=None, fresh=None)  # type: ignore[arg-type]  # which nothing reads

    def last(self, past: Past) -> tuple[Gaussian, Smoothed]:
        """The last step, which no later measurement speaks of."""
        repaired = torch.zeros_like(past.belief.mean[..., 0], dtype=torch.bool) if self._may_repair else None
        return past.belief, Smoothed(past.belief, repaired=repaired)

    def smooth_step(self, step: BackwardStep, after: Gaussian) -> tuple[Gaussian, Smoothed]:
        """One step back: Rauch, Tung & Striebel (1965) through the prediction as it was made."""
        ahead = self.carry(step.past.belief, step.frame, step.ahead.factor)
        told = self.reverse(step.past.belief, ahead, after)
        return told.belief, told

    def reverse(self, belief: Gaussian, ahead: Carried, after: Gaussian) -> Smoothed:
        """A ``belief`` that was carried ``ahead``, smoothed by the smoothed one ``after`` the step."""
        step = reverse(belief, ahead)
        mean, root = step(after, self.motion.difference)
        repaired = None if step.repaired is None else step.repaired.expand(mean.shape[:-1])
        return Smoothed(Gaussian(self.motion.canonical(mean), root), repaired=repaired)

    def carry(self, belief: Gaussian, frame: Frame, factor: Tensor | None) -> Carried:
        """A belief carried over a step, with the fading factor ``(...)`` that was chosen."""
        ahead = propagate(self.motion, self.motion_rule, belief, frame)
        return ahead if factor is None else ahead._replace(spread=self.fading.stretch(ahead.spread, factor))

    @property
    def _may_repair(self) -> bool:
        """Whether a step back may have to repair a covariance."""
        return self.motion_rule.signed and not self.motion.linear
