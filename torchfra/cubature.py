"""Rules that carry a Gaussian through a function: sigma points of several kinds, and the tangent of the EKF.

Each ends in the same form, a statistical linearisation.  For ``x ~ N(mean, S S^T)``

    f(x) ~ value + slope S^-1 (x - mean) + (something uncorrelated with x, of covariance rest rest^T),

so that every Gaussian filter is one piece of square-root algebra around its rule.  Where weights are negative, that
covariance is ``rest rest^T - lost lost^T``.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import NamedTuple, Protocol

import numpy as np
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
    lost: Tensor | None = None
    """``(..., m, k)``, only of rules with negative weights."""


class Rule(Protocol):
    """What a filter asks of a rule for ``n`` states."""

    signed: bool
    """Whether some weights are negative, so that covariances may turn out not positive."""

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
        weights: ``(p,)``; the centre has what is left to one in the mean.
        extra: what the centre's weight in the covariance is above its weight in the mean.
        signed: whether weights may be negative.

    Raises:
        ValueError: not ``signed``, and a weight that is not positive or a centre so negative that the covariance has no
            real root.
    """

    points: Tensor
    combine: Tensor
    minus: Tensor | None

    def __init__(self, points: Tensor, weights: Tensor, extra: float = 0.0, *, signed: bool = False) -> None:
        super().__init__()
        points, weights = points[:, weights != 0], weights[weights != 0]
        self._rule = points, weights, extra, signed
        self.register_buffer("minus", None)
        self.signed = bool((weights < 0).any())
        if self.signed and not signed:
            raise ValueError(f"weights: expected all above 0 except the centre's, received {weights.tolist()}")
        # Sum over all points of w (value - mean)(value - mean)^T, in differences to the centre's value.
        gram = torch.diag(weights) + (extra - 1.0) * torch.outer(weights, weights)
        self.register_buffer("points", pad(points, (1, 0)).mT.contiguous())
        root = self._split(gram, points, weights) if self.signed else self._root(gram, points)
        self.register_buffer("combine", torch.cat([weights.unsqueeze(-1), root], 1))

    @staticmethod
    def _root(gram: Tensor, points: Tensor) -> Tensor:
        """``[rest, slope] (p, r + n)`` of a positive Gram matrix."""
        power, basis = torch.linalg.eigh(gram)
        if power[0] < -1e-12 * power[-1]:
            raise ValueError(
                "the centre's weight in the covariance is too negative for a root: choose beta >= alpha^2, or a larger "
                "kappa"
            )
        root = basis * power.clamp_min(0.0).sqrt()
        turn = torch.linalg.qr((points @ root).mT, mode="complete").Q
        root = root @ turn
        root[:, : len(points)] *= (points @ root).diagonal().sign()
        root = root[:, root.norm(dim=0) > 1e-12 * root.norm()]
        ordered: Tensor = root.roll(-len(points), 1)
        return ordered

    def _split(self, gram: Tensor, points: Tensor, weights: Tensor) -> Tensor:
        """``[rest, slope]`` of one that is not, whose negative part goes into ``minus``."""
        slope = weights.unsqueeze(-1) * points.mT
        power, basis = torch.linalg.eigh(gram - slope @ slope.mT)
        small = 1e-12 * power.abs().max()
        self.minus = (basis * power.clamp_max(0.0).abs().sqrt())[:, power < -small]
        return torch.cat([(basis * power.clamp_min(0.0).sqrt())[:, power > small], slope], 1)

    def marginal(self, d: int) -> SigmaPoints:
        """The points as a function of the first ``d`` components sees them: those that coincide are one."""
        points, weights, extra, signed = self._rule
        seen, where = torch.unique(points[:d], dim=1, return_inverse=True)
        merged = torch.zeros(seen.shape[1], dtype=weights.dtype).index_add(0, where, weights)
        around = (seen.norm(dim=0) > 0) & (merged.abs() > 1e-14)
        return SigmaPoints(seen[:, around], merged[around], extra, signed=signed)

    def forward(self, function: Function, belief: Gaussian, difference: Difference) -> Linearised:
        """See ``Rule``."""
        mean, root = belief
        points, combine = self.points.to(mean), self.combine.to(mean)
        values = function(mean.unsqueeze(-2) + points @ root.mT)
        centre = values[..., :1, :]
        around = difference(values[..., 1:, :], centre).mT
        moments = around @ combine
        lost = None if self.minus is None else around @ self.minus.to(mean)
        return Linearised(centre.squeeze(-2) + moments[..., 0], moments[..., 1:], lost)


class Tangent(nn.Module):
    """The tangent at the mean: the rule of the extended Kalman filter, by forward-mode differentiation."""

    signed = False

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


def fifth_degree(n: int) -> SigmaPoints:
    """Fifth-degree fully symmetric rule: ``2 n^2 + 1`` points whose distance does not grow with ``n``.

    A centre, ``2 n`` points at ``sqrt(3)`` on the axes and ``2 n (n - 1)`` on their diagonals: 3-point Gauss-Hermite
    for n = 1, its product for n = 2.  From n = 5 on the weights on the axes are negative.

    Source: McNamee & Stenger (1967); Qin et al. (2018), eqs. (3)-(9).
    """
    return _symmetric(n, 3**0.5, (4 - n) / 18, 3**0.5, 1 / 36)


def spherical_fifth_degree(n: int) -> SigmaPoints:
    """Fifth-degree spherical-radial cubature: ``2 n^2 + 1`` points at ``sqrt(n + 2)``.

    From n = 5 on the weights on the axes are negative.

    Source: Jia, Xin & Cheng (2013), "High-degree Cubature Kalman Filter".
    """
    return _symmetric(n, (n + 2) ** 0.5, (4 - n) / (2 * (n + 2) ** 2), (n / 2 + 1) ** 0.5, 1 / (n + 2) ** 2)


def gauss_hermite(order: int) -> Callable[[int], SigmaPoints]:
    """Product of Gauss-Hermite rules: ``order^n`` points, exact up to degree ``2 order - 1`` in each component.

    Raises:
        ValueError: ``order`` below 2, or (when the rule is made for ``n``) more than 3000 points.

    Source: Ito & Xiong (2000), "Gaussian Filters for Nonlinear Filtering Problems".
    """
    if order < 2:
        raise ValueError(f"order: expected 2 or more points, received {order}")

    def rule(n: int) -> SigmaPoints:
        if order**n > 3000:
            raise ValueError(f"order: expected at most 3000 points in all, received {order}^{n}")
        at, weight = (torch.from_numpy(x) for x in np.polynomial.hermite_e.hermegauss(order))
        at = torch.where(at.abs() < 1e-12, 0.0, at)
        points = torch.cartesian_prod(*[at] * n).reshape(-1, n).mT
        weights = torch.cartesian_prod(*[weight / weight.sum()] * n).reshape(-1, n).prod(-1)
        around = points.norm(dim=0) > 0
        return SigmaPoints(points[:, around], weights[around])

    return rule


def _symmetric(n: int, on_axis: float, axis_weight: float, on_diagonal: float, diagonal_weight: float) -> SigmaPoints:
    """A centre, points on all axes, and points on the diagonals of all pairs of them."""
    eye = torch.eye(n, dtype=torch.float64)
    axes = on_axis * torch.cat([eye, -eye])
    pairs = [a * eye[i] + b * eye[j] for i, j in combinations(range(n), 2) for a in (1, -1) for b in (1, -1)]
    diagonals = on_diagonal * torch.stack(pairs) if pairs else eye[:0]
    weights = torch.tensor([axis_weight] * len(axes) + [diagonal_weight] * len(pairs), dtype=torch.float64)
    return SigmaPoints(torch.cat([axes, diagonals]).mT, weights, signed=True)


def tangent(n: int) -> Tangent:
    """The rule of the extended Kalman filter, for any number of states.

    Source: Jazwinski (1970), "Stochastic Processes and Filtering Theory", ch. 8.
    """
    return Tangent()
