"""One step of the backward pass: Rauch-Tung-Striebel in array form, without downdates."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchfra.gaussian.model import Propagated
from torchfra.gaussian.rules import Difference
from torchfra.linalg.gram import downdate
from torchfra.linalg.triangular import hstack, split, tria
from torchfra.types import Gaussian


def smooth_step(
    belief: Gaussian, propagated: Propagated, after: Gaussian, difference: Difference
) -> tuple[Gaussian, Tensor | None]:
    """The smoothed belief before a step, from the smoothed one after it.

    ``tria([[F S, S_Q], [S, 0]]) = [[S-, 0], [L21, L22]]`` gives the gain ``G = L21 (S-)^-1``.  Then

        x ~ mean + G (x_after - predicted) + L22 e   with  e ~ N(0, I),

    so that the smoothed root is ``tria([L22, G S_after])``.  For a nonlinear motion ``F S`` is the rule's slope, and
    the linearisation error counts as process noise.

    A direction in which the prediction is certain (a pivot of ``S-`` at the level of rounding errors) carries no
    information: the gain is that of a pseudo-inverse, and its column of ``L21`` goes to ``L22``.

    Args:
        belief: ``(..., n)`` filtered.
        propagated: the same belief after the step.
        after: ``(..., n)`` smoothed, after the step; it may have one more dimension in front.
        difference: subtracts two states.

    Returns:
        The smoothed belief, and ``(...)`` bool whether the joint covariance was repaired; None for rules without
        negative weights.

    Source: Rauch, Tung & Striebel (1965); Arasaratnam & Haykin (2011), "Cubature Kalman Smoothers"; in this form
    Yaghoobi et al. (2022), "Parallel Square-Root Statistical Linear Regression for Inference in Nonlinear State Space
    Models".  Differs: the rank of the prediction may be lost.
    """
    n, repaired = belief.mean.shape[-1], None
    columns = hstack(propagated.process_noise, propagated.spread)
    if propagated.subtracted is not None:
        root, repaired = downdate(tria(columns[..., :-n]), propagated.subtracted)
        columns = hstack(root, columns[..., -n:])
    now = pad(belief.scale_tril.expand(*columns.shape[:-2], n, n), (columns.shape[-1] - n, 0))
    root, cross, remainder, certain = split(torch.cat([columns, now], -2), n)
    gap = difference(after.mean, propagated.mean).unsqueeze(-1)
    later = torch.where(certain.unsqueeze(-1), 0.0, hstack(gap, after.scale_tril))
    gained = cross @ torch.linalg.solve_triangular(root, later, upper=False)  # G [x_after - predicted, S_after]
    return Gaussian(belief.mean + gained[..., 0], tria(hstack(remainder, gained[..., 1:]))), repaired
