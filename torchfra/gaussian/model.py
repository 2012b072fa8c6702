"""Predict and compare: what all Gaussian filters share."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.gaussian.inputs import Frame
from torchfra.gaussian.rules import Rule
from torchfra.gaussian.update import repaired_root
from torchfra.linalg.gram import downdate
from torchfra.linalg.triangular import apply, hstack, tria
from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian, Prediction, Whitened


def repairs(prediction: Prediction, whitened: Whitened) -> Tensor | None:
    """How many covariances ``(...)`` of a step had to be repaired; None for rules that never need it."""
    measured = None if whitened.lost is None else repaired_root(whitened)[1]
    return add_counts(prediction.repaired, measured)


def add_counts(*counts: Tensor | None) -> Tensor | None:
    """The sum of counts, or of truth values, that are there; None of none."""
    there = [x.to(torch.int64) for x in counts if x is not None]
    return sum(there[1:], there[0]) if there else None


def predict(motion: Motion, rule: Rule, belief: Gaussian, frame: Frame) -> Prediction:
    """Time update: eqs. (8)-(13)."""
    mean, spread, noise, lost = propagate(motion, rule, belief, frame)
    if lost is None:
        return Prediction(Gaussian(mean, tria(hstack(spread, noise))), spread, noise)
    root, repaired = downdate(tria(hstack(spread, noise)), lost)
    return Prediction(Gaussian(mean, root), spread, noise, repaired)


def propagate(
    motion: Motion, rule: Rule, belief: Gaussian, frame: Frame
) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    """The predicted mean ``(..., n)``, and what its covariance is made of.

    Columns ``(..., n, p)`` of what was uncertain before, ``(..., n, q)`` of the process noise, and ``(..., n, k)`` of
    what a rule with negative weights takes off.
    """
    mean, root = belief
    if frame.transition is not None:
        shift, noise = frame.shift, frame.process_noise
        if frame.adaptation is not None:
            shift, noise = frame.adaptation(mean, shift, noise)
        mean, spread = apply(frame.transition, mean), frame.transition @ root
        return mean if shift is None else mean + shift, spread, noise, None
    mean, spread, lost = rule(lambda x: motion.at_points(x, frame.dt, frame.u), belief, motion.difference)
    return mean, spread, motion.process_noise_at(frame.process_noise, mean), lost


def compare(sensor: Sensor, rule: Rule, belief: Gaussian, frame: Frame) -> Whitened:
    """The measurement against a predicted belief, in units of its noise: eqs. (14)-(21)."""
    d, noise = sensor.reads, frame.measurement_noise
    seen = Gaussian(belief.mean[..., :d], belief.scale_tril[..., :d, :d])  # lower triangular: the marginal's root
    value, spread, lost = rule(lambda x: sensor.at_points(x, frame.u), seen, sensor.difference)
    residual = noise.whiten(sensor.difference(frame.z, value).unsqueeze(-1)).squeeze(-1)
    return Whitened(residual, noise.whiten(spread), d, lost if lost is None else noise.whiten(lost))
