"""Rules by name: cubature of third and fifth degree, unscented, Gauss-Hermite, and first-order."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import combinations

import numpy as np
import torch

from torchfra.gaussian.rules import FirstOrder, SigmaPoints
from torchfra.numbers import as_number


def third_degree(n: int) -> SigmaPoints:
    """Third-degree spherical-radial cubature: ``2 n`` points at ``sqrt(n)``, equal weights.

    Source: Arasaratnam & Haykin (2009), "Cubature Kalman Filters", eqs. (31)-(32).

    Example:
        >>> belief = torchfra.Gaussian(torch.tensor([1.0]), torch.tensor([[0.5]]))
        >>> torchfra.gaussian.third_degree(1)(torch.square, belief, torch.sub).value  # 1^2 + 0.5^2
        tensor([1.2500])
    """
    eye = torch.eye(n, dtype=torch.float64)
    return SigmaPoints(n**0.5 * torch.cat([eye, -eye], 1), torch.full((2 * n,), 0.5 / n, dtype=torch.float64))


def unscented(alpha: float = 1.0, beta: float = 0.0, kappa: float = 1.0) -> Callable[[int], SigmaPoints]:
    """Scaled unscented transform: ``2 n`` points at ``alpha sqrt(n + kappa)`` and a centre.

    The centre's weight in the covariance may be negative only if ``beta >= alpha^2``.
    ``unscented(1, 0, 0)`` is ``third_degree``.

    The differences to the centre lose the digits of ``alpha^2``: those of an ``alpha`` of 0.001 need float64.

    Raises:
        ValueError: ``alpha`` not above 0, or (when the rule is made for ``n``) ``n + kappa`` not above 0 or no real
            root of the covariance; or (where it is used) too small an ``alpha`` for the dtype.

    Source: Julier & Uhlmann (2004), "Unscented Filtering and Nonlinear Estimation"; van der Merwe (2004).
    """
    if not as_number(alpha) > 0:
        raise ValueError(f"alpha: expected a value above 0, received {alpha!r}")
    if not math.isfinite(as_number(beta)):
        raise ValueError(f"beta: expected a finite number, received {beta!r}")

    def rule(n: int) -> SigmaPoints:
        if not n + as_number(kappa) > 0:
            raise ValueError(f"kappa: expected a value above {-n} for {n} states, received {kappa!r}")
        scale = alpha**2 * (n + kappa)
        eye = torch.eye(n, dtype=torch.float64)
        weights = torch.full((2 * n,), 0.5 / scale, dtype=torch.float64)
        return SigmaPoints(scale**0.5 * torch.cat([eye, -eye], 1), weights, 1.0 - alpha**2 + beta)

    return rule


def fifth_degree(n: int) -> SigmaPoints:
    """Fifth-degree fully symmetric rule: ``2 n^2 + 1`` points whose distance from the centre is the same for any ``n``.

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


def first_order(n: int) -> FirstOrder:
    """The rule of the extended Kalman filter, for any state dimension.

    Source: Jazwinski (1970), "Stochastic Processes and Filtering Theory", ch. 8.
    """
    return FirstOrder()
