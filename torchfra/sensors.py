"""What sensors measure: the function, the difference of two measurements (angles wrap), and the noise.

Bearings count clockwise from the +y axis (north), ``atan2(dx, dy)``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchfra.hyper import Hyper, Value
from torchfra.linalg import hstack, tria


def wrap(angle: Tensor) -> Tensor:
    """The same angle within half a turn either way, rad."""
    return angle - 2 * math.pi * torch.round(angle / (2 * math.pi))


class Noise(NamedTuple):
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
            self.std = Hyper(std, event=int(isinstance(std, Tensor) and std.dim() > 0), name="std")
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

    def noise(self, z: Tensor, std: Tensor | None = None, root: Tensor | None = None) -> Noise:
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
            return Noise(std, seen / std, None, None, _log_norm(std, seen))
        assert root is not None
        # A missing element gets a unit of noise of its own, so that it mixes with none of the others.
        lower = tria(hstack(torch.where(seen.unsqueeze(-1), root.to(z), 0.0), torch.diag_embed(1.0 - seen.to(z))))
        eye = torch.eye(self.size, dtype=z.dtype, device=z.device).expand_as(lower)
        mix = torch.linalg.solve_triangular(lower, eye, upper=False) * seen.unsqueeze(-1)
        diagonal = lower.diagonal(dim1=-2, dim2=-1)
        return Noise(diagonal, seen / diagonal, lower, mix, _log_norm(diagonal, seen))

    def extra_repr(self) -> str:
        """Sizes."""
        return f"size={self.size}, reads={self.reads}"


def _log_norm(std: Tensor, seen: Tensor) -> Tensor:
    return -(std.log() + 0.5 * math.log(2 * math.pi) * seen.to(std)).sum(-1)


class Bearings(Sensor):
    """Bearings of the target from stations in the plane, clockwise from +y, rad.

    Args:
        std: of the noise, rad; a number or ``(..., m)`` with one per station.
        count: stations whose positions come with each step: ``u (..., 2 count)`` is ``[x1, y1, x2, y2, ...]``, m.
        stations: ``(m, 2)`` positions of stations that stand still, m; ``u`` is not looked at then.
        noise: root of a correlated noise, instead of ``std``.

    Source: Wang et al. (2021), eq. (6), with all four quadrants.
    """

    stations: Tensor | None

    def __init__(
        self,
        std: Value | None = None,
        *,
        count: int = 2,
        stations: Tensor | None = None,
        noise: Tensor | None = None,
    ) -> None:
        if stations is not None and (stations.dim() != 2 or stations.shape[-1] != 2):
            raise ValueError(f"stations: expected (m, 2), received {tuple(stations.shape)}")
        super().__init__(2, [True] * (count if stations is None else len(stations)), std, noise)
        self.register_buffer("stations", stations)

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """See ``Sensor``."""
        if self.stations is not None:
            stations = self.stations.to(x)
        elif u is not None:
            stations = u[..., : 2 * self.size].unflatten(-1, (self.size, 2))
        else:
            raise ValueError(
                f"u: expected the positions of {self.size} stations, (..., {2 * self.size}), received None"
            )
        offset = x[..., None, :2] - stations
        return torch.atan2(offset[..., 0], offset[..., 1])


class RangeBearing(Sensor):
    """Range, bearing clockwise from +y and, in space, elevation above the plane: m, rad, rad.

    Args:
        std: of the noise: ``(..., m)`` in m, rad[, rad].
        dims: 2 for range and bearing, 3 with elevation.
        noise: root of a correlated noise, instead of ``std``.

    The sensor stands at the origin, or at ``u (..., dims)`` if that is given.
    """

    def __init__(self, std: Value | None = None, *, dims: int = 2, noise: Tensor | None = None) -> None:
        if dims not in (2, 3):
            raise ValueError(f"dims: expected 2 or 3, received {dims}")
        super().__init__(dims, [False, True, True][:dims], std, noise)

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """See ``Sensor``."""
        offset = x[..., : self.size] if u is None else x[..., : self.size] - u[..., : self.size]
        ground = torch.hypot(offset[..., 0], offset[..., 1])
        bearing = torch.atan2(offset[..., 0], offset[..., 1])
        if self.size == 2:
            return torch.stack([ground, bearing], -1)
        up = offset[..., 2]
        return torch.stack([torch.hypot(ground, up), bearing, torch.atan2(up, ground)], -1)

    def locate(self, z: Tensor) -> Tensor:
        """See ``Sensor``; from where the sensor stands."""
        level = z[..., 0] if self.size == 2 else z[..., 0] * z[..., 2].cos()
        plane = [level * z[..., 1].sin(), level * z[..., 1].cos()]
        return torch.stack(plane if self.size == 2 else [*plane, z[..., 0] * z[..., 2].sin()], -1)

    def metre(self, z: Tensor) -> Tensor:
        """See ``Sensor``."""
        away = z[..., 0]
        one = torch.ones_like(away)
        if self.size == 2:
            return torch.stack([one, 1 / away], -1)
        return torch.stack([one, 1 / (away * z[..., 2].cos()), 1 / away], -1)


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
