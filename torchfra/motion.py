"""How targets move: the transition and a square root of the process noise, both following the time step.

States list positions first, then velocities, then accelerations: ``[x, y, vx, vy, ax, ay]`` in m, m/s, m/s^2.
"""

from __future__ import annotations

import math
import re
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import constraints
from torch.nn.functional import pad

from torchfra.hyper import Hyper, Value
from torchfra.linalg import apply
from torchfra.sensors import wrap


class Adaptation(NamedTuple):
    """How a linear motion follows the acceleration that is estimated before a step, taken as known."""

    lift: Tensor
    """``(..., n, dims)`` what one unit of it adds to the state."""
    size: Tensor
    """``(..., 2)`` factor of the noise for a positive and a negative one."""
    slope: Tensor
    """``(..., 2)`` what the size of one takes off that factor, as a share per m/s^2, down to 0."""

    def __call__(self, mean: Tensor, shift: Tensor | None, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Shift ``(..., n)`` and noise ``(..., n, q)`` of a step from ``mean (..., n)``."""
        dims = self.lift.shape[-1]
        level = mean[..., -dims:]
        size, slope = (torch.where(level < 0, x[..., 1:], x[..., :1]) for x in (self.size, self.slope))
        scale = size * (1 - slope * level.abs()).clamp_min(0.0)
        scale = torch.cat([scale] * (mean.shape[-1] // dims), -1)
        own = apply(self.lift, level)
        return own if shift is None else shift + own, noise * scale.unsqueeze(-1)


class Motion(nn.Module):
    """Abstract: how a state goes on over ``dt``, and how uncertain that is.

    A linear motion gives ``transition``, any other ``forward``; either may replace ``noise`` and ``shift``.

    Args:
        dims: dimensions of space; they come first in the state.
        orders: derivatives in the state, position included: 2 up to velocity, 3 up to acceleration.
        q: variance of the noise acceleration, m^2/s^4, constant over a step and independent between steps and axes
            (so that two short steps are not the same as a long one).  A tensor broadcasts with the batch.  None for a
            motion that has its noise from elsewhere.

    Raises:
        ValueError: ``dims`` below 1, ``q`` below 0.
    """

    stacked = 0
    """Dimensions between batch and state in what it gives: 1 for several motions side by side."""
    angles: tuple[int, ...] = ()
    """Components of the state that are angles, rad."""

    def __init__(self, dims: int, orders: int, q: Value | None) -> None:
        super().__init__()
        if dims < 1:
            raise ValueError(f"dims: expected 1 or more dimensions of space, received {dims}")
        self.dims, self.orders, self.size = dims, orders, dims * orders
        self.position, self.velocity = slice(0, dims), slice(dims, 2 * dims)
        if q is not None:
            self.q = Hyper(q, constraints.nonnegative, name="q")

    def forward(self, x: Tensor, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """The state ``(..., n)`` after ``dt (...)`` seconds, without noise."""
        matrix, shift = self.transition(dt), self.shift(dt, u)
        if matrix is None:
            raise TypeError(f"{type(self).__name__} needs a forward or a transition")
        return apply(matrix, x) if shift is None else apply(matrix, x) + shift

    def transition(self, dt: Tensor) -> Tensor | None:
        """``F (..., n, n)`` for ``dt (...)`` if the motion is linear: filters then carry it exactly, without points."""
        return None

    def shift(self, dt: Tensor, u: Tensor | None) -> Tensor | None:
        """A known change of the state, ``(..., n)``, on top of a linear transition: control, or a moving frame."""
        return None

    def adaptation(self, dt: Tensor) -> Adaptation | None:
        """How shift and noise follow the state that a step starts from, if they do."""
        return None

    def noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., n, dims)`` for ``dt (...)``: a root of the process noise covariance, ``sqrt(q) [dt^2/2; dt; 1]``.

        Source: Wang et al. (2021), eqs. (3)-(4).
        """
        gain = _taylor(dt, torch.arange(2, 2 - self.orders, -1, device=dt.device))
        return _per_axis((self.q().to(dt).sqrt().unsqueeze(-1) * gain).unsqueeze(-1), self.dims)

    def local(self, noise: Tensor, mean: Tensor) -> Tensor:
        """The root of the process noise ``(..., n, q)`` at a predicted mean ``(..., n)``, if it depends on that."""
        return noise

    def difference(self, a: Tensor, b: Tensor) -> Tensor:
        """``a - b`` of states ``(..., n)``, angles within half a turn."""
        gap = a - b
        if not self.angles:
            return gap
        turns = torch.tensor([i in self.angles for i in range(self.size)], device=gap.device)
        return torch.where(turns, wrap(gap), gap)

    def canonical(self, mean: Tensor) -> Tensor:
        """The same state ``(..., n)`` with its angles as this motion writes them."""
        return mean

    def said(self) -> str:
        """For people: what it is, in a few words."""
        return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", type(self).__name__).lower()

    def extra_repr(self) -> str:
        """Dimensions of space and of the state."""
        return f"dims={self.dims}, size={self.size}"


class _Polynomial(Motion):
    """The highest derivative in the state stays as it is."""

    def transition(self, dt: Tensor) -> Tensor:
        """``F (..., n, n)``: ``dt^k / k!`` from each derivative to the one k below it."""
        order = torch.arange(self.orders, device=dt.device)
        ahead = order - order.unsqueeze(-1)
        matrix = torch.where(ahead >= 0, _taylor(dt.unsqueeze(-1), ahead.clamp_min(0)), 0.0)
        return _per_axis(matrix, self.dims)


class ConstantVelocity(_Polynomial):
    """Constant velocity, disturbed by accelerations: states ``[position, velocity]``.

    Args:
        q: variance of the noise acceleration, m^2/s^4.
        dims: dimensions of space.
        orders: 3 for states with an acceleration, which is 0 after each step: the form that interacting models share.

    Raises:
        ValueError: ``orders`` neither 2 nor 3.
    """

    def __init__(self, q: Value, dims: int = 2, *, orders: int = 2) -> None:
        super().__init__(dims, _two_or_three(orders), q)

    def transition(self, dt: Tensor) -> Tensor:
        """``F (..., n, n)`` for ``dt (...)``."""
        matrix = super().transition(dt)
        return _wider(matrix[..., : 2 * self.dims, : 2 * self.dims], self.size)

    def noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., n, dims)``: ``sqrt(q) [dt^2/2; dt; 0]``."""
        gain = _taylor(dt, torch.tensor([2, 1], device=dt.device))
        root = _per_axis((self.q().to(dt).sqrt().unsqueeze(-1) * gain).unsqueeze(-1), self.dims)
        return pad(root, (0, 0, 0, self.size - 2 * self.dims))


class ConstantAcceleration(_Polynomial):
    """Constant acceleration, disturbed: states ``[position, velocity, acceleration]``.

    Args:
        q: variance of the change of acceleration per step, m^2/s^4.
        dims: dimensions of space.

    Source: Wang et al. (2021), eqs. (1)-(4).
    """

    def __init__(self, q: Value, dims: int = 2) -> None:
        super().__init__(dims, 3, q)


class CoordinatedTurn(Motion):
    """A turn of known rate in the plane of the first two axes, the others at constant velocity.

    States ``[position, velocity]``.  A rate of 0 is ``ConstantVelocity``; gradients are right there too.

    Args:
        rate: rad/s, counter-clockwise from x to y; a tensor broadcasts with the batch.
        q: variance of the noise acceleration, m^2/s^4.
        dims: dimensions of space, 2 or more.
        orders: 3 for states with an acceleration, which after each step is that of the turn.

    Raises:
        ValueError: ``dims`` below 2, ``rate`` not a number, ``q`` below 0, ``orders`` neither 2 nor 3.

    Source: Li & Jilkov (2003), "Survey of Maneuvering Target Tracking. Part I", eq. (61).
    """

    def __init__(self, rate: Value, q: Value, dims: int = 2, *, orders: int = 2) -> None:
        if dims < 2:
            raise ValueError(f"dims: expected 2 or more dimensions for a turn, received {dims}")
        super().__init__(dims, _two_or_three(orders), q)
        self.rate = Hyper(rate, constraints.real, name="rate")

    def said(self) -> str:
        """See ``Motion``."""
        rates = self.rate().detach()
        return f"turn {math.degrees(rates):+.3g} deg/s" if rates.dim() == 0 else "turn"

    def transition(self, dt: Tensor) -> Tensor:
        """``F (..., n, n)`` for ``dt (...)``."""
        dt, angle = torch.broadcast_tensors(dt, self.rate().to(dt) * dt)
        # sin(a)/a and (1 - cos(a))/a, smooth at 0
        along, across = torch.sinc(angle / torch.pi), angle / 2 * torch.sinc(angle / (2 * torch.pi)).square()
        moved, turned = self._plane(along, across), self._plane(angle.cos(), angle.sin())
        still = torch.eye(self.dims, dtype=dt.dtype, device=dt.device).expand_as(turned)
        top, bottom = torch.cat([still, dt[..., None, None] * moved], -1), torch.cat([still * 0, turned], -1)
        return self._with_acceleration(torch.cat([top, bottom], -2))

    def noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., n, dims)``: ``sqrt(q) [dt^2/2; dt]``, and what the turn makes of the velocity."""
        gain = _taylor(dt, torch.tensor([2, 1], device=dt.device))
        root = _per_axis((self.q().to(dt).sqrt().unsqueeze(-1) * gain).unsqueeze(-1), self.dims)
        return self._with_acceleration(root, square=False)

    def _with_acceleration(self, matrix: Tensor, square: bool = True) -> Tensor:
        """The rows of position and velocity, and below them those of the acceleration if the state has it."""
        if self.orders == 2:
            return matrix
        rate = self.rate().to(matrix)
        zero = torch.zeros_like(rate)
        across = self._plane(zero, rate)
        across = across * torch.ones(self.dims, dtype=rate.dtype, device=rate.device).index_fill_(
            0, torch.arange(2, self.dims, device=rate.device), 0.0
        )
        velocity = matrix[..., self.dims :, :]
        batch = torch.broadcast_shapes(across.shape[:-2], velocity.shape[:-2])
        rows = torch.cat([matrix.expand(batch + matrix.shape[-2:]), across @ velocity], -2)
        return _wider(rows, self.size) if square else rows

    def _plane(self, c: Tensor, s: Tensor) -> Tensor:
        rows = torch.stack([torch.stack([c, -s], -1), torch.stack([s, c], -1)], -2)
        rest = torch.eye(self.dims, dtype=c.dtype, device=c.device)[2:]
        rows = torch.nn.functional.pad(rows, (0, self.dims - 2))
        return torch.cat([rows, rest.expand(c.shape + rest.shape)], -2)


def _two_or_three(orders: int) -> int:
    if orders not in (2, 3):
        raise ValueError(f"orders: expected 2 or 3, received {orders}")
    return orders


def _wider(matrix: Tensor, size: int) -> Tensor:
    """Filled up with zeros to ``(..., size, size)``."""
    return pad(matrix, (0, size - matrix.shape[-1], 0, size - matrix.shape[-2]))


def _taylor(dt: Tensor, power: Tensor) -> Tensor:
    """``dt^k / k!`` for every k in ``power``, in a new last dimension (or, for a square of powers, the last of dt)."""
    factorial = torch.exp(torch.lgamma(power.to(dt) + 1)).round()
    return dt.unsqueeze(-1) ** power / factorial


def _per_axis(block: Tensor, dims: int) -> Tensor:
    """Kronecker product with the identity over the axes: ``(..., a, b) -> (..., a dims, b dims)``."""
    eye = torch.eye(dims, dtype=block.dtype, device=block.device)
    product = block.unsqueeze(-2).unsqueeze(-1) * eye.unsqueeze(-2)
    return product.flatten(-2).flatten(-3, -2)
