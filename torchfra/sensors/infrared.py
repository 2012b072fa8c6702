"""An infrared sensor and a laser, on states in modified spherical coordinates."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.coordinates import AZIMUTH, CLOSENESS, _from_east, to_cartesian
from torchfra.hyper import Value, one_of
from torchfra.sensors.base import Sensor


class InfraredLaser(Sensor):
    """Infrared sensor and laser: azimuth and elevation, rad, and range, m, of modified spherical states.

    Two blocks of noise: ``[azimuth, elevation]`` of the infrared sensor and what the laser measures.  A block that did
    not measure is NaN.

    Args:
        std: of the noise, rad, rad[, rad, rad], m, one for each element.
        laser: ``"range"``; ``"all"`` for azimuth, elevation and range of its own (five elements); ``"none"`` for the
            infrared sensor alone, from which the range cannot be told unless the sensor manoeuvres.
        azimuth_from: of the states, see ``Spherical``.
        noise: root of a correlated noise, instead of ``std``.

    Raises:
        ValueError: an argument that is none of those.

    Source: Chen, Zou & Wu, eqs. (8)-(9).  Differs: what the laser measures is lost; range is our reading.
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
        _from_east(azimuth_from)
        extra = {"range": [False], "all": [True, True, False], "none": []}[laser]
        super().__init__(6, [True, True, *extra], std, noise)
        self.laser, self.azimuth_from = laser, azimuth_from
        own = tuple(range(2, self.size))
        self.blocks = ((0, 1), own) if own else ((0, 1),)

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """See ``Sensor``."""
        angles, away = x[..., AZIMUTH:CLOSENESS], 1 / x[..., CLOSENESS:]
        parts = {"range": [angles, away], "all": [angles, angles, away], "none": [angles]}[self.laser]
        return torch.cat(parts, -1)

    def locate(self, z: Tensor) -> Tensor:
        """See ``Sensor``; by the infrared sensor's angles."""
        self._needs_range()
        rates = torch.zeros_like(z[..., :1]).expand(*z.shape[:-1], 3)
        return to_cartesian(torch.cat([rates, z[..., :2], 1 / z[..., -1:]], -1), self.azimuth_from)[..., :3]

    def metre(self, z: Tensor) -> Tensor:
        """See ``Sensor``."""
        self._needs_range()
        if self.laser == "all":
            raise ValueError("laser: expected one measurement of each angle, received two")
        away, level = z[..., 2], z[..., 1].cos()
        return torch.stack([1 / (away * level), 1 / away, torch.ones_like(away)], -1)

    def _needs_range(self) -> None:
        if self.laser == "none":
            raise ValueError("laser: expected a range for a place in space, received none")
