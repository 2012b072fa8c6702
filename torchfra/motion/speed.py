"""Motion at a nearly constant speed in a direction that changes at random."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra.hyper import Hyper, Value
from torchfra.motion.base import Motion
from torchfra.motion.blocks import acceleration_gain, white_root


class ConstantSpeed(Motion):
    """Nearly constant speed in a direction that changes at random.

    States ``[position, velocity]``.  Accelerations across the velocity are those of turns at random rates and have the
    variance ``q + wander speed^2``; along it they have the variance ``q``, so that the speed hardly changes.  The mean
    moves straight on.

    Args:
        q: variance of the acceleration noise in every direction, m^2/s^4; with ``continuous`` its density, m^2/s^3.
        wander: variance of the turn rate about every axis across the velocity, rad^2/s^2; with ``continuous`` its
            density, rad^2/s.
        dims: dimensions of space.
        continuous: whether the noise is white in time, so that two short steps are the same as a long one, and not
            constant over each step.

    Raises:
        ValueError: ``dims`` below 1, ``q`` not above 0, ``wander`` below 0.

    Source: Li & Jilkov (2003), "Survey of Maneuvering Target Tracking. Part I": accelerations across the velocity keep
    the speed.  Differs: they are noise here.
    """

    usual_layout = True

    def __init__(self, q: Value, wander: Value, dims: int = 3, *, continuous: bool = False) -> None:
        super().__init__(dims, 2, None)
        self.q = Hyper(q, finite=True, name="q")
        self.wander = Hyper(wander, constraints.nonnegative, finite=True, name="wander")
        self.continuous = continuous

    def forward(self, x: Tensor, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """The state ``(..., n)`` after ``dt (...)`` seconds, straight on."""
        position, velocity = x.split(self.dims, -1)
        return torch.cat([position + dt.unsqueeze(-1) * velocity, velocity + 0 * dt.unsqueeze(-1)], -1)

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., n, r)`` for ``dt (...)``, at rest."""
        if self.continuous:
            return white_root(dt, self.q(dt), 2, self.dims)
        return acceleration_gain(dt, self.q(dt), (2, 1), self.dims)

    def process_noise_at(self, process_noise: Tensor, mean: Tensor, dt: Tensor) -> Tensor:
        """The root ``(..., n, r)`` at a predicted mean ``(..., n)``: that at rest times one of the acceleration noise.

        ``q I + wander (|v|^2 I - v v^T)`` has the root ``a I - b v v^T``, which is smooth at ``v = 0``.
        """
        velocity, q, wander = mean[..., self.dims :], self.q(mean), self.wander(mean)
        across = (q + wander * velocity.square().sum(-1)).sqrt()
        along = (wander / (across + q.sqrt()))[..., None, None] * velocity.unsqueeze(-1) * velocity.unsqueeze(-2)
        eye = torch.eye(self.dims, dtype=mean.dtype, device=mean.device)
        root = (across[..., None, None] * eye - along) / q.sqrt()[..., None, None]
        each: Tensor = process_noise.unflatten(-1, (-1, self.dims)) @ root.unsqueeze(-3)
        return each.flatten(-2)
