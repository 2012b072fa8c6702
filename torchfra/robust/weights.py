"""Robust updates by weights that divide the noise covariance of each element."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.gaussian.update import correct, down_weight, down_weighted_density
from torchfra.hyper import Hyper, Value
from torchfra.numbers import as_numbers
from torchfra.robust.base import Corrected, Robust
from torchfra.sensors.base import MeasurementNoise
from torchfra.types import Gaussian, Whitened


class Weights(Robust):
    """Abstract: a subclass defines ``forward``, whose weights divide the noise covariance of the plain update."""

    def correct(self, belief: Gaussian, whitened: Whitened, weights: Tensor, noise: MeasurementNoise) -> Corrected:
        """The plain update with the noise covariance divided by ``weights``: Wang et al. (2021), eq. (26)."""
        residual = whitened.residual
        if weights.dim() < residual.dim() or weights.shape[-1] != residual.shape[-1]:
            expected, received = tuple(residual.shape), tuple(weights.shape)
            raise ValueError(f"{type(self).__name__}.forward: expected weights {expected}, received {received}")
        after, root, normalised = correct(belief, down_weight(whitened, weights))
        return Corrected(after, weights, down_weighted_density(root, normalised, weights))


class Huber(Weights):
    """Weight 1 up to a threshold and ``threshold / |v|`` beyond it, for each element of the innovation ``v``.

    The innovation is measured in units of the measurement noise alone, not of the innovation covariance: a large error
    of the prediction is down-weighted like an outlier.

    Args:
        threshold: in standard deviations of the measurement noise; with infinity all weights are 1.
        elements: number of elements of a measurement, if each has its own threshold in the last dimension of
            ``threshold``; a single number is then repeated.  None for one threshold for all elements.

    Raises:
        ValueError: a threshold is not above 0, or there is not one for each element.

    Source: Huber (1964); Wang et al. (2021), eqs. (25)-(26).

    Example:
        >>> torchfra.robust.Huber()(torch.tensor([1.0, 13.45]), torch.tensor(0.0))
        tensor([1.0000, 0.1000])
    """

    def __init__(self, threshold: Value = 1.345, *, elements: int | None = None) -> None:
        super().__init__()
        if elements is not None:
            threshold = as_numbers(threshold, "threshold").double()
            threshold = threshold.expand(elements) if threshold.dim() == 0 else threshold
            if threshold.shape[-1] != elements:
                raise ValueError(f"threshold: expected (..., {elements}), received {tuple(threshold.shape)}")
        self.threshold = Hyper(threshold, event_dim=int(elements is not None), name="threshold")

    def forward(self, residual: Tensor, nis: Tensor) -> Tensor:
        """Weights ``(..., m)`` of a ``residual (..., m)`` in units of the measurement noise; ``nis`` is not used."""
        excess = residual.abs() / self.threshold.elements(residual)
        weights: Tensor = 1 / excess.clamp_min(1.0)
        return weights


class ThreeSegment(Weights):
    """One weight for all elements, from the normalised innovation squared: full, decreasing, zero (IGG-III).

    With ``d = sqrt(nis)``, ``a = sqrt(low)`` and ``b = sqrt(high)`` the weight is 1 for ``d <= a``, then ``a/d ((b -
    d)/(b - a))^2``, and 0 for ``d >= b``, where the measurement is not used.

    Args:
        low: normalised innovation squared up to which the weight is 1.
        high: normalised innovation squared from which on it is 0.

    Raises:
        ValueError: ``high`` is not above ``low``.

    Source: Yang et al. (2001) for the weight.  Differs: the form of the weight is our reading, as Wang et al. (2021),
    who compare with the filter of Wu et al. (2015), print only its thresholds.
    """

    def __init__(self, low: Value = 5.991, high: Value = 10000.0) -> None:
        super().__init__()
        self.low, self.high = Hyper(low, name="low"), Hyper(high, name="high")
        if not bool((self.high() > self.low()).all()):
            raise ValueError(f"high: expected a value above low, received {high} with low {low}")

    def forward(self, residual: Tensor, nis: Tensor) -> Tensor:
        """Weights ``(..., m)``, all equal, for the normalised innovation squared ``nis (...)``."""
        low, high = self.low(nis), self.high(nis)
        # The clamps keep the square root and its gradient away from 0, where the weight is 1 anyway.
        d, a, b = nis.clamp_min(low).sqrt(), low.sqrt(), high.sqrt()
        weight = a / d * ((b - d).clamp_min(0.0) / (b - a)).square()
        return torch.where(nis > low, weight, 1.0).unsqueeze(-1).expand(nis.shape + residual.shape[-1:])
