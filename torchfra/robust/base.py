"""What a robust update is: from a measurement and its prediction to the belief after it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchfra.gaussian.update import correct
from torchfra.sensors.base import MeasurementNoise
from torchfra.types import Gaussian, Whitened


class Corrected(NamedTuple):
    """What a robust update makes of a measurement."""

    belief: Gaussian
    weights: Tensor | None
    """``(..., m)`` by which the noise of each element was divided; None where nothing is down-weighted."""
    evidence: Tensor | None = None
    """``(...)`` log density of the innovation under the noise so divided, less a constant; None for the nominal one."""
    iterations: Tensor | None = None
    """``(...)`` if it iterates."""
    repaired: Tensor | None = None
    """``(...)`` bool, if it may take off more covariance than there is."""


class Robust(nn.Module):
    """The plain update, which down-weights nothing; a subclass gives ``forward``, ``correct`` or both."""

    @property
    def plain(self) -> bool:
        """Whether it down-weights nothing."""
        return type(self) is Robust

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
            noise: the measurement noise that the measurement is in units of.
        """
        return Corrected(correct(belief, whitened)[0], None)
