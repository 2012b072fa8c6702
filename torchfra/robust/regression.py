"""Robust update by a Huber regression on measurement and prediction."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchfra.gaussian.update import correct, down_weight, repaired_root
from torchfra.hyper import Hyper, Value
from torchfra.linalg.triangular import apply, eliminated, hstack, rounding, tria, whiten
from torchfra.numbers import as_number, is_integer
from torchfra.robust.base import Corrected, Robust
from torchfra.sensors.base import MeasurementNoise
from torchfra.types import Gaussian, Prediction, Whitened


class _Linear(NamedTuple):
    """The regression ``residual = slope e + noise``, ``0 = e + noise`` for the error ``e (..., n)`` of the prediction.

    All is in units of the roots of measurement noise and prediction, so that both noises have covariance I.
    """

    measurement: Whitened
    """The residual ``(..., m)`` and its slope with respect to the elements of the state that the sensor reads."""
    slope: Tensor
    """``(..., m, n)`` the slope with respect to all elements of the state."""
    threshold: Tensor
    """``(..., 1)``."""

    def reweighted(self, error: Tensor) -> tuple[Gaussian, Tensor]:
        """The weighted least-squares solution, and the weights ``(..., m)`` of the measurement.

        Args:
            error: ``(..., n)`` the last iterate, which fixes the weights.
        """
        weights = _huber_weights(apply(self.slope, error) - self.measurement.residual, self.threshold)
        std = _huber_weights(error, self.threshold).rsqrt()  # of the reweighted prediction
        scaled = self.measurement._replace(spread=self.measurement.slope * std[..., None, : self.measurement.reads])
        solution, _, _ = correct(Gaussian(torch.zeros_like(error), std.diag_embed()), down_weight(scaled, weights))
        return solution, weights


class HuberRegression(Robust):
    """The update as a linear regression on measurement and prediction, both with Huber weights, iterated.

    It down-weights outlying predictions too: where the prediction is the less certain of the two, it attributes an
    outlier of the measurement to the prediction, and follows it.

    Args:
        threshold: threshold of the weights, in standard deviations; with infinity all weights are 1.
        max_iter: largest number of reweightings, 1 or more.
        tol: relative change below which a track has converged, 0 or more.
        compensate: whether the error of the statistical linearisation of the measurement is added to the measurement
            noise; otherwise it is neglected.

    Raises:
        ValueError: an argument is out of its range.

    Source: Karlgaard & Schaub (2007); Zhang et al. (2016); Qin et al. (2018) for the comparison.
    """

    def __init__(
        self,
        threshold: Value = 1.345,
        *,
        max_iter: int = 10,
        tol: float = 1e-6,
        compensate: bool = False,
    ) -> None:
        super().__init__()
        if not (is_integer(max_iter, 1) and as_number(tol) >= 0):
            raise ValueError(
                f"max_iter, tol: expected max_iter of 1 or more and tol of 0 or more, received {max_iter!r}, {tol!r}"
            )
        self.threshold = Hyper(threshold, name="threshold")
        self.max_iter, self.tol, self.compensate = max_iter, tol, compensate

    def rooted(self, prediction: Prediction) -> Prediction:
        """The prediction by a root that has a zero column for each component which those above it determine.

        The lower root of a singular covariance is not unique: what rounding leaves on such a pivot decides how the rest
        of that column is shared with those behind it.  Weights of the prediction's elements depend on that.  Which are
        determined is judged by the columns that the root is made of: the root has forgotten of what scale they were.
        """
        graded = prediction.repaired is None  # nothing is subtracted from the columns
        belief, n = prediction.belief, prediction.belief.mean.shape[-1]
        columns = hstack(prediction.process_noise, prediction.spread) if graded else belief.scale_tril
        root, _, _, determined = eliminated(columns, n, rounding(sum(columns.shape[-2:]), columns.dtype), graded=graded)
        root = root - torch.where(determined, 1.0, 0.0).diag_embed()
        return prediction._replace(belief=belief._replace(scale_tril=root))

    def correct(self, belief: Gaussian, whitened: Whitened, weights: Tensor, noise: MeasurementNoise) -> Corrected:
        """The belief after the measurement; the weights of the iterations take the place of ``weights``."""
        linear = self._linear(whitened, belief.mean.shape[-1])
        nothing = torch.zeros_like(belief.mean)
        unit = torch.eye(nothing.shape[-1], dtype=whitened.residual.dtype, device=whitened.residual.device)
        error, iterations = self._iterate(linear, correct(Gaussian(nothing, unit), whitened)[0].mean)
        solution, weights = linear.reweighted(error)
        mean = belief.mean + apply(belief.scale_tril, error)
        return Corrected(Gaussian(mean, belief.scale_tril @ solution.scale_tril), weights, iterations=iterations)

    def _linear(self, whitened: Whitened, n: int) -> _Linear:
        """The regression, for a state of ``n`` elements."""
        residual, slope, d = whitened.residual, whitened.slope, whitened.reads
        if self.compensate:
            unit = torch.eye(residual.shape[-1], dtype=residual.dtype, device=residual.device)
            root = tria(hstack(unit, whitened.rest)) if whitened.subtracted is None else repaired_root(whitened)[0]
            residual, slope = whiten(root, residual), torch.linalg.solve_triangular(root, slope, upper=False)
        threshold = self.threshold(residual).unsqueeze(-1)
        return _Linear(Whitened(residual, slope, d), pad(slope, (0, n - d)), threshold)

    def _iterate(self, linear: _Linear, error: Tensor) -> tuple[Tensor, Tensor]:
        """The last iterate ``(..., n)`` and the number of iterations ``(...)``; each track stops once it converged."""
        active = torch.ones_like(error[..., 0], dtype=torch.bool)
        count = torch.zeros_like(active, dtype=torch.int64)
        for _ in range(self.max_iter):
            new = linear.reweighted(error)[0].mean
            moved = (new - error).square().sum(-1) > self.tol**2 * new.square().sum(-1)
            error, count = torch.where(active.unsqueeze(-1), new, error), count + active.to(count)
            active = active & moved
        return error, count


def _huber_weights(residual: Tensor, threshold: Tensor) -> Tensor:
    """``min(1, threshold / |residual|)`` of each element."""
    return 1 / (residual.abs() / threshold).clamp_min(1.0)
