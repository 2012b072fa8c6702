"""How dense false measurements are."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchfra.association.gates import Candidates
from torchfra.hyper import Hyper, Value
from torchfra.sensors.base import Sensor


class Clutter(nn.Module):
    """How dense false measurements are, where one was measured.

    Args:
        volume: of the space that false measurements fall in evenly, m^3 (m^2 in the plane); the sensor must measure
            each direction of space (``Sensor.measures_each_direction``).
        extent: instead, of the measurements that false ones fall in evenly: ``(m,)`` from the lowest to the highest of
            each element, in its own unit.
        rate: expected false measurements per scan, Poisson; None if any number of them is alike beforehand
            (non-parametric).

    Raises:
        ValueError: both or neither of ``volume`` and ``extent``, or values that are not above 0.

    Source: Fortmann, Bar-Shalom & Scheffe (1983); Chen, Zou & Wu, eq. (25).  Differs: the density of false measurements
    that fall evenly in space is mapped to the measurement's own units, by ``r^2 cos(elevation)`` for angles and range.
    """

    def __init__(
        self, volume: Value | None = None, *, extent: Tensor | Sequence[float] | None = None, rate: Value | None = None
    ) -> None:
        super().__init__()
        if (volume is None) == (extent is None):
            raise ValueError("volume, extent: expected exactly one of the two")
        self.volume = None if volume is None else Hyper(volume, name="volume")
        extent = None if extent is None else torch.as_tensor(extent, dtype=torch.float64)
        self.extent = None if extent is None else Hyper(extent, event=1, name="extent")
        self.rate = None if rate is None else Hyper(rate, name="rate")

    def check(self, sensor: Sensor) -> None:
        """Whether this goes with a sensor.

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
        """Log density ``(..., N, J)``; of what was seen, where some elements are missing."""
        z = candidates.z
        if self.extent is not None:
            spans = self.extent(z)
        else:
            assert self.volume is not None
            # A measured elevation may be beyond the vertical; a range of 0, which no gate holds, has no density.
            metre = sensor.units_per_metre(z).abs()
            metre = torch.where((metre > 0) & metre.isfinite(), metre, 1.0)
            spans = self.volume(z).unsqueeze(-1) ** (1 / sensor.size) * metre
        found = -(candidates.seen * spans.log()).sum(-1)
        density: Tensor = found if self.rate is None else found + self.rate(z).log()
        return density
