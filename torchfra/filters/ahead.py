"""A look ahead: what a filter expects, without a measurement."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfra.gaussian.inputs import Frame
from torchfra.gaussian.mixture import moment_match
from torchfra.gaussian.model import canonical
from torchfra.types import Gaussian


class Ahead(NamedTuple):
    """What is expected, of all hypotheses together: see ``Filter.predict``."""

    belief: Gaussian
    """``(..., n)`` of the state."""
    measurement: Gaussian
    """``(..., m)`` of a measurement of it, its noise included; angles are near that of the mean state."""


def look_ahead(f: Any, state: Any, frame: Frame) -> Ahead:
    """What a filter expects after a step.

    Args:
        f: gives hypotheses by ``predict_hypotheses``, and measurements of them by ``predict_innovation``.
        state: before the step.
        frame: of the step, with nothing measured.
    """
    beliefs, log_weights = f.predict_hypotheses(state, frame)
    belief = _together(beliefs, log_weights, f.motion.angles)
    belief = canonical(f.motion, belief)
    z = f.sensor.at_points(belief.mean, frame.u)
    noise = f.sensor.measurement_noise(z)
    expected = frame._replace(z=z, measured=torch.ones_like(z), measurement_noise=noise)
    residual, root = _together(f.predict_innovation(state, beliefs, expected), log_weights)
    apart = noise.colour(residual.unsqueeze(-1)).squeeze(-1)
    return Ahead(belief, Gaussian(z - apart, noise.colour(root)))


def _together(beliefs: Gaussian, log_weights: Tensor, angles: Sequence[int] = ()) -> Gaussian:
    """One Gaussian for hypotheses ``(K, ...)`` whose components are ``angles`` here and there."""
    if len(log_weights) > 1:
        return moment_match(beliefs, log_weights, angles)
    return Gaussian(beliefs.mean[0], beliefs.scale_tril[0])


def only(belief: Gaussian) -> tuple[Gaussian, Tensor]:
    """A belief ``(..., n)`` as the only hypothesis ``(1, ..., n)``, and the log of its weight."""
    mean, root = (x.unsqueeze(0) for x in belief)
    return Gaussian(mean, root), torch.zeros_like(mean[..., 0])
