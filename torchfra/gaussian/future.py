"""All later measurements as one measurement of a state, by which several models are smoothed."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchfra.gaussian.model import Propagated
from torchfra.gaussian.rules import Difference
from torchfra.linalg.gram import downdate, gram_information
from torchfra.linalg.tracing import batchwise
from torchfra.linalg.triangular import apply, hstack, split, tria_beside
from torchfra.tree import event_ranks
from torchfra.types import Gaussian


@event_ranks(origin=1, slope=2, value=1)
class Future(NamedTuple):
    """``value = slope (x - origin) + N(0, I)`` for a state ``x (..., n)``.

    Its likelihood, as a function of the state, is that of all later measurements up to a factor: the likelihood which
    the backward filter of two-filter smoothing carries (Fraser & Potter 1969).
    """

    origin: Tensor
    """``(..., n)`` prediction of the state."""
    slope: Tensor
    """``(..., n, n)``, 0 in directions without information."""
    value: Tensor
    """``(..., n)``."""

    def update(self, propagated: Propagated, difference: Difference = torch.sub) -> tuple[Gaussian, Tensor]:
        """Beliefs before the step that has ``propagated`` them to this state, updated by this measurement.

        The process noise ``Q`` counts as measurement noise, ``N = I + slope Q slope^T``.  In units of ``N`` and of the
        root before the step, ``N^-1/2 value = A u + N(0, I)`` for ``u ~ N(0, I)``.  ``tria([[I, A^T], [0, e^T]]) = [[R,
        0], [y^T, d]]`` gives the posterior ``u ~ N(R^-T y, R^-T R^-1)`` and the density ``exp(-d^2 / 2) / det R``.

        Args:
            propagated: the beliefs ``(..., n)`` after the step.
            difference: subtracts two states.

        Returns:
            The posterior ``(..., n)`` in units of the roots before the step, with an upper root (``N(0, I)`` where the
            measurement holds no information), and the log density ``(...)`` of the measurement, constants left out.
        """
        gap = difference(propagated.mean, self.origin)
        subtracted = () if propagated.subtracted is None else (propagated.subtracted,)
        return _update(self.slope, self.value, gap, propagated.spread, propagated.process_noise, *subtracted)


@batchwise(2, 1, 1, 2, 2, 2)
def _update(
    slope: Tensor, value: Tensor, gap: Tensor, spread: Tensor, noise: Tensor, *subtracted: Tensor
) -> tuple[Gaussian, Tensor]:
    """``Future.update`` for beliefs whose mean is ``origin + gap``."""
    n = slope.shape[-1]
    rest = spread.shape[-1] - n
    noise = hstack(noise, spread[..., :rest]) if rest else noise  # the linearisation error is independent of the belief
    eye = torch.eye(n, dtype=noise.dtype, device=noise.device)
    root = tria_beside(eye.diagonal(), slope @ noise)
    if subtracted:
        root, _ = downdate(root, slope @ subtracted[0])
    whitened = torch.linalg.solve_triangular(root, hstack(slope, value.unsqueeze(-1)), upper=False)
    slope = whitened[..., :n]
    residual = whitened[..., n] - apply(slope, gap)
    rows = hstack(slope @ spread[..., rest:], residual.unsqueeze(-1)).mT  # [A, e]^T
    lower = tria_beside(pad(eye.diagonal(), (0, 1)), rows)
    inverse = torch.linalg.solve_triangular(lower[..., :n, :n].mT, eye, upper=True)  # R^-T
    log_density = -0.5 * lower[..., n, n].square() - _log_det(lower[..., :n, :n]) - _log_det(root)
    return Gaussian(apply(inverse, lower[..., n, :n]), inverse), log_density


def _log_det(root: Tensor) -> Tensor:
    return root.diagonal(dim1=-2, dim2=-1).log().sum(-1)


def future(predicted: Gaussian, smoothed: Gaussian, difference: Difference = torch.sub) -> Future:
    """The measurement that turns a ``predicted`` belief ``(..., n)``, of any root, into the ``smoothed`` one.

    Which directions are certain is judged by the columns of that root: a triangle has forgotten of what scale its
    pivots' terms were, and what is known well beside what is not looks like a rounding error.

    In units of the predicted root the smoothed belief is ``N(w, W W^T)``.  Eigenvalues ``p`` of ``W W^T`` are below 1
    where later measurements hold information on the state, which is ``1 / p - 1``.  The merging of several models can
    leave eigenvalues above 1: they count as no information.  ``difference`` subtracts two states.
    """
    gap = difference(smoothed.mean, predicted.mean)
    return Future(predicted.mean, *_future(predicted.scale_tril, gap, smoothed.scale_tril))


@batchwise(2, 1, 2)
def _future(predicted: Tensor, gap: Tensor, smoothed: Tensor) -> tuple[Tensor, Tensor]:
    """Slope and value of ``future``, from roots and the gap between the means."""
    root, _, _, certain = split(predicted, predicted.shape[-2])
    # What depends on other directions tells no more than they do: a row of zeros, which holds no information.
    root = torch.where(certain.unsqueeze(-1), torch.diag_embed(certain.to(root)), root)
    later = torch.where(certain.unsqueeze(-1), 0.0, hstack(gap.unsqueeze(-1), smoothed))
    whitened = torch.linalg.solve_triangular(root, later, upper=False)  # [w, W]
    slope, weight = gram_information(whitened[..., 1:])
    of_state = torch.linalg.solve_triangular(root.mT, slope, upper=True).mT  # slope is symmetric
    return torch.where(certain.unsqueeze(-2), 0.0, of_state), apply(weight, whitened[..., 0])
