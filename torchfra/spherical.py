"""Modified spherical coordinates: what a sensor at the origin sees, and how fast that changes relative to the range.

A state is ``[omega, elevation rate, d ln(range)/dt, azimuth, elevation, 1 / range]`` in rad/s, rad/s, 1/s, rad, rad,
1/m with ``omega = azimuth rate * cos(elevation)``; its Cartesian counterpart is ``[x, y, z, vx, vy, vz]``: east, north,
up. Azimuth counts from north (+y) clockwise, in [0, 2 pi), or from east (+x) counter-clockwise; elevation from the
horizontal plane up.  Straight above and below the sensor the coordinates do not exist: numbers there are NaN.

Source: Stallard (1991), "Angle-only tracking filter in modified spherical coordinates"; Mallick et al. (2012), whose
order this is; Chen, Zou & Wu, eqs. (1)-(2).  Jacobians are ours, in the axes of the line of sight.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.hyper import Value, one_of
from torchfra.linalg import apply, tria
from torchfra.motion import Motion
from torchfra.sensors import Sensor
from torchfra.types import Gaussian

RATES, AZIMUTH, ELEVATION, CLOSENESS = slice(0, 3), 3, 4, 5


class _Axes(NamedTuple):
    """Unit vectors ``(..., 3)`` of the line of sight."""

    out: Tensor
    across: Tensor
    up: Tensor


def to_cartesian(x: Tensor, azimuth_from: str = "north") -> Tensor:
    """``[position, velocity] (..., 6)`` of states ``(..., 6)``, m and m/s.  Source: Chen, Zou & Wu, eq. (1)."""
    axes, away = _axes(x, azimuth_from), 1 / x[..., CLOSENESS:]
    omega, climb, opening = x[..., RATES].split(1, -1)
    return torch.cat([away * axes.out, away * (opening * axes.out + omega * axes.across + climb * axes.up)], -1)


def from_cartesian(x: Tensor, azimuth_from: str = "north") -> Tensor:
    """States ``(..., 6)`` of ``[position, velocity] (..., 6)``.  Source: Chen, Zou & Wu, eq. (2)."""
    first, second, z, v_first, v_second, vz = x.unbind(-1)
    if _from_east(azimuth_from):
        first, second, v_first, v_second = second, first, v_second, v_first
    ground_squared = first.square() + second.square()
    away_squared = ground_squared + z.square()
    ground, away = ground_squared.sqrt(), away_squared.sqrt()
    along = first * v_first + second * v_second
    return torch.stack(
        [
            (second * v_first - first * v_second) / (ground * away),
            (vz * ground_squared - z * along) / (away_squared * ground),
            (along + z * vz) / away_squared,
            turned(torch.atan2(first, second)),
            torch.atan2(z, ground),
            1 / away,
        ],
        -1,
    )


def turned(azimuth: Tensor) -> Tensor:
    """The same azimuth in [0, 2 pi)."""
    whole = 2 * math.pi
    positive = azimuth - whole * torch.floor(azimuth / whole)
    return torch.where(positive >= whole, positive - whole, positive)  # what rounding makes of next to nothing below 0


def jacobian(x: Tensor, azimuth_from: str = "north") -> Tensor:
    """``(..., 6, 6)`` of ``from_cartesian``, by the state ``(..., 6)`` it leads to."""
    axes, close = _axes(x, azimuth_from), x[..., CLOSENESS:]
    omega, climb, opening = x[..., RATES].split(1, -1)
    slope = torch.tan(x[..., ELEVATION : ELEVATION + 1])
    nothing = torch.zeros_like(axes.out)
    rows = [
        (-(opening - climb * slope) * axes.across - omega * axes.out, axes.across),
        (-opening * axes.up - omega * slope * axes.across - climb * axes.out, axes.up),
        (omega * axes.across + climb * axes.up - opening * axes.out, axes.out),
        (axes.across / torch.cos(x[..., ELEVATION : ELEVATION + 1]), nothing),
        (axes.up, nothing),
        (-close * axes.out, nothing),
    ]
    return close.unsqueeze(-1) * torch.stack([torch.cat(row, -1) for row in rows], -2)


def cartesian_jacobian(x: Tensor, azimuth_from: str = "north") -> Tensor:
    """``(..., 6, 6)`` of ``to_cartesian`` at the state ``(..., 6)``: the inverse of ``jacobian``."""
    axes, away = _axes(x, azimuth_from), 1 / x[..., CLOSENESS:]
    omega, climb, opening = x[..., RATES].split(1, -1)
    elevation = x[..., ELEVATION : ELEVATION + 1]
    level, high = torch.cos(elevation), torch.sin(elevation)
    nothing = torch.zeros_like(axes.out)
    speed = opening * axes.out + omega * axes.across + climb * axes.up
    round_about = (opening * level - climb * high) * axes.across - omega * (level * axes.out - high * axes.up)
    columns = [
        (nothing, axes.across),
        (nothing, axes.up),
        (nothing, axes.out),
        (level * axes.across, round_about),
        (axes.up, opening * axes.up - climb * axes.out),
        (-away * axes.out, -away * speed),
    ]
    return away.unsqueeze(-1) * torch.stack([torch.cat(column, -1) for column in columns], -1)


def belief_from_cartesian(belief: Gaussian, azimuth_from: str = "north") -> Gaussian:
    """The belief in modified spherical coordinates, to first order, ``J P J^T``.  Source: Chen, Zou & Wu, eq. (10)."""
    mean = from_cartesian(belief.mean, azimuth_from)
    return Gaussian(mean, tria(jacobian(mean, azimuth_from) @ belief.scale_tril))


def belief_to_cartesian(belief: Gaussian, azimuth_from: str = "north") -> Gaussian:
    """The belief in Cartesian coordinates, to first order."""
    slope = cartesian_jacobian(belief.mean, azimuth_from)
    return Gaussian(to_cartesian(belief.mean, azimuth_from), tria(slope @ belief.scale_tril))


def _from_east(azimuth_from: str) -> bool:
    one_of(azimuth_from=(azimuth_from, ("north", "east")))
    return azimuth_from == "east"


def _axes(x: Tensor, azimuth_from: str) -> _Axes:
    azimuth, elevation = x[..., AZIMUTH], x[..., ELEVATION]
    sine, cosine, level, high = azimuth.sin(), azimuth.cos(), elevation.cos(), elevation.sin()
    nothing = torch.zeros_like(sine)
    order = (1, 0, 2) if _from_east(azimuth_from) else (0, 1, 2)

    def vector(*parts: Tensor) -> Tensor:
        return torch.stack([parts[i] for i in order], -1)

    return _Axes(
        vector(level * sine, level * cosine, high),
        vector(cosine, -sine, nothing),
        vector(-high * sine, -high * cosine, level),
    )


class Spherical(Motion):
    """A Cartesian motion as one of modified spherical coordinates: there, a step, and back.

    The process noise is that of the Cartesian motion, mapped at the predicted mean.

    Args:
        motion: in space, of states ``[position, velocity]`` relative to the sensor: ``ConstantVelocity(q, 3)``,
            ``CoordinatedTurn(rate, q, 3)``.
        azimuth_from: ``"north"``, clockwise, or ``"east"``, counter-clockwise.

    Raises:
        ValueError: a motion of other states.

    Source: Chen, Zou & Wu, eqs. (3)-(7).  Differs: they add a process noise whose form is lost.
    """

    angles = (AZIMUTH,)

    def __init__(self, motion: Motion, azimuth_from: str = "north") -> None:
        if (motion.dims, motion.size) != (3, 6) or motion.stacked:
            raise ValueError(f"motion: expected one of 3 positions and 3 velocities, received {motion.said()}")
        _from_east(azimuth_from)
        super().__init__(3, 2, None)
        self.cartesian, self.azimuth_from = motion, azimuth_from

    def forward(self, x: Tensor, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """See ``Motion``."""
        start = to_cartesian(x, self.azimuth_from)
        once = dt.squeeze(-1) if dt.dim() and dt.shape[-1] == 1 else dt  # the same for all points of a rule
        matrix = self.cartesian.transition(once)
        if matrix is None:
            moved = self.cartesian(start, dt, u)
        else:
            shift = self.cartesian.shift(dt, u)
            wide = matrix.unsqueeze(-3) if once is not dt and matrix.dim() > 2 else matrix
            moved = apply(wide, start) if shift is None else apply(wide, start) + shift
        return from_cartesian(moved, self.azimuth_from)

    def noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., 6, q)`` in Cartesian coordinates."""
        return self.cartesian.noise(dt)

    def local(self, noise: Tensor, mean: Tensor) -> Tensor:
        """See ``Motion``: eqs. (4), (15)."""
        return jacobian(mean, self.azimuth_from) @ noise

    def canonical(self, mean: Tensor) -> Tensor:
        """See ``Motion``."""
        return torch.cat([mean[..., :AZIMUTH], turned(mean[..., AZIMUTH:ELEVATION]), mean[..., ELEVATION:]], -1)

    def said(self) -> str:
        """See ``Motion``."""
        return f"{self.cartesian.said()} in modified spherical coordinates"


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
