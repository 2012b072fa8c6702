"""What later measurements say of a state, as a measurement of it: how several beliefs share one future."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.gaussian.model import Carried
from torchfra.gaussian.smoothing import invertible
from torchfra.linalg.gram import gram_information
from torchfra.linalg.triangular import apply, hstack
from torchfra.tree import event_ranks
from torchfra.types import Gaussian, Whitened


@event_ranks(origin=1, root=2, certain=1, slope=2, value=1)
class Future(NamedTuple):
    """``value = slope root^-1 (x - origin) + N(0, I)`` for a state ``x (..., n)``."""

    origin: Tensor
    """``(..., n)`` prediction of the state."""
    root: Tensor
    """``(..., n, n)`` lower root of its covariance, I in directions that are certain."""
    certain: Tensor
    """``(..., n)`` bool, which directions those are."""
    slope: Tensor
    """``(..., n, n)``, 0 along what nothing is said of."""
    value: Tensor
    """``(..., n)``."""

    def against(self, ahead: Carried) -> Whitened:
        """This measurement against beliefs ``(..., n)`` that are carried as far as its state."""
        columns = hstack((ahead.mean - self.origin).unsqueeze(-1), ahead.process_noise, ahead.spread)
        rows = self._rows(columns)
        lost = None if ahead.lost is None else self._rows(ahead.lost)
        return Whitened(self.value - rows[..., 0], rows[..., 1:], ahead.mean.shape[-1], lost)

    def _rows(self, columns: Tensor) -> Tensor:
        columns = torch.where(self.certain.unsqueeze(-1), 0.0, columns)
        rows: Tensor = self.slope @ torch.linalg.solve_triangular(self.root, columns, upper=False)
        return rows


def future(predicted: Gaussian, smoothed: Gaussian) -> Future:
    """The measurement that makes of a ``predicted`` belief ``(..., n)`` the ``smoothed`` one.

    In units of the predicted root the smoothed belief is ``N(w, W W^T)``.  Eigenvalues ``p`` of ``W W^T`` are below 1
    where later measurements have told something: there the information is ``1 / p - 1``.  Directions of more, which
    the merging of several models can leave, say nothing.
    """
    root, certain = invertible(predicted.scale_tril, 4 * predicted.mean.shape[-1])
    gap = (smoothed.mean - predicted.mean).unsqueeze(-1)
    known = torch.where(certain.unsqueeze(-1), 0.0, hstack(gap, smoothed.scale_tril))
    inside = torch.linalg.solve_triangular(root, known, upper=False)
    slope, weight = gram_information(inside[..., 1:])
    return Future(predicted.mean, root, certain, slope, apply(weight, inside[..., 0]))
