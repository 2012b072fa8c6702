"""How targets move: the transition and a square root of the process noise, both following the time step.

States list positions first, then velocities, then accelerations: ``[x, y, vx, vy, ax, ay]`` in m, m/s, m/s^2.
"""

from __future__ import annotations

import re
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import constraints
from torch.nn.functional import pad

from torchfra.angles import wrap
from torchfra.hyper import Hyper, Value
from torchfra.linalg.triangular import apply
from torchfra.tree import event_ranks


@event_ranks(lift=2, size=1, slope=1)
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

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., n, dims)`` for ``dt (...)``: a root of the process noise covariance, ``sqrt(q) [dt^2/2; dt; 1]``.

        Source: Wang et al. (2021), eqs. (3)-(4).
        """
        gain = _taylor(dt, torch.arange(2, 2 - self.orders, -1, device=dt.device))
        return _per_axis((self.q(dt).sqrt().unsqueeze(-1) * gain).unsqueeze(-1), self.dims)

    def process_noise_at(self, noise: Tensor, mean: Tensor) -> Tensor:
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

    def describe(self) -> str:
        """For people: what it is, in a few words."""
        return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", type(self).__name__).lower()

    def extra_repr(self) -> str:
        """Dimensions of space and of the state."""
        return f"dims={self.dims}, size={self.size}"


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
