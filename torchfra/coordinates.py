"""Modified spherical coordinates: azimuth, elevation and inverse range from the origin, and their rates.

A state is ``[omega, elevation rate, d ln(range)/dt, azimuth, elevation, 1 / range]`` in rad/s, rad/s, 1/s, rad, rad,
1/m with ``omega = azimuth rate * cos(elevation)``; its Cartesian counterpart is ``[x, y, z, vx, vy, vz]``: east, north,
up. Azimuth counts from north (+y) clockwise, in [0, 2 pi); elevation from the horizontal plane up.  Straight above and
below the sensor the coordinates do not exist: they are NaN there.

Source: Stallard (1991), "Angle-only tracking filter in modified spherical coordinates"; Mallick et al. (2012), whose
order this is; Chen, Zou & Wu, eqs. (1)-(2).  The Jacobians are derived here, in the axes of the line of sight.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.angles import turned
from torchfra.linalg.triangular import tria
from torchfra.types import Gaussian

RATES, PLACE = slice(0, 3), slice(3, 6)
AZIMUTH, ELEVATION, INVERSE_RANGE = 3, 4, 5


class _Axes(NamedTuple):
    """Unit vectors ``(..., 3)`` of the line of sight."""

    out: Tensor
    across: Tensor
    up: Tensor


def to_cartesian(x: Tensor) -> Tensor:
    """``[position, velocity] (..., 6)`` of states ``(..., 6)``, m and m/s.  Source: Chen, Zou & Wu, eq. (1)."""
    axes, away = _axes(x), 1 / x[..., INVERSE_RANGE:]
    omega, climb, opening = x[..., RATES].split(1, -1)
    return torch.cat([away * axes.out, away * (opening * axes.out + omega * axes.across + climb * axes.up)], -1)


def from_cartesian(x: Tensor) -> Tensor:
    """States ``(..., 6)`` of ``[position, velocity] (..., 6)``.  Source: Chen, Zou & Wu, eq. (2)."""
    east, north, z, v_east, v_north, vz = x.unbind(-1)
    ground_squared = east.square() + north.square()
    away_squared = ground_squared + z.square()
    ground, away = ground_squared.sqrt(), away_squared.sqrt()
    along = east * v_east + north * v_north
    return torch.stack(
        [
            (north * v_east - east * v_north) / (ground * away),
            (vz * ground_squared - z * along) / (away_squared * ground),
            (along + z * vz) / away_squared,
            turned(torch.atan2(east, north)),
            torch.atan2(z, ground),
            1 / away,
        ],
        -1,
    )


def jacobian(x: Tensor) -> Tensor:
    """``(..., 6, 6)`` of ``from_cartesian``, by the state ``(..., 6)`` it leads to."""
    axes, close = _axes(x), x[..., INVERSE_RANGE:]
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


def cartesian_jacobian(x: Tensor) -> Tensor:
    """``(..., 6, 6)`` of ``to_cartesian`` at the state ``(..., 6)``: the inverse of ``jacobian``."""
    axes, away = _axes(x), 1 / x[..., INVERSE_RANGE:]
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


def belief_from_cartesian(belief: Gaussian) -> Gaussian:
    """The belief in modified spherical coordinates, to first order, ``J P J^T``.  Source: Chen, Zou & Wu, eq. (10)."""
    mean = from_cartesian(belief.mean)
    return Gaussian(mean, tria(jacobian(mean) @ belief.scale_tril))


def belief_to_cartesian(belief: Gaussian) -> Gaussian:
    """The belief in Cartesian coordinates, to first order."""
    slope = cartesian_jacobian(belief.mean)
    return Gaussian(to_cartesian(belief.mean), tria(slope @ belief.scale_tril))


def _axes(x: Tensor) -> _Axes:
    """The line of sight to states ``(..., 6)``, and the directions in which azimuth and elevation grow."""
    azimuth, elevation = x[..., AZIMUTH], x[..., ELEVATION]
    sine, cosine, level, high = azimuth.sin(), azimuth.cos(), elevation.cos(), elevation.sin()
    nothing = torch.zeros_like(sine)
    return _Axes(
        torch.stack([level * sine, level * cosine, high], -1),
        torch.stack([cosine, -sine, nothing], -1),
        torch.stack([-high * sine, -high * cosine, level], -1),
    )
