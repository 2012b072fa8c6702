"""The density of false measurements."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchfra.association.gates import Candidates
from torchfra.hyper import Hyper, Part, Value
from torchfra.numbers import as_numbers
from torchfra.sensors.base import Sensor


class Clutter(Part):
    """Density of false measurements, uniform in space or in measurement space.

    Args:
        volume: volume of the region of space in which false measurements are uniform, m^3 (m^2 in the plane).  The
            sensor must measure every direction of space (``Sensor.measures_each_direction``).
        extent: ``(m,)`` instead, the extent of the region of measurement space in which they are uniform: the range of
            each element, in its unit.
        rate: expected number of false measurements per scan, Poisson.  None if any number of them is equally probable a
            priori (non-parametric).

    Raises:
        ValueError: both or neither of ``volume`` and ``extent``, or values that are not above 0.

    Source: Fortmann, Bar-Shalom & Scheffe (1983); Chen, Zou & Wu, eq. (25).  Differs: a density that is uniform in
    space is transformed to the units of the measurement, by ``r^2 cos(elevation)`` for range and two angles.
    """

    def __init__(
        self, volume: Value | None = None, *, extent: Tensor | Sequence[float] | None = None, rate: Value | None = None
    ) -> None:
        super().__init__()
        if (volume is None) == (extent is None):
            received = "neither" if volume is None else "both"
            raise ValueError(f"volume, extent: expected exactly one of the two, received {received}")
        self.volume = None if volume is None else Hyper(volume, name="volume")
        extent = None if extent is None else as_numbers(extent, "extent").double()
        self.extent = None if extent is None else Hyper(extent, event_dim=1, name="extent")
        self.rate = None if rate is None else Hyper(rate, name="rate")

    def check(self, sensor: Sensor) -> None:
        """Checks that the density fits a sensor.

        Raises:
            ValueError: it does not.
        """
        if self.extent is None:
            if not sensor.measures_each_direction:
                received = sensor.describe()
                raise ValueError(f"sensor: expected one that measures each direction of space, received {received}")
        elif self.extent().shape[-1:] != (sensor.size,):
            raise ValueError(f"extent: expected ({sensor.size},), received {tuple(self.extent().shape)}")

    def forward(self, candidates: Candidates, sensor: Sensor) -> Tensor:
        """Log density ``(..., N, J)`` at each measurement, over the elements that were measured."""
        z = candidates.z
        if self.extent is not None:
            extent = self.extent(z)
        else:
            assert self.volume is not None
            # A measured elevation may lie beyond the vertical, where the cosine is negative; at a range of 0 there is
            # no density, and no gate contains it.
            metre = sensor.units_per_metre(z).abs()
            metre = torch.where((metre > 0) & metre.isfinite(), metre, 1.0)
            extent = self.volume(z).unsqueeze(-1) ** (1 / sensor.size) * metre
        density: Tensor = -(candidates.measured * extent.log()).sum(-1)
        return density if self.rate is None else density + self.rate(z).log()

    def in_space(self, z: Tensor, sensor: Sensor) -> Tensor:
        """Log density per scan ``(...)`` at measurements ``(..., m)``, in 1 / m^dims.

        Raises:
            ValueError: no Poisson rate.
        """
        if self.rate is None:
            raise ValueError("rate: expected the rate of a Poisson distribution, received None")
        if self.volume is not None:
            density: Tensor = self.rate(z).log() - self.volume(z).log()
            return density.expand(z.shape[:-1])
        assert self.extent is not None
        metre = sensor.units_per_metre(z).abs().expand_as(z)
        density = self.rate(z).log() + (metre.log() - self.extent(z).log()).sum(-1)
        return density
