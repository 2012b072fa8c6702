"""A step of the motion seen from its end: Rauch-Tung-Striebel in array form, without downdates."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchfra.gaussian.model import Carried
from torchfra.gaussian.rules import Difference
from torchfra.linalg.gram import downdate
from torchfra.linalg.tracing import is_elementary
from torchfra.linalg.triangular import eliminated, hstack, tria
from torchfra.tree import event_ranks
from torchfra.types import Gaussian


@event_ranks(mean=1, predicted=1, root=2, cross=2, left=2, repaired=0)
class Reversed(NamedTuple):
    """A state by the one after it: ``x ~ mean + cross root^-1 (x_after - predicted) + left e`` with ``e ~ N(0, I)``."""

    mean: Tensor
    """``(..., n)`` filtered."""
    predicted: Tensor
    """``(..., n)`` of the state after the step."""
    root: Tensor
    """``S- (..., n, n)`` lower root of its covariance, without the directions that are certain: there it is I."""
    cross: Tensor
    """``(..., n, n)`` covariance of the two states, divided by that root; 0 in those directions."""
    left: Tensor
    """``(..., n, r)`` root of the covariance that is left when the state after is known."""
    certain: Tensor
    """``(..., n)`` bool, which directions those are."""
    repaired: Tensor | None = None
    """``(...)`` bool, of a rule with negative weights: the joint covariance was repaired."""

    def __call__(self, after: Gaussian, difference: Difference) -> Gaussian:
        """The belief of the state, once there is a smoothed one of the state ``after (..., n)`` it.

        ``difference`` subtracts two states.
        """
        gap = difference(after.mean, self.predicted).unsqueeze(-1)
        known = torch.where(self.certain.unsqueeze(-1), 0.0, hstack(gap, after.scale_tril))
        told = self.cross @ torch.linalg.solve_triangular(self.root, known, upper=False)
        return Gaussian(self.mean + told[..., 0], tria(hstack(self.left, told[..., 1:])))


def reverse(belief: Gaussian, carried: Carried) -> Reversed:
    """The step that has carried a filtered ``belief (..., n)`` on, seen from its end.

    ``tria([[F S, S_Q], [S, 0]]) = [[S-, 0], [L21, L22]]`` holds all of it: the gain is ``L21 (S-)^-1``, and ``L22`` is
    what the state after the step cannot tell.  Of a nonlinear motion ``F S`` is the rule's slope, and what does not
    follow the belief goes beside the process noise.

    A direction in which the prediction is certain (a pivot of ``S-`` at the level of rounding errors) tells nothing:
    the gain is that of a pseudo-inverse, and what stands in its column of ``L21`` is left.

    Source: Rauch, Tung & Striebel (1965); Arasaratnam & Haykin (2011), "Cubature Kalman Smoothers"; in this form
    Yaghoobi et al. (2022), "Parallel Square-Root Statistical Linear Regression for Inference in Nonlinear State Space
    Models".  Differs: the rank of the prediction may be lost.
    """
    n, repaired = carried.mean.shape[-1], None
    columns = hstack(carried.process_noise, carried.spread)
    if carried.subtracted is not None:
        root, repaired = downdate(tria(columns[..., :-n]), carried.subtracted)
        columns = hstack(root, columns[..., -n:])
    now = pad(belief.scale_tril.expand(*columns.shape[:-2], n, n), (columns.shape[-1] - n, 0))
    root, cross, left, certain = _split(torch.cat([columns, now], -2), n)
    return Reversed(belief.mean, carried.mean, root, cross, left, certain, repaired)


def _split(joint: Tensor, n: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """``S-``, ``L21``, a root of what is left and the certain directions, of a ``joint`` root ``(..., 2 n, p)``."""
    terms = 3 * n + joint.shape[-1]
    if is_elementary():
        return eliminated(joint, n, _rounding(terms, joint.dtype))  # what is left need not be a triangle
    lower = tria(joint)
    cross, left = lower[..., n:, :n], lower[..., n:, n:]
    root, certain = invertible(lower[..., :n, :n], terms)
    untold = certain.unsqueeze(-2)
    return root, torch.where(untold, 0.0, cross), hstack(left, torch.where(untold, cross, 0.0)), certain


def invertible(root: Tensor, terms: int) -> tuple[Tensor, Tensor]:
    """A lower root ``(..., n, n)`` with the identity in directions that are certain, and which those are.

    These are the pivots, ``(..., n)`` bool, at the level of the rounding errors of sums of so many terms.
    """
    held = root.detach()
    certain = held.diagonal(dim1=-2, dim2=-1) <= _rounding(terms, root.dtype) * held.square().sum(-1).sqrt()
    return torch.where(certain.unsqueeze(-1), 0.0, root) + torch.diag_embed(certain.to(root)), certain


def _rounding(terms: int, dtype: torch.dtype) -> float:
    """Relative errors of sums of so many terms."""
    return 4 * terms * torch.finfo(dtype).eps
