"""What sensors measure: the function, the difference of two measurements (angles wrap), and the noise.

Bearings count clockwise from the +y axis (north), ``atan2(dx, dy)``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchfra.angles import wrap
from torchfra.hyper import Hyper, Value
from torchfra.linalg.triangular import hstack, tria
from torchfra.tree import event_ranks


@event_ranks(std=1, scale=1, root=2, mix=2, log_norm=0)
class MeasurementNoise(NamedTuple):
    """Measurement noise of a step, ready to divide by.  A missing element weighs nothing."""

    std: Tensor
    """``(..., m)``, 1 where missing."""
    scale: Tensor
    """``(..., m)`` 1 / std, 0 where missing."""
    root: Tensor | None
    """``(..., m, m)`` lower root of a noise that is correlated between elements; else None."""
    mix: Tensor | None
    """``(..., m, m)`` its inverse, rows of missing elements zero; else None."""
    log_norm: Tensor
    """``(...)`` what the noise adds to the log density of the seen elements, constants included."""

    def whiten(self, x: Tensor) -> Tensor:
        """``x (..., m, k)`` in units of the noise."""
        return x * self.scale.unsqueeze(-1) if self.mix is None else self.mix @ x

    def colour(self, x: Tensor) -> Tensor:
        """``x (..., m, k)`` back in the units of the measurement."""
        return x * self.std.unsqueeze(-1) if self.root is None else self.root @ x


class Sensor(nn.Module):
    """Abstract: a subclass gives ``forward`` and tells the base its sizes, noise and angles.

    Args:
        reads: how many leading state components it looks at, ``d``.
        angles: for each of the ``m`` elements of a measurement, whether it is an angle in rad.
        std: standard deviation of the noise, a number or ``(..., m)`` that broadcasts with the batch.
        noise: instead of ``std``, a root ``(..., m, r)`` of a noise covariance that may be correlated.

    Raises:
        ValueError: both or neither of ``std`` and ``noise``, a shape that does not fit, a std that is not above 0, a
            noise covariance that is singular.
    """

    angles: Tensor
    root: Tensor | None
    blocks: tuple[tuple[int, ...], ...]
    """Elements of a measurement that share a device and so a trust in its noise; one unless a sensor says more."""

    def __init__(self, reads: int, angles: Sequence[bool], std: Value | None, noise: Tensor | None) -> None:
        super().__init__()
        self.reads, self.size = reads, len(angles)
        self.blocks = (tuple(range(self.size)),)
        self.std: Hyper | None = None
        self.register_buffer("root", None)
        if (std is None) == (noise is None):
            raise ValueError("std, noise: expected exactly one of the two")
        if std is not None:
            if isinstance(std, Tensor) and std.dim() and std.shape[-1] != self.size:
                raise ValueError(f"std: expected a number or (..., {self.size}), received {tuple(std.shape)}")
            self.std = Hyper(std, event_dim=int(isinstance(std, Tensor) and std.dim() > 0), name="std")
        if noise is not None:
            if noise.dim() < 2 or noise.shape[-2] != self.size:
                raise ValueError(f"noise: expected (..., {self.size}, r), received {tuple(noise.shape)}")
            self.root = tria(noise)
            rounding = 10 * torch.finfo(noise.dtype).eps * torch.linalg.vector_norm(noise, dim=-1)
            if not bool((self.root.diagonal(dim1=-2, dim2=-1) > rounding).all()):
                raise ValueError("noise: expected a root of a covariance that has an inverse, received a singular one")
        self._some, self._all = any(angles), all(angles)
        self.register_buffer("angles", torch.tensor(angles), persistent=False)

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """The measurement ``(..., m)`` of states ``x (..., d or more)``, without noise, given ``u (..., k)``."""
        raise TypeError(f"{type(self).__name__} needs a forward")

    def difference(self, a: Tensor, b: Tensor) -> Tensor:
        """``a - b`` of measurements ``(..., m)``, angles wrapped."""
        gap = a - b
        if self._all:
            return wrap(gap)
        return torch.where(self.angles, wrap(gap), gap) if self._some else gap

    def locate(self, z: Tensor) -> Tensor:
        """Where in space ``(..., dims)`` a measurement ``(..., m)`` lies, m.

        Raises:
            ValueError: it does not say where.
        """
        raise ValueError(
            f"sensor: expected one whose measurement says where the target is, received {type(self).__name__}"
        )

    def metre(self, z: Tensor) -> Tensor:
        """What a metre of space is in each element of a measurement ``(..., m)``, if each is a direction of space.

        Raises:
            ValueError: they are not.
        """
        raise ValueError(f"sensor: expected one that measures each direction of space, received {type(self).__name__}")

    def measurement_noise(self, z: Tensor, std: Tensor | None = None, root: Tensor | None = None) -> MeasurementNoise:
        """The noise of measurements ``z (..., m)``, of which NaN are missing.

        Args:
            z: the measurements.
            std: ``(..., m)``, to replace the sensor's own noise.
            root: ``(..., m, m)``, to replace it by a correlated one.
        """
        seen = ~z.isnan()
        if std is None and root is None:
            std, root = (None if self.std is None else self.std.elements()), self.root
        if std is not None:
            std = torch.where(seen, std.to(z), 1.0)
            return MeasurementNoise(std, seen / std, None, None, _log_norm(std, seen))
        assert root is not None
        # A missing element gets a unit of noise of its own, so that it mixes with none of the others.
        lower = tria(hstack(torch.where(seen.unsqueeze(-1), root.to(z), 0.0), torch.diag_embed(1.0 - seen.to(z))))
        eye = torch.eye(self.size, dtype=z.dtype, device=z.device).expand_as(lower)
        mix = torch.linalg.solve_triangular(lower, eye, upper=False) * seen.unsqueeze(-1)
        diagonal = lower.diagonal(dim1=-2, dim2=-1)
        return MeasurementNoise(diagonal, seen / diagonal, lower, mix, _log_norm(diagonal, seen))

    def extra_repr(self) -> str:
        """Sizes."""
        return f"size={self.size}, reads={self.reads}"


def _log_norm(std: Tensor, seen: Tensor) -> Tensor:
    return -(std.log() + 0.5 * math.log(2 * math.pi) * seen.to(std)).sum(-1)
