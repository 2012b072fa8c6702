"""A step of the motion seen from its end: Rauch-Tung-Striebel in array form, without downdates."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchfra.gaussian.inputs import Frame
from torchfra.gaussian.model import propagate
from torchfra.gaussian.rules import Difference, Rule
from torchfra.linalg.gram import downdate
from torchfra.linalg.triangular import hstack, tria
from torchfra.motion.base import Motion
from torchfra.tree import event_ranks
from torchfra.types import Gaussian

Stretch = Callable[[Tensor], Tensor]


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


def reverse(motion: Motion, rule: Rule, belief: Gaussian, frame: Frame, stretch: Stretch | None = None) -> Reversed:
    """The step of ``frame`` from a filtered ``belief`` on, seen from its end.

    ``tria([[F S, S_Q], [S, 0]]) = [[S-, 0], [L21, L22]]`` holds all of it: the gain is ``L21 (S-)^-1``, and ``L22`` is
    what the state after the step cannot tell.  Of a nonlinear motion ``F S`` is the rule's slope, and what does not
    follow the belief goes beside the process noise.

    A direction in which the prediction is certain (a pivot of ``S-`` at the level of rounding errors) tells nothing:
    the gain is that of a pseudo-inverse, and what stands in its column of ``L21`` is left.

    Args:
        motion: how the target moves.
        rule: that the filter has carried beliefs by.
        belief: ``(..., n)`` before the step.
        frame: of the step.
        stretch: what fading factors make of the columns ``(..., n, p)`` that come from the belief.

    Source: Rauch, Tung & Striebel (1965); Arasaratnam & Haykin (2011), "Cubature Kalman Smoothers"; in this form
    Yaghoobi et al. (2022), "Parallel Square-Root Statistical Linear Regression for Inference in Nonlinear State Space
    Models".  Differs: the rank of the prediction may be lost.
    """
    mean, spread, noise, lost = propagate(motion, rule, belief, frame)
    spread = spread if stretch is None else stretch(spread)
    n, repaired = mean.shape[-1], None
    ahead = hstack(noise, spread)
    if lost is not None:
        own, slope = ahead[..., :-n], ahead[..., -n:]
        root, repaired = downdate(tria(own), lost)
        ahead = hstack(root, slope)
    ahead = pad(ahead, (2 * n, 0))  # behind the zeros that tria wants
    now = pad(belief.scale_tril.expand(*ahead.shape[:-2], n, n), (ahead.shape[-1] - n, 0))
    lower = tria(torch.cat([ahead, now], -2), padded=True)
    root, cross, left = lower[..., :n, :n], lower[..., n:, :n], lower[..., n:, n:]
    certain = _certain(root.detach(), sum(ahead.shape[-2:]))
    rows, columns = certain.unsqueeze(-1), certain.unsqueeze(-2)
    left = hstack(left, torch.where(columns, cross, 0.0))
    root = torch.where(rows, 0.0, root) + torch.diag_embed(certain.to(root))
    return Reversed(belief.mean, mean, root, torch.where(columns, 0.0, cross), left, certain, repaired)


def _certain(root: Tensor, terms: int) -> Tensor:
    """``(..., n)`` bool: pivots of ``root (..., n, n)`` at the level of the rounding errors of so many terms."""
    rounding = 4 * terms * torch.finfo(root.dtype).eps
    certain: Tensor = root.diagonal(dim1=-2, dim2=-1) <= rounding * root.square().sum(-1).sqrt()
    return certain
