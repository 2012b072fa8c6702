"""Rules that carry a Gaussian through a function: sigma points of several kinds, and the first-order rule of the EKF.

Each rule is a statistical linearisation.  For ``x ~ N(mean, S S^T)``

    f(x) ~ value + slope S^-1 (x - mean) + e,

so ``slope`` is ``H S``: the slope ``H`` in ``x`` times the root.  The error ``e`` is uncorrelated with ``x`` and has
the covariance ``rest rest^T``, or ``rest rest^T - subtracted subtracted^T`` where weights are negative.  All Gaussian
filters of this package are the same square-root algebra around such a rule.
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
"""Subtracts two values ``(..., m)``, with angles wrapped."""


_KEPT = 1e-4
"""Relative rounding error of a mean that a rule may have: four digits, a metre in 10 km."""
_ROUNDING = 2 * torch.finfo(torch.float32).eps
"""Relative rounding error of the difference of two values in single precision, that of their points included."""


class Linearised(NamedTuple):
    """``value (..., m)`` and ``spread (..., m, r + n) = [rest, slope]`` of the linearisation above."""

    value: Tensor
    spread: Tensor
    subtracted: Tensor | None = None
    """``(..., m, k)``, only of rules with negative weights."""


class Rule(Protocol):
    """A rule for ``n`` states: it evaluates a function at ``p`` points in one call."""

    signed: bool
    """Whether some weights are negative, so that a covariance may not be positive definite."""

    def __call__(self, function: Function, belief: Gaussian, difference: Difference) -> Linearised:
        """Carry ``belief (..., n)`` through ``function (p, ..., n) -> (p, ..., m)``: the points are in front.

        ``difference`` subtracts two values ``(..., m)``.
        """
        ...

    def marginal(self, d: int) -> Rule:
        """The rule for functions that read the first ``d`` components alone."""
        ...


class SigmaPoints(nn.Module):
    """A centre and points around it, in units of the belief's root.

    The mean is the centre's value plus the weighted mean of the differences to it, so that angles have a mean.  The
    spread is a product with one constant matrix, whose last ``n`` columns are the slope and the others the rest.

    Args:
        points: ``(n, p)`` without the centre, ``sum_i w_i points_i points_i^T = I``.
        weights: ``(p,)``; the centre's weight in the mean is one minus their sum.
        extra: the centre's weight in the covariance less its weight in the mean.
        signed: whether weights may be negative.

    Raises:
        ValueError: not ``signed``, and a weight that is not positive or a centre so negative that the covariance has no
            real root; (where it is used) points so near the centre that rounding errors of the differences, times the
            weights, leave less than four digits in the dtype of the belief.
    """

    points: Tensor
    """``(1 + p, n)``, the centre first."""
    combine: Tensor
    """``(p, 1 + r + n)`` from differences to the centre's value to the mean's difference and the spread."""
    minus: Tensor | None
    """``(p, k)`` from the same differences to the subtracted root; None without negative weights."""

    def __init__(self, points: Tensor, weights: Tensor, extra: float = 0.0, *, signed: bool = False) -> None:
        super().__init__()
        points, weights = points[:, weights != 0], weights[weights != 0]
        self._rule, self._amplifies = (points, weights, extra, signed), float(weights.abs().sum())
        self._marginals = dict[int, SigmaPoints]()
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
        eigenvalues, basis = torch.linalg.eigh(gram)
        if eigenvalues[0] < -1e-12 * eigenvalues[-1]:
            raise ValueError(
                "weights: expected a centre whose weight leaves the covariance a real root, received one that is too "
                "negative: take beta >= alpha^2, or a larger kappa"
            )
        positive = eigenvalues > 1e-12 * eigenvalues[-1]  # equal weights that sum to one leave nothing in one direction
        root = basis[:, positive] * eigenvalues[positive].sqrt()
        # Of all roots, one whose first n columns are the slope: they correlate with the points, the others do not.
        rotation = torch.linalg.qr((points @ root).mT, mode="complete").Q
        root = root @ rotation
        root[:, : len(points)] *= (points @ root).diagonal().sign()  # QR leaves the signs open: the slope of x is +I
        root = torch.where(root.abs() < 1e-14 * root.abs().max(), 0.0, root)  # rounding: exactly zero
        ordered: Tensor = root.roll(-len(points), 1)
        return ordered

    def _split(self, gram: Tensor, points: Tensor, weights: Tensor) -> Tensor:
        """``[rest, slope]`` of an indefinite Gram matrix, whose negative part goes into ``minus``."""
        slope = weights.unsqueeze(-1) * points.mT
        eigenvalues, basis = torch.linalg.eigh(gram - slope @ slope.mT)
        small, root = 1e-12 * eigenvalues.abs().max(), basis * eigenvalues.abs().sqrt()
        self.minus = root[:, eigenvalues < -small]
        return torch.cat([root[:, eigenvalues > small], slope], 1)

    def marginal(self, d: int) -> SigmaPoints:
        """The points projected on the first ``d`` components; points that coincide become one."""
        if d not in self._marginals:
            self._marginals[d] = self._projected(d)
        return self._marginals[d]

    def _projected(self, d: int) -> SigmaPoints:
        points, weights, extra, signed = self._rule
        distinct, where = torch.unique(points[:d], dim=1, return_inverse=True)
        merged = torch.zeros(distinct.shape[1], dtype=weights.dtype).index_add(0, where, weights)
        around = (distinct.norm(dim=0) > 0) & (merged.abs() > 1e-14)
        return SigmaPoints(distinct[:, around], merged[around], extra, signed=signed)

    def forward(self, function: Function, belief: Gaussian, difference: Difference) -> Linearised:
        """The function's values at the points, in three matrix products for the whole batch."""
        mean, root = _same_batch(belief)
        if self._amplifies * torch.finfo(mean.dtype).eps > _KEPT:
            expected = f"weights whose sum leaves four digits in {mean.dtype}"
            received = f"points so near the centre that it is {self._amplifies:.2g}"
            raise ValueError(f"rule: expected {expected}, received {received}: take a larger alpha, or float64")
        points, combine = self.points.to(mean), self.combine.to(mean)
        values = function(mean + (root @ points.mT).movedim(-1, 0))
        centre, n = values[0], mean.shape[-1]
        around = difference(values[1:], centre)

        def combined(matrix: Tensor) -> Tensor:
            """Sums ``(..., m, k)`` of the differences, by a row for each entry of the batch and of the values."""
            return (around.flatten(1).mT @ matrix).reshape(*centre.shape, matrix.shape[1])

        def curvature(sums: Tensor, matrix: Tensor) -> Tensor:
            """Sums that are 0 of a linear function, without what rounding errors leave in single precision.

            Beside a wide prior that would be an error of the linearisation as large as the noise.
            """
            if mean.dtype != torch.float32:
                return sums  # of priors 1e14 times as wide as the noise
            largest = torch.maximum(around.detach().abs().amax(0), centre.detach().abs()).unsqueeze(-1)
            return torch.where(sums.abs() <= _ROUNDING * largest * matrix.abs().sum(0), 0.0, sums)

        moments = combined(combine)
        rest, slope = curvature(moments[..., :-n], combine[:, :-n]), moments[..., -n:]
        minus = None if self.minus is None else self.minus.to(mean)
        subtracted = None if minus is None else curvature(combined(minus), minus)
        return Linearised(centre + rest[..., 0], torch.cat([rest[..., 1:], slope], -1), subtracted)


class FirstOrder(nn.Module):
    """The first-order Taylor expansion at the mean, by forward-mode differentiation: the rule of the EKF."""

    signed = False

    def marginal(self, d: int) -> FirstOrder:
        """This rule itself, as it does not depend on the state dimension."""
        return self

    def forward(self, function: Function, belief: Gaussian, difference: Difference) -> Linearised:
        """The function's value at the mean, and its derivative along each column of the root."""
        mean, root = _same_batch(belief)
        along = root.movedim(-1, 0).contiguous()
        at = mean.expand_as(along).contiguous()  # the mean, once per column
        values, slope = torch.func.jvp(function, (at,), (along,))  # type: ignore[misc]  # three only with has_aux
        return Linearised(values[0], slope.movedim(0, -1))


def _same_batch(belief: Gaussian) -> Gaussian:
    """The belief with a root for each mean, also if the batch shares one root."""
    mean, root = belief
    return belief if root.dim() == mean.dim() + 1 else Gaussian(mean, root.expand(*mean.shape[:-1], *root.shape[-2:]))
