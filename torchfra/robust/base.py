"""The base of robust updates: from a predicted belief and a measurement to the belief after it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.hyper import Part
from torchfra.sensors.base import MeasurementNoise
from torchfra.types import Gaussian, Prediction, Whitened


class Corrected(NamedTuple):
    """The result of a robust update."""

    belief: Gaussian
    weights: Tensor | None
    """``(..., m)`` by which the noise covariance of each element was divided; None where it was not."""
    evidence: Tensor | None = None
    """``(...)`` log density of the innovation under the divided noise, less a constant; None for the nominal noise."""
    iterations: Tensor | None = None
    """``(...)`` number of iterations of an update that iterates."""


class Robust(Part):
    """Abstract: a subclass gives ``correct``, and ``forward`` if it has weights before that."""

    def forward(self, residual: Tensor, nis: Tensor) -> Tensor:
        """Weights ``(..., m)`` that divide the noise covariance, here ones.

        Args:
            residual: ``(..., m)`` in units of the measurement noise.
            nis: ``(...)`` normalised innovation squared.
        """
        return torch.ones_like(residual)

    def rooted(self, prediction: Prediction) -> Prediction:
        """The prediction by the root that ``correct`` needs, here any."""
        return prediction

    def correct(self, belief: Gaussian, whitened: Whitened, weights: Tensor, noise: MeasurementNoise) -> Corrected:
        """The belief after the measurement.

        Args:
            belief: predicted, by the root of ``rooted``.
            whitened: the measurement compared with it.
            weights: from ``forward``, of this innovation or of the one before fading.
            noise: the measurement noise that ``whitened`` is in units of.
        """
        raise TypeError(f"{type(self).__name__} needs a correct")
