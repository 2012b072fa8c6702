"""Robust by weights that divide the noise of each element."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.gaussian.update import correct, trust, trusted_density
from torchfra.hyper import Hyper, Value
from torchfra.robust.base import Corrected, Robust
from torchfra.sensors.base import MeasurementNoise
from torchfra.types import Gaussian, Whitened


class Weights(Robust):
    """Abstract: a subclass gives ``forward``, and the update is the plain one with the noise so much larger."""

    def correct(self, belief: Gaussian, whitened: Whitened, weights: Tensor, noise: MeasurementNoise) -> Corrected:
        """See ``Robust``; Wang et al. (2021), eq. (26)."""
        after, root, normalised = correct(belief, trust(whitened, weights))
        return Corrected(after, weights, trusted_density(root, normalised, weights))


class Huber(Weights):
    """Weight 1 up to a threshold and ``threshold / |v|`` beyond it, per element.

    The innovation counts in units of the measurement noise alone, not of the whole innovation covariance: a large
    error of the prediction is taken for an outlier too.

    Args:
        threshold: in standard deviations of the noise; infinity never doubts a measurement.
        elements: the number of elements of a measurement if each is to have a threshold of its own, in the last
            dimension of ``threshold``; a single number is then repeated.

    Raises:
        ValueError: a threshold that is not above 0, or not one for each element.

    Source: Huber (1964); Wang et al. (2021), eqs. (25)-(26).
    """

    def __init__(self, threshold: Value = 1.345, *, elements: int | None = None) -> None:
        super().__init__()
        if elements is not None:
            threshold = torch.as_tensor(threshold, dtype=torch.float64)
            threshold = threshold.expand(elements) if threshold.dim() == 0 else threshold
            if threshold.shape[-1] != elements:
                raise ValueError(f"threshold: expected (..., {elements}), received {tuple(threshold.shape)}")
        self.threshold = Hyper(threshold, event=int(elements is not None), name="threshold")

    def forward(self, residual: Tensor, nis: Tensor) -> Tensor:
        """Weights ``(..., m)`` of a ``residual (..., m)`` in units of the noise; ``nis (...)`` is not looked at."""
        excess = residual.abs() / self.threshold.elements(residual)
        weights: Tensor = 1 / excess.clamp_min(1.0)
        return weights


class ThreeSegment(Weights):
    """One weight for all elements, from the distance of the whole innovation: full, falling, none (IGG-III).

    With ``d = sqrt(nis)``, ``a = sqrt(low)`` and ``b = sqrt(high)``: 1 up to a, ``a/d ((b - d)/(b - a))^2`` between,
    0 from b on, which leaves the measurement out.

    Args:
        low: normalised innovation squared up to which a measurement is trusted fully.
        high: from which on it is not used at all.
        squared: take ``nis, low, high`` themselves in the place of ``d, a, b``.

    Raises:
        ValueError: ``high`` not above ``low``.

    Source: Yang et al. (2001) for the weight.  Differs: Wang et al. (2021) compare with the filter of Wu et al. (2015)
    and print its thresholds only; the form of the weight is our reading.
    """

    def __init__(self, low: Value = 5.991, high: Value = 10000.0, *, squared: bool = False) -> None:
        super().__init__()
        self.low, self.high, self.squared = Hyper(low, name="low"), Hyper(high, name="high"), squared
        if not bool((self.high() > self.low()).all()):
            raise ValueError(f"high: expected a value above low, received {high} with low {low}")

    def forward(self, residual: Tensor, nis: Tensor) -> Tensor:
        """Weights ``(..., m)``, all the same, of an innovation whose normalised square is ``nis (...)``."""
        low, high = self.low(nis), self.high(nis)
        # The clamps keep the root and its gradient away from 0, inside the segment where the weight is 1 anyway.
        d = nis.clamp_min(low) if self.squared else nis.clamp_min(low).sqrt()
        a, b = (low, high) if self.squared else (low.sqrt(), high.sqrt())
        weight = a / d * ((b - d).clamp_min(0.0) / (b - a)).square()
        return torch.where(nis > low, weight, 1.0).unsqueeze(-1).expand(nis.shape + residual.shape[-1:])
