"""The measurement update in array form, on a measurement in units of its noise: see ``types.Whitened``.

Equation numbers are those of Wang et al. (2021).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchfra.linalg.gram import downdate
from torchfra.linalg.safe import safe_log, safe_sqrt, safe_square
from torchfra.linalg.triangular import apply, hstack, tria, tria_of_update, whiten
from torchfra.types import Gaussian, Whitened


class Joint(NamedTuple):
    """``tria`` of measurement and state together: ``[[S_zz, 0], [K S_zz, S_post]]``."""

    root: Tensor
    """``S_zz (..., m, m)`` lower root of the innovation's covariance: eq. (17)."""
    cross: Tensor
    """``K S_zz (..., n, m)`` covariance of state and measurement, divided by that root: eqs. (20), (22)."""
    posterior: Tensor
    """``S_post (..., n, n)`` lower root of the posterior covariance: eq. (24)."""


def repaired_root(whitened: Whitened) -> tuple[Tensor, Tensor]:
    """The linearisation error and noise of a measurement, for a rule with negative weights.

    Returns:
        The lower root ``(..., m, m)`` of ``I + rest rest^T - subtracted subtracted^T``, and ``(...)`` bool whether that
        was not positive definite and was repaired.
    """
    assert whitened.subtracted is not None
    return downdate(tria(hstack(_unit(whitened), whitened.rest)), whitened.subtracted)


def innovation(whitened: Whitened) -> tuple[Tensor, Tensor]:
    """Root ``(..., m, m)`` of the residual's covariance and the residual ``(..., m)`` divided by it: (17), (35)."""
    if whitened.subtracted is None:  # [I, rest, H S] (..., m, p)
        unit = _unit(whitened).expand(*whitened.spread.shape[:-1], -1)
        blocks = torch.cat([unit, whitened.spread], -1)
    else:
        blocks = hstack(repaired_root(whitened)[0], whitened.slope)
    root = tria(blocks)
    return root, whiten(root, whitened.residual)


def joint(belief: Gaussian, whitened: Whitened) -> Joint:
    """The joint root of measurement and state: eqs. (17)-(24).

    ``tria([[I, rest, H S], [0, 0, S]]) = [[S_zz, 0], [K S_zz, S_post]]``.
    """
    m, n, d, unit = whitened.residual.shape[-1], belief.mean.shape[-1], whitened.reads, whitened.subtracted is None
    top = whitened.spread if unit else hstack(repaired_root(whitened)[0], whitened.slope)
    top = pad(top, (0, n - d))
    root = belief.scale_tril.expand((*top.shape[:-2], n, n))
    lower = tria_of_update(torch.cat([top, pad(root, (top.shape[-1] - n, 0))], -2), m, d, unit=unit)
    top, bottom = lower.split([m, n], -2)
    return Joint(top[..., :m], *bottom.split([m, n], -1))


def correct(belief: Gaussian, whitened: Whitened) -> tuple[Gaussian, Tensor, Tensor]:
    """The belief after the measurement, and the innovation's root and normalised residual: eqs. (17)-(24)."""
    root, cross, posterior = joint(belief, whitened)
    normalised = whiten(root, whitened.residual)
    return Gaussian(belief.mean + apply(cross, normalised), posterior), root, normalised


def down_weight(whitened: Whitened, weights: Tensor) -> Whitened:
    """The measurement with its noise covariance divided by ``weights (..., m)``: eq. (26).

    The measurement is scaled down instead of its noise up, so that a weight of 0 leaves it out.
    """
    scale = safe_sqrt(weights)
    subtracted = None if whitened.subtracted is None else scale.unsqueeze(-1) * whitened.subtracted
    return Whitened(scale * whitened.residual, scale.unsqueeze(-1) * whitened.spread, whitened.reads, subtracted)


def density(root: Tensor, normalised: Tensor) -> Tensor:
    """Log density ``(...)`` of a residual with this root, both in units of the noise, constants left out."""
    return -0.5 * safe_square(normalised).sum(-1) - root.diagonal(dim1=-2, dim2=-1).log().sum(-1)


def down_weighted_density(root: Tensor, normalised: Tensor, weights: Tensor) -> Tensor:
    """Log density ``(...)`` of a residual after ``down_weight`` with ``weights (..., m)``."""
    return density(root, normalised) + 0.5 * safe_log(weights, fill=0.0).sum(-1)


def _unit(whitened: Whitened) -> Tensor:
    m = whitened.residual.shape[-1]
    return torch.eye(m, dtype=whitened.spread.dtype, device=whitened.spread.device)
