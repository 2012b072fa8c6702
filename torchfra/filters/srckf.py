"""The square-root cubature Kalman filter and its two seams: a robust and an adaptive side."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchfra.adaptive import Fading, Memory
from torchfra.cubature import Rule, third_degree
from torchfra.filters.base import Filter, Mix, Record, density
from torchfra.filters.frames import Frame
from torchfra.linalg import apply, hstack, tria, whiten
from torchfra.motion import Motion
from torchfra.sensors import Sensor
from torchfra.types import Gaussian, Prediction, Whitened


class State(NamedTuple):
    """A belief, and the memory of the innovations if the filter adapts."""

    belief: Gaussian
    memory: Memory | None


class Info(NamedTuple):
    """Per step: ``weights (..., T, m)`` of a robust filter, ``fading (..., T)`` factors of an adaptive one, or None."""

    weights: Tensor | None
    fading: Tensor | None


class SRCKF(Filter):
    """Square-root cubature Kalman filter, optionally robust to outliers and adaptive to manoeuvres.

    Args:
        motion: how targets move; a linear motion is carried exactly, without points.
        sensor: what is measured.
        rule: from a number of states to the rule that carries a Gaussian through a function (``torchfra.cubature``).
        robust: weights for the elements of an innovation (``torchfra.robust``), applied at every step.
        adaptive: fading factors for the prediction (``torchfra.adaptive``), applied at every step.

    ``Estimate.nis`` and ``log_likelihood`` judge the measurement before either side has acted.

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
        robust: nn.Module | None = None,
        adaptive: Fading | None = None,
    ) -> None:
        super().__init__(motion, sensor)
        whole = rule(motion.size)
        self.motion_rule, self.sensor_rule = whole, whole.marginal(sensor.reads)
        self.robust, self.adaptive = robust, adaptive

    def begin(self, belief: Gaussian) -> State:
        """See ``Filter``."""
        return State(belief, None if self.adaptive is None else self.adaptive.begin(belief.mean, self.sensor.size))

    def advance(self, state: State, frame: Frame, mix: Mix | None = None) -> tuple[State, Record]:
        """See ``Filter``."""
        start = state.belief if mix is None else mix(state.belief)
        prediction = predict(self.motion, self.motion_rule, start, frame)
        whitened = compare(self.sensor, self.sensor_rule, prediction.belief, frame)
        if self.robust is None and self.adaptive is None:
            belief, root, normalised = correct(prediction.belief, whitened)
            return State(belief, None), Record(belief, whitened.residual, root, normalised, Info(None, None))
        root, normalised = innovation(whitened)
        weights = self.weigh(whitened, normalised)
        residual, memory, factor = whitened.residual, state.memory, None
        if self.adaptive is not None and memory is not None:
            memory = self.adaptive.remember(memory, residual, frame.seen)
            factor = self.adaptive(prediction, whitened, memory, weights)
            prediction = self.adaptive.inflate(prediction, factor)  # eq. (29)
            whitened = compare(self.sensor, self.sensor_rule, prediction.belief, frame)
        belief, trusted, own = correct(prediction.belief, trust(whitened, weights))
        info = Info(None if self.robust is None else weights, factor)
        evidence = None if mix is None else trusted_density(trusted, own, weights)
        return State(belief, memory), Record(belief, residual, root, normalised, info, evidence=evidence)

    def weigh(self, whitened: Whitened, normalised: Tensor) -> Tensor:
        """Robust weights ``(..., m)``; ones if nothing is robust."""
        if self.robust is None:
            return torch.ones_like(whitened.residual)
        weights: Tensor = self.robust(whitened.residual, normalised.square().sum(-1))
        return weights


def predict(motion: Motion, rule: Rule, belief: Gaussian, frame: Frame) -> Prediction:
    """Time update: eqs. (8)-(13)."""
    mean, root = belief
    if frame.transition is not None:
        shift, noise = frame.shift, frame.process
        if frame.adaptation is not None:
            shift, noise = frame.adaptation(mean, shift, noise)
        mean, spread = apply(frame.transition, mean), frame.transition @ root
        mean = mean if shift is None else mean + shift
    else:
        noise = frame.process
        u = None if frame.u is None else frame.u.unsqueeze(-2)
        mean, spread = rule(lambda x: motion(x, frame.dt.unsqueeze(-1), u), belief, torch.sub)
    return Prediction(Gaussian(mean, tria(hstack(spread, noise))), spread, noise)


def compare(sensor: Sensor, rule: Rule, belief: Gaussian, frame: Frame) -> Whitened:
    """The measurement against a predicted belief, in units of its noise: eqs. (14)-(21)."""
    d = sensor.reads
    u = None if frame.u is None else frame.u.unsqueeze(-2)
    seen = Gaussian(belief.mean[..., :d], belief.scale_tril[..., :d, :d])  # lower triangular: the marginal's root
    value, spread = rule(lambda x: sensor(x, u), seen, sensor.difference)
    residual = frame.noise.whiten(sensor.difference(frame.z, value).unsqueeze(-1)).squeeze(-1)
    return Whitened(residual, frame.noise.whiten(spread), d)


def innovation(whitened: Whitened) -> tuple[Tensor, Tensor]:
    """Root ``(..., m, m)`` of the residual's covariance and the residual ``(..., m)`` divided by it: (17), (35)."""
    m = whitened.residual.shape[-1]
    unit = torch.eye(m, dtype=whitened.spread.dtype, device=whitened.spread.device)
    root = tria(hstack(unit, whitened.spread))
    return root, whiten(root, whitened.residual)


def correct(belief: Gaussian, whitened: Whitened) -> tuple[Gaussian, Tensor, Tensor]:
    """The belief after the measurement, and the innovation's root and normalised residual: eqs. (17)-(24).

    ``tria([[I, rest, H S], [0, 0, S]]) = [[S_zz, 0], [K S_zz, S_post]]``.
    """
    residual, spread, d = whitened
    m, n = residual.shape[-1], belief.mean.shape[-1]
    unit = pad(torch.eye(m, dtype=residual.dtype, device=residual.device), (m + n, 0))  # behind what tria leads with
    top = hstack(unit, pad(spread, (0, n - d)))
    root = belief.scale_tril.expand((*top.shape[:-2], n, n))
    joint = tria(torch.cat([top, pad(root, (top.shape[-1] - n, 0))], -2), led=True)
    root = joint[..., :m, :m]
    normalised = whiten(root, residual)
    mean = belief.mean + apply(joint[..., m:, :m], normalised)
    return Gaussian(mean, joint[..., m:, m:]), root, normalised


def trust(whitened: Whitened, weights: Tensor) -> Whitened:
    """The measurement with its noise covariance divided by ``weights (..., m)``: eq. (26).

    Scaling the measurement down instead of its noise up lets a weight of 0 leave it out.
    """
    used = weights > 0
    scale = torch.where(used, torch.where(used, weights, 1.0).sqrt(), 0.0)
    return whitened._replace(residual=scale * whitened.residual, spread=scale.unsqueeze(-1) * whitened.spread)


def trusted_density(root: Tensor, normalised: Tensor, weights: Tensor) -> Tensor:
    """Log density ``(...)`` of a residual after ``trust`` with ``weights (..., m)``."""
    used = weights > 0
    return density(root, normalised) + 0.5 * torch.where(used, torch.where(used, weights, 1.0).log(), 0.0).sum(-1)
