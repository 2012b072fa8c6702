"""Motions whose highest derivative stays as it is."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchfra.hyper import Value
from torchfra.motion.base import Motion, _per_axis, _taylor, _two_or_three, _wider


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

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., n, dims)``: ``sqrt(q) [dt^2/2; dt; 0]``."""
        gain = _taylor(dt, torch.tensor([2, 1], device=dt.device))
        root = _per_axis((self.q(dt).sqrt().unsqueeze(-1) * gain).unsqueeze(-1), self.dims)
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
