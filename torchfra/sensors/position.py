"""The position itself as the measurement."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.hyper import Value
from torchfra.sensors.base import Sensor


class Position(Sensor):
    """The position itself, m.

    Args:
        std: of the noise, m; a number or ``(..., dims)``.
        dims: dimensions of space.
        noise: root of a correlated noise, instead of ``std``.
    """

    def __init__(self, std: Value | None = None, *, dims: int = 2, noise: Tensor | None = None) -> None:
        super().__init__(dims, [False] * dims, std, noise)

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """See ``Sensor``."""
        return x[..., : self.size]

    def locate(self, z: Tensor) -> Tensor:
        """See ``Sensor``."""
        return z

    def metre(self, z: Tensor) -> Tensor:
        """See ``Sensor``."""
        return torch.ones_like(z)
