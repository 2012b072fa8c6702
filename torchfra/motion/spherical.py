"""A Cartesian motion in modified spherical coordinates."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.angles import turned
from torchfra.coordinates import AZIMUTH, ELEVATION, PLACE, RATES, from_cartesian, jacobian, to_cartesian
from torchfra.motion.base import Motion

COMPONENTS = ("omega", "elevation rate", "range rate / range", "azimuth", "elevation", "inverse range")
KINDS = ("rate", "rate", "other", "angle", "angle", "other")


class Spherical(Motion):
    """A Cartesian motion in modified spherical coordinates: a step maps the state to Cartesian ones and back.

    States are those of ``torchfra.coordinates``: rates first, then azimuth, elevation and inverse range, so that
    ``velocity`` is ``slice(0, 3)`` and ``position`` ``slice(3, 6)``.  The process noise is that of the Cartesian
    motion, mapped at the predicted mean.

    Args:
        motion: in space, of states ``[position, velocity]`` relative to the sensor, such as ``ConstantVelocity(q, 3)``
            or ``CoordinatedTurn(rate, q, 3)``.

    Raises:
        ValueError: a motion of other states.

    Source: Chen, Zou & Wu, eqs. (3)-(7).  Differs: they add a process noise whose form the text does not show.
    """

    angles = (AZIMUTH,)

    def __init__(self, motion: Motion) -> None:
        if (motion.dims, motion.size) != (3, 6) or motion.stacked:
            raise ValueError(f"motion: expected one of 3 positions and 3 velocities, received {motion.describe()}")
        super().__init__(3, 2, None, position=PLACE, velocity=RATES, components=COMPONENTS, kinds=KINDS)
        self.cartesian = motion

    def forward(self, x: Tensor, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """The state ``(..., 6)`` after ``dt (...)`` seconds, without process noise."""
        return from_cartesian(self.cartesian(to_cartesian(x), dt, u))

    def at_points(self, x: Tensor, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """``forward`` for points ``(p, ..., 6)`` of one step, with one transition for all."""
        return from_cartesian(self.cartesian.at_points(to_cartesian(x), dt, u))

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., 6, r)`` in Cartesian coordinates."""
        return self.cartesian.process_noise(dt)

    def process_noise_at(self, process_noise: Tensor, mean: Tensor, dt: Tensor) -> Tensor:
        """The root in modified spherical coordinates, at a predicted mean ``(..., 6)``: eqs. (4), (15)."""
        if not self.cartesian.linear:
            process_noise = self.cartesian.process_noise_at(process_noise, to_cartesian(mean), dt)
        return jacobian(mean) @ process_noise

    def canonical(self, mean: Tensor) -> Tensor:
        """The state ``(..., 6)`` with its azimuth in [0, 2 pi)."""
        return torch.cat([mean[..., :AZIMUTH], turned(mean[..., AZIMUTH:ELEVATION]), mean[..., ELEVATION:]], -1)

    def describe(self) -> str:
        """The description of the Cartesian motion, "in modified spherical coordinates"."""
        return f"{self.cartesian.describe()} in modified spherical coordinates"
