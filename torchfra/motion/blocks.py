"""Matrices that motions are built from: powers of the time step, and one axis repeated for all of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from torchfra.linalg.triangular import tria


def taylor(dt: Tensor, power: Tensor) -> Tensor:
    """``dt^k / k!`` for every k in ``power``, in a new last dimension (or, for a square of powers, the last of dt)."""
    factorial = torch.exp(torch.lgamma(power.to(dt) + 1)).round()
    return dt.unsqueeze(-1) ** power / factorial


def per_axis(block: Tensor, dims: int) -> Tensor:
    """Kronecker product with the identity over the axes: ``(..., a, b) -> (..., a dims, b dims)``."""
    eye = torch.eye(dims, dtype=block.dtype, device=block.device)
    product = block.unsqueeze(-2).unsqueeze(-1) * eye.unsqueeze(-2)
    return product.flatten(-2).flatten(-3, -2)


def zero_padded(matrix: Tensor, size: int) -> Tensor:
    """``(..., a, b)`` padded with zeros to ``(..., size, size)``."""
    return pad(matrix, (0, size - matrix.shape[-1], 0, size - matrix.shape[-2]))


def acceleration_gain(dt: Tensor, variance: Tensor, powers: Sequence[int], dims: int) -> Tensor:
    """``sqrt(variance) dt^k / k!`` for every k in ``powers``, per axis: ``(..., len(powers) dims, dims)``.

    It is the root of the process noise by one acceleration (or change of it) per step, constant over the step.
    """
    gain = taylor(dt, torch.tensor(powers, device=dt.device))
    return per_axis((variance.sqrt().unsqueeze(-1) * gain).unsqueeze(-1), dims)


def white_root(dt: Tensor, density: Tensor, orders: int, dims: int) -> Tensor:
    """Process noise root ``(..., orders dims, orders dims)`` by white noise of a density on the highest derivative.

    The effect of the noise on each derivative is a power of the time since; the columns of the root are the
    coefficients of these powers in normalised Legendre polynomials on the step.
    """

    def share(k: int, j: int) -> float:  # of the power k in polynomial j
        if j > k:
            return 0.0
        return math.sqrt(2 * j + 1) * math.factorial(k) / (math.factorial(k - j) * math.factorial(k + j + 1))

    powers = range(orders - 1, -1, -1)
    unit = torch.tensor([[share(k, j) for j in range(orders)] for k in powers], dtype=dt.dtype, device=dt.device)
    power = torch.tensor(powers, dtype=dt.dtype, device=dt.device) + 0.5
    scale = (density.sqrt() * torch.ones_like(dt)).unsqueeze(-1) * dt.unsqueeze(-1) ** power
    return per_axis(scale.unsqueeze(-1) * unit, dims)


def gauss_legendre(like: Tensor, points: int) -> tuple[Tensor, Tensor]:
    """Nodes and weights of Gauss-Legendre quadrature on [0, 1]."""
    at, weight = (torch.tensor(x, dtype=like.dtype, device=like.device) for x in _gauss_legendre(points))
    return at, weight


@lru_cache(maxsize=2)
def _gauss_legendre(points: int) -> tuple[list[float], list[float]]:
    at, weight = np.polynomial.legendre.leggauss(points)
    return ((at + 1) / 2).tolist(), (weight / 2).tolist()


def driven(response: Callable[[Tensor], Tensor], dt: Tensor, variance: Tensor, *, continuous: bool) -> Tensor:
    """Root of the process noise by ``r`` disturbances over a step of ``dt (...)`` seconds.

    It is computed in each step, by a quadrature of few points: exact to rounding along arcs of up to half a turn.

    Args:
        response: from the seconds ``(..., 10)`` since a unit disturbance to its effect ``(..., 10, n, r)`` on a state.
        dt: seconds.
        variance: ``(..., r)`` of each disturbance, constant over the step; with ``continuous`` the density.
        continuous: whether the disturbances are white noise in time.
    """
    at, weight = gauss_legendre(dt, 10)
    columns = response(dt.unsqueeze(-1) * at) * variance.sqrt()[..., None, None, :]
    dt, weight = dt[..., None, None, None], weight[:, None, None]
    if not continuous:
        return (columns * (dt * weight)).sum(-3)
    return tria((columns * (dt * weight).sqrt()).movedim(-3, -2).flatten(-2))


def sinc(angle: Tensor) -> Tensor:
    """``sin(a) / a`` with all derivatives, also at 0: there the second one of ``torch.sinc`` is NaN, nearby rough."""
    small, near, safe = _near_zero(angle)
    return torch.where(small, _series(near, 1), safe.sin() / safe)


def arc(angle: Tensor) -> tuple[Tensor, Tensor]:
    """``sin(a) / a`` and ``(1 - cos(a)) / a``, smooth at 0: extent of a unit arc along its start and across."""
    return sinc(angle), angle / 2 * sinc(angle / 2).square()


def arc_of_rate(angle: Tensor) -> tuple[Tensor, Tensor]:
    """``(a - sin(a)) / a^2`` and ``(1 - cos(a)) / a^2``, smooth at 0: the derivative of an arc by its turn rate."""
    return angle * arc_and_chord(angle), sinc(angle / 2).square() / 2


def arc_and_chord(angle: Tensor) -> Tensor:
    """``(a - sin(a)) / a^3``, smooth at 0."""
    small, near, safe = _near_zero(angle)
    return torch.where(small, _series(near, 3), (1 - safe.sin() / safe) / safe.square())


def _near_zero(angle: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Whether an angle is small, and the angle twice: its square where it is, else 0, and itself where not, else 1."""
    small = angle.abs() < 0.5
    return small, torch.where(small, angle, 0.0).square(), torch.where(small, 1.0, angle)


def _series(square: Tensor, first: int) -> Tensor:
    """``1 / first! - square / (first + 2)! + square^2 / (first + 4)! - ...``, to rounding for squares below 1/4."""
    series = torch.zeros_like(square)
    for k in range(7, -1, -1):
        series = 1 / math.factorial(2 * k + first) - square * series
    return series
