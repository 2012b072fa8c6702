"""Motions driven by noise all the time: white jerk, Singer's, and the current statistical model.

States ``[position, velocity, acceleration]``, ``da/dt = -alpha (a - level) + noise``.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra.hyper import Hyper, Value
from torchfra.linalg.triangular import tria
from torchfra.motion.base import Adaptation, Motion, _per_axis
from torchfra.motion.polynomial import ConstantAcceleration


class WhiteJerk(ConstantAcceleration):
    """Constant acceleration, disturbed all the time by a white jerk: two short steps are the same as a long one.

    Args:
        q: its power spectral density, m^2/s^5: variance of the acceleration that a second adds.
        dims: dimensions of space.

    Raises:
        ValueError: a value out of its range.

    Source: Bar-Shalom, Li & Kirubarajan (2001), section 6.2.3.
    """

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., n, n)`` for ``dt (...)``."""
        return _per_axis(self.q(dt).sqrt()[..., None, None] * _root(torch.zeros_like(dt), dt), self.dims)


class Singer(Motion):
    """Acceleration of zero mean, correlated over some ``1 / alpha`` seconds.

    Args:
        q: variance of the acceleration itself, m^2/s^4.
        alpha: 1/s; towards 0 it is constant acceleration.
        dims: dimensions of space.

    The root of the process noise comes from its integral by Gauss' rule, which has no cancellation for small ``alpha
    dt``; it is exact to rounding for ``alpha dt`` up to 16.

    Raises:
        ValueError: a value out of its range.

    Source: Singer (1970), "Estimating Optimal Tracking Filter Performance for Manned Maneuvering Targets".
    """

    def __init__(self, q: Value, alpha: Value, dims: int = 2) -> None:
        super().__init__(dims, 3, q)
        self.alpha = Hyper(alpha, constraints.nonnegative, name="alpha")

    def transition(self, dt: Tensor) -> Tensor:
        """``F (..., n, n)`` for ``dt (...)``."""
        rows = _response(self.alpha(dt), dt)
        one, zero = torch.ones_like(rows[0]), torch.zeros_like(rows[0])
        ahead = dt.expand_as(one)
        block = torch.stack([one, ahead, rows[0], zero, one, rows[1], zero, zero, rows[2]], -1)
        return _per_axis(block.unflatten(-1, (3, 3)), self.dims)

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., n, n)`` for ``dt (...)``."""
        return _per_axis(self.q(dt).sqrt()[..., None, None] * self._root(dt), self.dims)

    def _root(self, dt: Tensor) -> Tensor:
        """Of the noise covariance of one axis, ``(..., 3, 3)``, for an acceleration of variance 1."""
        alpha = self.alpha(dt)
        root: Tensor = (2 * alpha).sqrt()[..., None, None] * _root(alpha, dt)
        return root


class CurrentStatistical(Singer):
    """Singer's motion around the acceleration of the moment, of which more is the less likely the nearer the limit.

    The level is the estimated acceleration before the step, taken as known; the variance is that of a Rayleigh density
    between the level and the limit, ``(4 - pi) / pi (limit - |level|)^2`` per axis, and 0 beyond it.

    Args:
        alpha: 1/s.
        limit: largest acceleration, m/s^2.
        below: largest acceleration the other way, m/s^2; ``limit`` if None.
        dims: dimensions of space.

    Raises:
        ValueError: a value out of its range.

    Source: Zhou & Kumar (1984), "A 'Current' Statistical Model and Adaptive Algorithm for Estimating Maneuvering
    Targets".
    """

    def __init__(self, alpha: Value, limit: Value, below: Value | None = None, dims: int = 2) -> None:
        Motion.__init__(self, dims, 3, None)
        self.alpha = Hyper(alpha, constraints.nonnegative, name="alpha")
        self.limit = Hyper(limit, name="limit")
        self.below = None if below is None else Hyper(below, name="below")

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., n, n)`` for ``dt (...)`` at no acceleration."""
        spread = math.sqrt((4 - math.pi) / math.pi) * self.limit(dt)
        return _per_axis(spread[..., None, None] * self._root(dt), self.dims)

    def adaptation(self, dt: Tensor) -> Adaptation:
        """See ``Motion``: the level moves the state, and scales the noise of each axis."""
        rows = _response(self.alpha(dt), dt)
        moved = torch.stack([dt**2 / 2 - rows[0], dt - rows[1], 1 - rows[2]], -1)
        limit, below = ((x or self.limit)(dt) for x in (self.limit, self.below))
        limit, below, _ = torch.broadcast_tensors(limit, below, dt)
        size, slope = torch.stack([limit / limit, below / limit], -1), torch.stack([1 / limit, 1 / below], -1)
        return Adaptation(_per_axis(moved.unsqueeze(-1), self.dims), size, slope)


def _root(alpha: Tensor, dt: Tensor) -> Tensor:
    """Of the noise covariance of one axis, ``(..., 3, 3)``, for white noise of density 1."""
    at, weight = (torch.tensor(x, dtype=dt.dtype, device=dt.device) for x in _gauss())
    alpha, dt = torch.broadcast_tensors(alpha, dt)
    columns = torch.stack(_response(alpha.unsqueeze(-1), dt.unsqueeze(-1) * at), -2)
    return tria(columns * dt.sqrt()[..., None, None] * weight.sqrt())


def _response(alpha: Tensor, dt: Tensor) -> list[Tensor]:
    """What an acceleration of 1 becomes after ``dt``: position, velocity and acceleration."""
    x = -alpha * dt
    one, two = _phi(x)
    return [dt**2 * two, dt * one, x.exp()]


def _phi(x: Tensor) -> tuple[Tensor, Tensor]:
    """``(e^x - 1) / x`` and ``(e^x - 1 - x) / x^2``, smooth at 0."""
    small = x.abs() < 0.5
    safe = torch.where(small, -1.0, x)
    one = torch.expm1(safe) / safe
    series = [torch.zeros_like(x), torch.zeros_like(x)]
    near = torch.where(small, x, 0.0)
    for k in range(15, -1, -1):
        series = [s * near + 1 / math.factorial(k + order) for s, order in zip(series, (1, 2), strict=True)]
    return torch.where(small, series[0], one), torch.where(small, series[1], (one - 1) / safe)


@lru_cache(maxsize=1)
def _gauss() -> tuple[list[float], list[float]]:
    """Nodes and weights on [0, 1]."""
    at, weight = np.polynomial.legendre.leggauss(20)
    return ((at + 1) / 2).tolist(), (weight / 2).tolist()
