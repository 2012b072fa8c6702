"""An infrared sensor and a laser, on states in modified spherical coordinates."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.coordinates import AZIMUTH, ELEVATION, INVERSE_RANGE, to_cartesian
from torchfra.hyper import Value
from torchfra.sensors.base import Expected, Sensor


class InfraredLaser(Sensor):
    """Infrared sensor and laser: azimuth and elevation, rad, and range, m, of modified spherical states.

    There are two blocks: ``[azimuth, elevation]`` of the infrared sensor, and the range of the laser.  A block that was
    not measured is NaN.

    Args:
        std: of the measurement noise, rad, rad, m, one for each element.
        noise: instead of ``std``, a root of the covariance of correlated measurement noise.

    Source: Chen, Zou & Wu, eqs. (8)-(9).  Differs: the text does not show what the laser measures; we assume the range.
    """

    locates = measures_each_direction = True

    def __init__(self, std: Value | None = None, *, noise: Tensor | None = None) -> None:
        super().__init__(6, [True, True, False], std, noise)
        self.blocks = ((0, 1), (2,))

    @property
    def expects(self) -> Expected:  # type: ignore[override]  # of this sensor, not of the class
        """The angles that it reads."""
        return [(AZIMUTH, ("angle",)), (ELEVATION, ("angle",))]

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """Angles and range ``(..., 3)`` of modified spherical states."""
        return torch.cat([x[..., AZIMUTH:INVERSE_RANGE], 1 / x[..., INVERSE_RANGE:]], -1)

    def locate(self, z: Tensor) -> Tensor:
        """The measured position ``(..., 3)``."""
        rates = torch.zeros_like(z[..., :1]).expand(*z.shape[:-1], 3)
        return to_cartesian(torch.cat([rates, z[..., :2], 1 / z[..., -1:]], -1))[..., :3]

    def units_per_metre(self, z: Tensor) -> Tensor:
        """1 for the range, and for an angle the inverse radius of its circle, rad/m."""
        away, level = z[..., 2], z[..., 1].cos()
        return torch.stack([1 / (away * level), 1 / away, torch.ones_like(away)], -1)

    def describe(self) -> str:
        """The infrared sensor and the laser."""
        return "infrared sensor with a laser's range"
