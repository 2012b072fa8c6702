"""A forecast: the predicted state after a time step, and the predicted measurement."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfra.gaussian.inputs import Frame
from torchfra.gaussian.mixture import moment_match
from torchfra.gaussian.model import canonical
from torchfra.types import Gaussian


class Forecast(NamedTuple):
    """The prediction of a filter, with the moments of all its hypotheses: see ``Filter.predict``."""

    belief: Gaussian
    """``(..., n)`` the predicted state."""
    measurement: Gaussian
    """``(..., m)`` the predicted measurement, its noise included; angles are near that of the mean state."""


def forecast(f: Any, state: Any, frame: Frame) -> Forecast:
    """The prediction of a filter for a step.

    Args:
        f: the filter; ``predict_hypotheses`` and ``predict_innovation`` are called.
        state: before the step.
        frame: of the step, without a measurement.
    """
    beliefs, log_weights = f.predict_hypotheses(state, frame)
    belief = canonical(f.motion, _moments(beliefs, log_weights, f.motion.angles))
    z = frame.sensor.at_points(belief.mean, frame.u)
    noise = frame.sensor.measurement_noise(z)
    frame = frame._replace(z=z, measured=torch.ones_like(z), measurement_noise=noise)
    # The innovation of a measurement at the mean: the mean of z - h(x) over the hypotheses, and its root.
    if len(log_weights) > 1:  # a measurement that is as expected shows no jump
        _, log_weights = f.predict_hypotheses(state, frame)
    residual, root = _moments(f.predict_innovation(state, beliefs, frame), log_weights)
    offset = noise.colour(residual.unsqueeze(-1)).squeeze(-1)
    return Forecast(belief, Gaussian(z - offset, noise.colour(root)))


def _moments(beliefs: Gaussian, log_weights: Tensor, angles: Sequence[int] = ()) -> Gaussian:
    """The Gaussian with the moments of hypotheses ``(H, ...)``; ``angles`` are components that are angles."""
    if len(log_weights) > 1:
        return moment_match(beliefs, log_weights, angles)
    return Gaussian(beliefs.mean[0], beliefs.scale_tril[0])


def one_hypothesis(belief: Gaussian) -> tuple[Gaussian, Tensor]:
    """A belief ``(..., n)`` as the only hypothesis ``(1, ..., n)``, and the log of its weight."""
    mean, root = (x.unsqueeze(0) for x in belief)
    return Gaussian(mean, root), torch.zeros_like(mean[..., 0])
