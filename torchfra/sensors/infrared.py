"""An infrared sensor and a laser, on states in modified spherical coordinates."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.coordinates import AZIMUTH, ELEVATION, INVERSE_RANGE, from_east, to_cartesian
from torchfra.hyper import Value, one_of
from torchfra.sensors.base import Expected, Sensor


class InfraredLaser(Sensor):
    """Infrared sensor and laser: azimuth and elevation, rad, and range, m, of modified spherical states.

    There are two blocks: ``[azimuth, elevation]`` of the infrared sensor, and the elements of the laser.  A block that
    was not measured is NaN.

    Args:
        std: of the measurement noise, rad, rad[, rad, rad], m, one for each element.
        laser: ``"range"``; ``"all"`` for another azimuth and elevation beside the range (five elements); ``"none"`` for
            the infrared sensor alone, from which the range is not observable unless the sensor manoeuvres.
        azimuth_from: of the states, see ``Spherical``.
        noise: instead of ``std``, a root of the covariance of correlated measurement noise.

    Raises:
        ValueError: an unknown ``laser`` or ``azimuth_from``, or see ``Sensor``.

    Source: Chen, Zou & Wu, eqs. (8)-(9).  Differs: the text does not show what the laser measures; we assume the range.
    """

    def __init__(
        self,
        std: Value | None = None,
        *,
        laser: str = "range",
        azimuth_from: str = "north",
        noise: Tensor | None = None,
    ) -> None:
        one_of(laser=(laser, ("range", "all", "none")))
        from_east(azimuth_from)
        extra = {"range": [False], "all": [True, True, False], "none": []}[laser]
        super().__init__(6, [True, True, *extra], std, noise)
        self.laser, self.azimuth_from = laser, azimuth_from
        of_laser = tuple(range(2, self.size))
        self.blocks = ((0, 1), of_laser) if of_laser else ((0, 1),)

    @property
    def locates(self) -> bool:  # type: ignore[override]  # of this sensor, not of the class
        """Whether the laser measures the range."""
        return self.laser != "none"

    @property
    def measures_each_direction(self) -> bool:  # type: ignore[override]  # of this sensor, not of the class
        """Whether each angle is measured once, and the range."""
        return self.laser == "range"

    @property
    def expects(self) -> Expected:  # type: ignore[override]  # of this sensor, not of the class
        """The angles that it reads."""
        return [(AZIMUTH, ("angle",)), (ELEVATION, ("angle",))]

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """Angles and ranges ``(..., m)`` of modified spherical states."""
        angles, away = x[..., AZIMUTH:INVERSE_RANGE], 1 / x[..., INVERSE_RANGE:]
        parts = {"range": [angles, away], "all": [angles, angles, away], "none": [angles]}[self.laser]
        return torch.cat(parts, -1)

    def locate(self, z: Tensor) -> Tensor:
        """The measured position ``(..., 3)``, by the infrared sensor's angles.

        Raises:
            ValueError: without a range.
        """
        if not self.locates:
            return super().locate(z)
        rates = torch.zeros_like(z[..., :1]).expand(*z.shape[:-1], 3)
        return to_cartesian(torch.cat([rates, z[..., :2], 1 / z[..., -1:]], -1), self.azimuth_from)[..., :3]

    def units_per_metre(self, z: Tensor) -> Tensor:
        """1 for the range, and for an angle the inverse radius of its circle, rad/m.

        Raises:
            ValueError: without a range, or with two measurements of each angle.
        """
        if not self.measures_each_direction:
            return super().units_per_metre(z)
        away, level = z[..., 2], z[..., 1].cos()
        return torch.stack([1 / (away * level), 1 / away, torch.ones_like(away)], -1)

    def describe(self) -> str:
        """The infrared sensor and what the laser measures."""
        beside = {"range": "with a laser's range", "all": "with a laser's angles and range", "none": "without a laser"}
        return f"infrared sensor {beside[self.laser]}"
