"""Turns of known rate."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra.hyper import Hyper, Value
from torchfra.linalg.triangular import tria
from torchfra.motion.base import Motion
from torchfra.motion.blocks import acceleration_gain, gauss_legendre, zero_padded
from torchfra.motion.polynomial import check_orders


class CoordinatedTurn(Motion):
    """A turn of known rate in the plane of the first two axes, the others at constant velocity.

    States ``[position, velocity]``.  A rate of 0 is ``ConstantVelocity``; gradients are right there too.

    Args:
        rate: rad/s, counter-clockwise from x to y; a tensor broadcasts with the batch.
        q: variance of the acceleration noise, m^2/s^4; of a spectral one its density, m^2/s^3.
        dims: dimensions of space, 2 or more.
        orders: 3 for states with an acceleration, which after each step is that of the turn.
        spectral: whether the acceleration is white noise in time, so that two short steps are the same as a long one;
            its integral is by Gauss-Legendre quadrature, exact to rounding for steps of up to two turns.

    Raises:
        ValueError: ``dims`` below 2, ``rate`` NaN or infinite, ``q`` below 0, ``orders`` neither 2 nor 3.

    Source: Li & Jilkov (2003), "Survey of Maneuvering Target Tracking. Part I", eq. (61).
    """

    linear = True

    def __init__(self, rate: Value, q: Value, dims: int = 2, *, orders: int = 2, spectral: bool = False) -> None:
        if dims < 2:
            raise ValueError(f"dims: expected 2 or more dimensions for a turn, received {dims}")
        super().__init__(dims, check_orders(orders), q)
        self.rate = Hyper(rate, constraints.real, name="rate")
        self.spectral = spectral

    def describe(self) -> str:
        """The turn with its rate, if that is a single one."""
        rates = self.rate().detach()
        return f"turn {math.degrees(rates):+.3g} deg/s" if rates.dim() == 0 else "turn"

    def transition(self, dt: Tensor) -> Tensor:
        """``F (..., n, n)`` for ``dt (...)``."""
        return zero_padded(self._with_acceleration(self._moved(dt, self.rate(dt))), self.size)

    def _moved(self, dt: Tensor, rate: Tensor) -> Tensor:
        """The transition of position and velocity."""
        dt, angle = torch.broadcast_tensors(dt, rate * dt)
        # sin(a)/a and (1 - cos(a))/a, smooth at 0
        along, across = torch.sinc(angle / torch.pi), angle / 2 * torch.sinc(angle / (2 * torch.pi)).square()
        moved, turned = self._plane(along, across), self._plane(angle.cos(), angle.sin())
        still = torch.eye(self.dims, dtype=dt.dtype, device=dt.device).expand_as(turned)
        top, bottom = torch.cat([still, dt[..., None, None] * moved], -1), torch.cat([still * 0, turned], -1)
        return torch.cat([top, bottom], -2)

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., n, dims)``: ``sqrt(q) [dt^2/2; dt]``, and how the turn bends it; or by density."""
        if self.spectral:
            at, weight = gauss_legendre(dt)
            moved = self._moved(dt.unsqueeze(-1) * at, self.rate(dt).unsqueeze(-1))[..., self.dims :]
            columns = moved * (self.q(dt).sqrt() * dt.sqrt())[..., None, None, None] * weight.sqrt()[:, None, None]
            return self._with_acceleration(tria(columns.movedim(-3, -2).flatten(-2)))
        return self._with_acceleration(acceleration_gain(dt, self.q(dt), (2, 1), self.dims))

    def _with_acceleration(self, matrix: Tensor) -> Tensor:
        """The rows of position and velocity, and below them those of the acceleration if the state has it."""
        if self.orders == 2:
            return matrix
        rate = self.rate(matrix)
        zero = torch.zeros_like(rate)
        across = self._plane(zero, rate)
        across = across * torch.ones(self.dims, dtype=rate.dtype, device=rate.device).index_fill_(
            0, torch.arange(2, self.dims, device=rate.device), 0.0
        )
        velocity = matrix[..., self.dims :, :]
        batch = torch.broadcast_shapes(across.shape[:-2], velocity.shape[:-2])
        return torch.cat([matrix.expand(batch + matrix.shape[-2:]), across @ velocity], -2)

    def _plane(self, c: Tensor, s: Tensor) -> Tensor:
        """``(..., dims, dims)``: ``[[c, -s], [s, c]]`` in the plane of the turn, 1 on the other axes."""
        rows = torch.stack([torch.stack([c, -s], -1), torch.stack([s, c], -1)], -2)
        rest = torch.eye(self.dims, dtype=c.dtype, device=c.device)[2:]
        rows = torch.nn.functional.pad(rows, (0, self.dims - 2))
        return torch.cat([rows, rest.expand(c.shape + rest.shape)], -2)
