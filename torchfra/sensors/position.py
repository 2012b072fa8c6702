"""The position itself as the measurement."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.hyper import Value
from torchfra.sensors.base import Expected, Sensor
from torchfra.sensors.places import in_space


class Position(Sensor):
    """The position itself, m.

    Args:
        std: of the measurement noise, m; a number or ``(..., dims)``.
        dims: dimensions of space.
        noise: instead of ``std``, a root of the covariance of correlated measurement noise.

    Example:
        >>> torchfra.sensors.Position(std=2.0)(torch.tensor([3.0, 4.0, 0.5, 0.5]))
        tensor([3., 4.])
    """

    linear = locates = measures_each_direction = True

    def __init__(self, std: Value | None = None, *, dims: int = 2, noise: Tensor | None = None) -> None:
        super().__init__(dims, [False] * dims, std, noise)
        self.dims = dims

    @property
    def expects(self) -> Expected:  # type: ignore[override]  # of this sensor, not of the class
        """The positions that it reads."""
        return in_space(self.size)

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """The first ``dims`` components of the states."""
        return x[..., : self.size]

    def locate(self, z: Tensor) -> Tensor:
        """The measurement itself."""
        return z

    def units_per_metre(self, z: Tensor) -> Tensor:
        """1 for each element."""
        return torch.ones_like(z)
