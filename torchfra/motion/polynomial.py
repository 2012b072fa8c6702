"""Motions whose highest derivative is constant: constant velocity and constant acceleration."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchfra.hyper import Value
from torchfra.motion.base import Motion
from torchfra.motion.blocks import acceleration_gain, per_axis, taylor, white_root, zero_padded


class _Polynomial(Motion):
    """Abstract: the highest derivative in the state is constant."""

    linear = usual_layout = True

    def transition(self, dt: Tensor) -> Tensor:
        """``F (..., n, n)``: ``dt^k / k!`` from each derivative to the one k below it."""
        order = torch.arange(self.orders, device=dt.device)
        power = order - order.unsqueeze(-1)
        matrix = torch.where(power >= 0, taylor(dt.unsqueeze(-1), power.clamp_min(0)), 0.0)
        return per_axis(matrix, self.dims)


class ConstantVelocity(_Polynomial):
    """Constant velocity, disturbed by accelerations: states ``[position, velocity]``.

    Args:
        q: variance of the acceleration noise, m^2/s^4; with ``continuous`` its density, m^2/s^3.
        dims: dimensions of space.
        orders: 3 for states with an acceleration, which is 0 after each step: the form that interacting models share.
        continuous: whether the acceleration is white noise in time, so that two short steps are the same as a long one,
            and not constant over each step.

    Raises:
        ValueError: ``dims`` below 1, ``q`` below 0, ``orders`` neither 2 nor 3.

    Source: Bar-Shalom, Li & Kirubarajan (2001), section 6.3.2, piecewise constant, and 6.2.2, ``continuous``.

    Example:
        >>> torchfra.motion.ConstantVelocity(q=1.0, dims=1).transition(torch.tensor(2.0))
        tensor([[1., 2.],
                [0., 1.]])
    """

    def __init__(self, q: Value, dims: int = 2, *, orders: int = 2, continuous: bool = False) -> None:
        super().__init__(dims, check_orders(orders), q)
        self.continuous = continuous

    def transition(self, dt: Tensor) -> Tensor:
        """``F (..., n, n)`` for ``dt (...)``."""
        matrix = super().transition(dt)
        return zero_padded(matrix[..., : 2 * self.dims, : 2 * self.dims], self.size)

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., n, dims)``: ``sqrt(q) [dt^2/2; dt; 0]``; with ``continuous`` ``(..., n, 2 dims)``."""
        q = self.q(dt)
        root = white_root(dt, q, 2, self.dims) if self.continuous else acceleration_gain(dt, q, (2, 1), self.dims)
        return pad(root, (0, 0, 0, self.size - root.shape[-2]))


class ConstantAcceleration(_Polynomial):
    """Constant acceleration, disturbed: states ``[position, velocity, acceleration]``.

    Args:
        q: variance of the change of acceleration per step, m^2/s^4; with ``continuous`` the jerk's density, m^2/s^5.
        dims: dimensions of space.
        continuous: whether the jerk is white noise in time, so that two short steps are the same as a long one.

    Raises:
        ValueError: ``dims`` below 1, ``q`` below 0.

    Source: Wang et al. (2021), eqs. (1)-(4); Bar-Shalom, Li & Kirubarajan (2001), 6.3.3, and 6.2.3 for ``continuous``.
    """

    def __init__(self, q: Value, dims: int = 2, *, continuous: bool = False) -> None:
        super().__init__(dims, 3, q)
        self.continuous = continuous

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., n, dims)``: ``sqrt(q) [dt^2/2; dt; 1]``; with ``continuous`` ``(..., n, n)``."""
        return white_root(dt, self.q(dt), 3, self.dims) if self.continuous else super().process_noise(dt)


def check_orders(orders: int) -> int:
    """Checks the number of derivatives of a motion whose states may have an acceleration.

    Raises:
        ValueError: it is neither 2 nor 3.
    """
    if orders not in (2, 3):
        raise ValueError(f"orders: expected 2 or 3, received {orders}")
    return orders
