"""A Cartesian motion in modified spherical coordinates."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.angles import turned
from torchfra.coordinates import AZIMUTH, ELEVATION, _from_east, from_cartesian, jacobian, to_cartesian
from torchfra.linalg.triangular import apply
from torchfra.motion.base import Motion


class Spherical(Motion):
    """A Cartesian motion as one of modified spherical coordinates: there, a step, and back.

    The process noise is that of the Cartesian motion, mapped at the predicted mean.

    Args:
        motion: in space, of states ``[position, velocity]`` relative to the sensor: ``ConstantVelocity(q, 3)``,
            ``CoordinatedTurn(rate, q, 3)``.
        azimuth_from: ``"north"``, clockwise, or ``"east"``, counter-clockwise.

    Raises:
        ValueError: a motion of other states.

    Source: Chen, Zou & Wu, eqs. (3)-(7).  Differs: they add a process noise whose form is lost.
    """

    angles = (AZIMUTH,)

    def __init__(self, motion: Motion, azimuth_from: str = "north") -> None:
        if (motion.dims, motion.size) != (3, 6) or motion.stacked:
            raise ValueError(f"motion: expected one of 3 positions and 3 velocities, received {motion.describe()}")
        _from_east(azimuth_from)
        super().__init__(3, 2, None)
        self.cartesian, self.azimuth_from = motion, azimuth_from

    def forward(self, x: Tensor, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """See ``Motion``."""
        start = to_cartesian(x, self.azimuth_from)
        once = dt.squeeze(-1) if dt.dim() and dt.shape[-1] == 1 else dt  # the same for all points of a rule
        matrix = self.cartesian.transition(once)
        if matrix is None:
            moved = self.cartesian(start, dt, u)
        else:
            shift = self.cartesian.shift(dt, u)
            wide = matrix.unsqueeze(-3) if once is not dt and matrix.dim() > 2 else matrix
            moved = apply(wide, start) if shift is None else apply(wide, start) + shift
        return from_cartesian(moved, self.azimuth_from)

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., 6, q)`` in Cartesian coordinates."""
        return self.cartesian.process_noise(dt)

    def process_noise_at(self, noise: Tensor, mean: Tensor) -> Tensor:
        """See ``Motion``: eqs. (4), (15)."""
        return jacobian(mean, self.azimuth_from) @ noise

    def canonical(self, mean: Tensor) -> Tensor:
        """See ``Motion``."""
        return torch.cat([mean[..., :AZIMUTH], turned(mean[..., AZIMUTH:ELEVATION]), mean[..., ELEVATION:]], -1)

    def describe(self) -> str:
        """See ``Motion``."""
        return f"{self.cartesian.describe()} in modified spherical coordinates"
