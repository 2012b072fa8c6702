"""A forecast: the predicted state after a time step, and the predicted measurement; and what makes one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.gaussian.inputs import Frame
from torchfra.gaussian.mixture import moment_match
from torchfra.gaussian.model import canonical
from torchfra.gaussian.update import innovation
from torchfra.steps.recursion import Recursion
from torchfra.types import Gaussian


class Forecast(NamedTuple):
    """The prediction of a filter, with the moments of all its hypotheses: see ``Filter.predict``."""

    belief: Gaussian
    """``(..., n)`` the predicted state."""
    measurement: Gaussian
    """``(..., m)`` the predicted measurement, its noise included; angles are near that of the mean state."""


def moments(beliefs: Gaussian, log_weights: Tensor, angles: Sequence[int] = ()) -> Gaussian:
    """The Gaussian with the moments of hypotheses ``(H, ...)``; ``angles`` are components that are angles."""
    if len(log_weights) > 1:
        return moment_match(beliefs, log_weights, angles)
    return Gaussian(beliefs.mean[0], beliefs.scale_tril[0])


def as_expected(frame: Frame, mean: Tensor) -> Frame:
    """The frame with the measurement that is expected of a state ``mean (..., n)``, under the sensor's noise."""
    z = frame.sensor.at_points(mean, frame.u)
    return frame._replace(z=z, measured=torch.ones_like(z), measurement_noise=frame.sensor.measurement_noise(z))


def forecast_by(f: Recursion, belief: Gaussian, frame: Frame) -> Forecast:
    """The forecast of a filter by its predicted belief alone."""
    seen = as_expected(frame, belief.mean)
    whitened = f.compare(belief, seen)
    innovated = Gaussian(whitened.residual, innovation(whitened)[0])
    return Forecast(canonical(f.motion, belief), measurement(seen, innovated))


def measurement(frame: Frame, innovation: Gaussian) -> Gaussian:
    """The predicted measurement, by its ``innovation (..., m)`` in units of the noise, of a frame ``as_expected``."""
    offset = frame.measurement_noise.colour(innovation.mean.unsqueeze(-1)).squeeze(-1)
    return Gaussian(frame.z - offset, frame.measurement_noise.colour(innovation.scale_tril))
