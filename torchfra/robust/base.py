"""The measurement side: how a filter trusts a wild innovation less.

Two kinds.  ``Weights`` (``Huber``, ``ThreeSegment``) divide the noise of each element by a weight from 1 (trusted) down
to 0 (left out), and the update stays what it was.  ``HuberScore`` and ``HuberRegression`` make an update of their own.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchfra.sensors.base import MeasurementNoise
from torchfra.types import Gaussian, Whitened


class Corrected(NamedTuple):
    """What a robust side makes of a measurement."""

    belief: Gaussian
    weights: Tensor
    """``(..., m)`` how far each element was trusted."""
    evidence: Tensor | None = None
    """``(...)`` log density of the innovation as it was trusted, up to a constant; None for the plain one."""
    iterations: Tensor | None = None
    """``(...)`` if it iterates."""
    repaired: Tensor | None = None
    """``(...)`` bool, if it may take off more covariance than there is."""


class Robust(nn.Module):
    """Abstract: a subclass gives ``correct``."""

    def forward(self, residual: Tensor, nis: Tensor) -> Tensor:
        """Weights ``(..., m)`` by which the noise of a ``residual (..., m)``, in units of it, is to be divided.

        ``nis (...)`` is the normalised innovation squared.  Ones for a side that leaves the noise as it is.
        """
        return torch.ones_like(residual)

    def correct(self, belief: Gaussian, whitened: Whitened, weights: Tensor, noise: MeasurementNoise) -> Corrected:
        """The belief after the measurement.

        Args:
            belief: predicted.
            whitened: the measurement against it.
            weights: what ``forward`` gave, of this innovation or of the one before the prediction was widened.
            noise: what the measurement was divided by.
        """
        raise TypeError(f"{type(self).__name__} needs a correct")
