"""Prediction of a belief, and comparison of a measurement with it.

Equation numbers are those of Wang et al. (2021).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.gaussian.inputs import Frame
from torchfra.gaussian.rules import Rule
from torchfra.gaussian.update import repaired_root
from torchfra.linalg.gram import downdate
from torchfra.linalg.triangular import apply, hstack, tria
from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.tree import event_ranks
from torchfra.types import Gaussian, Prediction, Whitened


def repairs(prediction: Prediction, whitened: Whitened, rule: Rule) -> Tensor | None:
    """Number ``(...)`` of covariances of a step that were repaired; None for a ``rule`` without negative weights.

    It is 0, not None, if only the rule of the components that the sensor reads has no negative weights: then all
    sensors of a filter have a number.
    """
    if not (rule.signed or prediction.repaired is not None or whitened.subtracted is not None):
        return None
    measured = None if whitened.subtracted is None else repaired_root(whitened)[1]
    if rule.signed and measured is None and prediction.repaired is None:
        measured = torch.zeros_like(whitened.residual[..., 0], dtype=torch.bool)
    return add_counts(prediction.repaired, measured)


def add_counts(*counts: Tensor | None) -> Tensor | None:
    """The sum of the counts, or truth values, that are not None; None if all are."""
    given = [x.to(torch.int64) for x in counts if x is not None]
    return sum(given[1:], given[0]) if given else None


@event_ranks(mean=1, spread=2, process_noise=2, subtracted=2)
class Propagated(NamedTuple):
    """A belief propagated through a motion.

    ``P = spread spread^T + process_noise process_noise^T - subtracted subtracted^T``.
    """

    mean: Tensor
    """``(..., n)``."""
    spread: Tensor
    """``(..., n, r)`` root of the propagated part of the covariance; its last ``n`` columns are ``F S``."""
    process_noise: Tensor
    """``(..., n, r)`` root of the process noise."""
    subtracted: Tensor | None
    """``(..., n, k)`` root of what a rule with negative weights subtracts."""

    def belief(self, *, triangular: bool = True) -> tuple[Gaussian, Tensor | None]:
        """The prediction, and ``(...)`` bool whether its covariance was repaired; None if nothing is subtracted.

        If not ``triangular`` and nothing is subtracted, its root is ``(..., n, r)``, whose columns may be of any scale.
        """
        root = hstack(self.spread, self.process_noise)
        if self.subtracted is None:
            return Gaussian(self.mean, tria(root) if triangular else root), None
        root, repaired = downdate(tria(root), self.subtracted)
        return Gaussian(self.mean, root), repaired


def canonical(motion: Motion, belief: Gaussian) -> Gaussian:
    """The belief with its angles in the range that the motion uses."""
    return belief._replace(mean=motion.canonical(belief.mean))


def predict(motion: Motion, rule: Rule, belief: Gaussian, frame: Frame) -> Prediction:
    """Time update: eqs. (8)-(13)."""
    propagated = propagate(motion, rule, belief, frame)
    after, repaired = propagated.belief()
    return Prediction(after, propagated.spread, propagated.process_noise, repaired)


def predict_and_compare(
    motion: Motion, sensor: Sensor, rule: Rule, belief: Gaussian, frame: Frame
) -> tuple[Prediction, Whitened]:
    """``predict`` and ``compare`` by one set of points: the predicted ones go through the sensor as they are.

    ``tria([[X, S_Q], [Z, 0]]) = [[S, 0], [H S, rest]]``, with the spreads X of the state and Z of the measurement.

    Source: Chen, Zou & Wu, eqs. (11)-(18).
    """
    n, d, noise = motion.size, sensor.reads, frame.measurement_noise
    frame = adapted(frame, belief.mean)

    def through(x: Tensor) -> Tensor:
        if frame.transition is None:
            after = motion.at_points(x, frame.dt, frame.u)
        else:
            after = apply(frame.transition, x) if frame.shift is None else apply(frame.transition, x) + frame.shift
        rows = hstack(after.unsqueeze(-2), sensor.at_points(after[..., :d], frame.u).unsqueeze(-2))
        return rows.squeeze(-2)

    def difference(a: Tensor, b: Tensor) -> Tensor:
        return torch.cat([motion.difference(a[..., :n], b[..., :n]), sensor.difference(a[..., n:], b[..., n:])], -1)

    value, spread, _ = rule(through, belief, difference)
    mean, z = value[..., :n], value[..., n:]
    process_noise = frame.process_noise
    if frame.transition is None:
        process_noise = motion.process_noise_at(process_noise, mean, frame.dt)
    below = process_noise.new_zeros(*process_noise.shape[:-2], sensor.size, process_noise.shape[-1])
    root = tria(hstack(spread, torch.cat([process_noise, below], -2)))
    prediction = Prediction(Gaussian(mean, root[..., :n, :n]), spread[..., :n, :], process_noise)
    residual = noise.whiten(sensor.difference(frame.z, z).unsqueeze(-1)).squeeze(-1)
    whitened = Whitened(residual, noise.whiten(hstack(root[..., n:, n:], root[..., n:, :n])), n)
    return prediction, whitened


def propagate(motion: Motion, rule: Rule, belief: Gaussian, frame: Frame) -> Propagated:
    """The predicted mean and the parts of its covariance."""
    mean, root = belief
    transition = frame.transition
    if transition is not None:
        frame = frame if frame.adaptation is None else adapted(frame, mean)
        mean, spread = apply(transition, mean), transition @ root
        return Propagated(mean if frame.shift is None else mean + frame.shift, spread, frame.process_noise, None)
    mean, spread, subtracted = rule(lambda x: motion.at_points(x, frame.dt, frame.u), belief, motion.difference)
    return Propagated(mean, spread, motion.process_noise_at(frame.process_noise, mean, frame.dt), subtracted)


def adapted(frame: Frame, mean: Tensor) -> Frame:
    """The frame with shift and process noise at the ``mean (..., n)`` before a step, if its motion adapts them."""
    if frame.transition is None or frame.adaptation is None:
        return frame
    shift, noise = frame.adaptation(mean, frame.shift, frame.process_noise)
    return frame._replace(shift=shift, process_noise=noise, adaptation=None)


def compare(sensor: Sensor, rule: Rule, belief: Gaussian, frame: Frame) -> Whitened:
    """Compares the measurement with a predicted belief, in units of the noise: eqs. (14)-(21)."""
    (mean, root), d, noise = belief, sensor.reads, frame.measurement_noise
    if sensor.linear:  # every rule is exact
        value, spread, subtracted = sensor(mean), sensor(root[..., :d].mT).mT, None
    else:
        read = Gaussian(mean[..., :d], root[..., :d, :d])  # lower triangular: the marginal's root
        value, spread, subtracted = rule(lambda x: sensor.at_points(x, frame.u), read, sensor.difference)
    residual = noise.whiten(sensor.difference(frame.z, value).unsqueeze(-1)).squeeze(-1)
    return Whitened(residual, noise.whiten(spread), d, subtracted if subtracted is None else noise.whiten(subtracted))
