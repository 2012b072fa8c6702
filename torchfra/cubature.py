"""Rules that carry a Gaussian through a function: sigma points of several kinds, and the tangent of the EKF.

Each ends in the same form, a statistical linearisation.  For ``x ~ N(mean, S S^T)``

    f(x) ~ value + slope S^-1 (x - mean) + (something uncorrelated with x, of covariance rest rest^T),

so that every Gaussian filter is one piece of square-root algebra around its rule.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchfra.types import Gaussian

Function = Callable[[Tensor], Tensor]
Difference = Callable[[Tensor, Tensor], Tensor]


class Linearised(NamedTuple):
    """``value (..., m)`` and ``spread (..., m, r + n) = [rest, slope]`` as in the head of this file."""

    value: Tensor
    spread: Tensor


class Rule(Protocol):
    """What a filter asks of a rule for ``n`` states."""

    def __call__(self, function: Function, belief: Gaussian, difference: Difference) -> Linearised:
        """Carry ``belief`` through ``function (..., p, n) -> (..., p, m)``; ``difference`` subtracts two values."""
        ...

    def marginal(self, d: int) -> Rule:
        """The same rule for functions that read the first ``d`` components only."""
        ...


class SigmaPoints(nn.Module):
    """A centre and points around it, in units of the belief's root.

    The mean is the centre's value plus the weighted mean of the differences to it, so that angles average right; the
    spread comes from one constant matrix whose last ``n`` columns give the slope and the others the rest.

    Args:
        points: ``(n, p)`` without the centre, ``sum_i w_i points_i points_i^T = I``.
        weights: ``(p,)`` positive; the centre has what is left to one in the mean.
        extra: what the centre's weight in the covariance is above its weight in the mean.

    Raises:
        ValueError: a weight that is not positive, or a centre so negative that the covariance has no real root.
    """

    points: Tensor
    combine: Tensor

    def __init__(self, points: Tensor, weights: Tensor, extra: float = 0.0) -> None:
        super().__init__()
        self._rule = points, weights, extra
        if not bool((weights > 0).all()):
            raise ValueError(f"weights: expected all above 0 except the centre's, received {weights.tolist()}")
        # Sum over all points of w (value - mean)(value - mean)^T, in differences to the centre's value.
        gram = torch.diag(weights) + (extra - 1.0) * torch.outer(weights, weights)
        power, basis = torch.linalg.eigh(gram)
        if power[0] < -1e-12 * power[-1]:
            raise ValueError(
                f"the centre's weight in the covariance ({1 - weights.sum() + extra:g}) is too negative for a root: "
                "choose beta >= alpha^2, or a larger kappa"
            )
        root = basis * power.clamp_min(0.0).sqrt()
        turn = torch.linalg.qr((points @ root).mT, mode="complete").Q
        root = root @ turn
        root[:, : len(points)] *= (points @ root).diagonal().sign()
        root = root[:, root.norm(dim=0) > 1e-12 * root.norm()]
        self.register_buffer("points", pad(points, (1, 0)).mT.contiguous())
        self.register_buffer("combine", torch.cat([weights.unsqueeze(-1), root.roll(-len(points), 1)], 1))

    def marginal(self, d: int) -> SigmaPoints:
        """The points as a function of the first ``d`` components sees them: those that coincide are one."""
        points, weights, extra = self._rule
        seen, where = torch.unique(points[:d], dim=1, return_inverse=True)
        merged = torch.zeros(seen.shape[1], dtype=weights.dtype).index_add(0, where, weights)
        around = seen.norm(dim=0) > 0
        return SigmaPoints(seen[:, around], merged[around], extra)

    def forward(self, function: Function, belief: Gaussian, difference: Difference) -> Linearised:
        """See ``Rule``."""
        mean, root = belief
        points, combine = self.points.to(mean), self.combine.to(mean)
        values = function(mean.unsqueeze(-2) + points @ root.mT)
        centre = values[..., :1, :]
        moments = difference(values[..., 1:, :], centre).mT @ combine
        return Linearised(centre.squeeze(-2) + moments[..., 0], moments[..., 1:])


class Tangent(nn.Module):
    """The tangent at the mean: the rule of the extended Kalman filter, by forward-mode differentiation."""

    def marginal(self, d: int) -> Tangent:
        """The same."""
        return self

    def forward(self, function: Function, belief: Gaussian, difference: Difference) -> Linearised:
        """See ``Rule``."""
        mean, root = belief
        at, along = torch.broadcast_tensors(mean.unsqueeze(-2), root.mT)  # the mean, once per column of the root
        values, slope = torch.func.jvp(  # type: ignore[misc]  # three values only with has_aux
            function, (at.contiguous(),), (along.contiguous(),)
        )
        return Linearised(values[..., 0, :], slope.mT)


def third_degree(n: int) -> SigmaPoints:
    """Third-degree spherical-radial cubature: ``2 n`` points at ``sqrt(n)``, equal weights.

    Source: Arasaratnam & Haykin (2009), "Cubature Kalman Filters", eqs. (31)-(32).
    """
    eye = torch.eye(n, dtype=torch.float64)
    return SigmaPoints(n**0.5 * torch.cat([eye, -eye], 1), torch.full((2 * n,), 0.5 / n, dtype=torch.float64))


def unscented(alpha: float = 1.0, beta: float = 0.0, kappa: float = 1.0) -> Callable[[int], SigmaPoints]:
    """Scaled unscented transform: ``2 n`` points at ``alpha sqrt(n + kappa)`` and a centre.

    The centre's weight in the covariance may be negative as long as ``beta >= alpha^2``; otherwise it must not be.
    ``unscented(1, 0, 0)`` is ``third_degree``.

    Raises:
        ValueError: ``alpha`` not above 0, or (when the rule is made for ``n``) ``n + kappa`` not above 0 or no real
            root of the covariance.

    Source: Julier & Uhlmann (2004), "Unscented Filtering and Nonlinear Estimation"; van der Merwe (2004).
    """
    if not alpha > 0:
        raise ValueError(f"alpha: expected a value above 0, received {alpha}")

    def rule(n: int) -> SigmaPoints:
        if not n + kappa > 0:
            raise ValueError(f"kappa: expected a value above {-n} for {n} states, received {kappa}")
        scale = alpha**2 * (n + kappa)
        eye = torch.eye(n, dtype=torch.float64)
        weights = torch.full((2 * n,), 0.5 / scale, dtype=torch.float64)
        return SigmaPoints(scale**0.5 * torch.cat([eye, -eye], 1), weights, 1.0 - alpha**2 + beta)

    return rule


def tangent(n: int) -> Tangent:
    """The rule of the extended Kalman filter, for any number of states.

    Source: Jazwinski (1970), "Stochastic Processes and Filtering Theory", ch. 8.
    """
    return Tangent()
