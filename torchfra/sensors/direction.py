"""Sensors of directions: bearings from stations, and range with bearing.

Bearings count clockwise from the +y axis (north), ``atan2(dx, dy)``; those from a vehicle counter-clockwise from ahead.
"""

from __future__ import annotations

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchfra.angles import wrap
from torchfra.hyper import Value, one_of
from torchfra.numbers import as_numbers
from torchfra.sensors.base import Expected, Sensor
from torchfra.sensors.places import finite, from_u, heading_at, in_space


class Bearings(Sensor):
    """Bearings of the target from stations in the plane, clockwise from +y, rad.

    Args:
        std: of the measurement noise, rad; a number or ``(..., m)`` with one per station.
        count: number of stations whose positions come with each step: ``u (..., 2 count)`` is ``[x1, y1, x2, y2,
            ...]``, m.
        stations: ``(m, 2)`` positions of fixed stations, m; ``u`` is not used then.
        noise: instead of ``std``, a root of the covariance of correlated measurement noise.

    Raises:
        ValueError: ``stations`` of another shape.

    Source: Wang et al. (2021), eq. (6), with all four quadrants.
    """

    stations: Tensor | None

    def __init__(
        self,
        std: Value | None = None,
        *,
        count: int = 2,
        stations: ArrayLike | None = None,
        noise: Tensor | None = None,
    ) -> None:
        if stations is not None:
            stations = as_numbers(stations, "stations")
            if stations.dim() != 2 or stations.shape[-1] != 2:
                raise ValueError(f"stations: expected (m, 2), received {tuple(stations.shape)}")
        super().__init__(2, [True] * (count if stations is None else len(stations)), std, noise)
        self.register_buffer("stations", stations)

    @property
    def expects(self) -> Expected:  # type: ignore[override]  # of this sensor, not of the class
        """The positions in the plane that it reads."""
        return in_space(2)

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """The bearing ``(..., m)`` of states from each station."""
        if self.stations is not None:
            stations = self.stations.to(x)
        else:
            flat = from_u(u, 2 * self.size, f"the positions of {self.size} stations")
            stations = flat.unflatten(-1, (self.size, 2))
        offset = x[..., None, :2] - stations
        return torch.atan2(offset[..., 0], offset[..., 1])


class RangeBearing(Sensor):
    """Range, bearing clockwise from +y and, in space, elevation above the plane: m, rad, rad.

    Args:
        std: of the measurement noise: ``(..., m)`` in m, rad[, rad].
        dims: 2 for range and bearing, 3 with elevation.
        position: ``(dims,)`` position of the sensor, m; ``u`` is not used then.
        noise: instead of ``std``, a root of the covariance of correlated measurement noise.
        frame: ``"world"``, or ``"body"`` for a sensor on a vehicle.
        heading: index of the vehicle's heading in the state, rad counter-clockwise from +x.

    Without a ``position`` the sensor is at ``u (..., dims)`` if there is a ``u``, otherwise at the origin.  If ``u`` is
    for another sensor or for the motion, a ``position`` must be given.

    In the frame ``"body"`` the state is that of a vehicle, its heading behind the position, and the sensor on it
    measures a landmark in the plane: its range, and its bearing counter-clockwise from ahead.  The landmark stands at
    ``position``, or where the last two entries of ``u`` say, behind those of the motion.  Its place is known: landmarks
    whose place has to be found as well (SLAM) are out of scope.  ``Mounted`` is for a sensor beside the point that the
    state describes.

    Raises:
        ValueError: ``dims`` neither 2 nor 3, or 3 in the frame of a vehicle, another frame, a ``heading`` that is
            none, a ``position`` of another shape or not finite, a ``u`` that is too short.
    """

    position: Tensor | None

    def __init__(
        self,
        std: Value | None = None,
        *,
        dims: int = 2,
        position: ArrayLike | None = None,
        noise: Tensor | None = None,
        frame: str = "world",
        heading: int = 2,
    ) -> None:
        one_of(frame=(frame, ("world", "body")))
        world = frame == "world"
        if dims != 2 and not (world and dims == 3):
            raise ValueError(f"dims: expected {'2 or 3' if world else '2'}, received {dims}")
        super().__init__(dims if world else heading_at(heading) + 1, [False, True, True][:dims], std, noise)
        self.dims, self.frame, self.heading = dims, frame, heading
        # Without its heading a vehicle is anywhere around a landmark.
        self.locates = self.measures_each_direction = world
        at = None if position is None else finite(position, dims, name="position")
        self.register_buffer("position", at, persistent=False)

    @property
    def expects(self) -> Expected:  # type: ignore[override]  # of this sensor, not of the class
        """The positions that it reads, and the heading of a vehicle."""
        return [*in_space(self.size), *([(self.heading, ("angle",))] if self.frame == "body" else [])]

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """Range, bearing and, in space, elevation ``(..., dims)`` of states."""
        if self.frame == "body":
            return self._from_vehicle(x, u)
        offset = x[..., : self.size]
        if self.position is not None:
            offset = offset - self.position.to(x)
        elif u is not None:
            offset = offset - from_u(u, self.size, "where the sensor stands")
        ground = torch.hypot(offset[..., 0], offset[..., 1])
        bearing = torch.atan2(offset[..., 0], offset[..., 1])
        if self.size == 2:
            return torch.stack([ground, bearing], -1)
        up = offset[..., 2]
        return torch.stack([torch.hypot(ground, up), bearing, torch.atan2(up, ground)], -1)

    def _from_vehicle(self, x: Tensor, u: Tensor | None) -> Tensor:
        """Range and bearing ``(..., 2)`` of the landmark from a vehicle."""
        if self.position is not None:
            landmark = self.position.to(x)
        elif u is None or u.shape[-1] < 2:
            received = None if u is None else f"(..., {u.shape[-1]})"
            expected = "where the landmark stands in the last of (..., 2) or more"
            raise ValueError(f"u: expected {expected}, received {received}")
        else:
            landmark = u[..., -2:]
        away = landmark - x[..., :2]
        bearing = torch.atan2(away[..., 1], away[..., 0]) - x[..., self.heading]
        return torch.stack([torch.hypot(away[..., 0], away[..., 1]), wrap(bearing)], -1)

    def locate(self, z: Tensor) -> Tensor:
        """The measured position ``(..., dims)``, relative to the origin with a ``position``, else to the sensor."""
        level = z[..., 0] if self.size == 2 else z[..., 0] * z[..., 2].cos()
        plane = [level * z[..., 1].sin(), level * z[..., 1].cos()]
        away = torch.stack(plane if self.size == 2 else [*plane, z[..., 0] * z[..., 2].sin()], -1)
        return away if self.position is None else away + self.position.to(z)

    def units_per_metre(self, z: Tensor) -> Tensor:
        """1 for the range, and for an angle the inverse radius of its circle, rad/m."""
        away = z[..., 0]
        one = torch.ones_like(away)
        if self.size == 2:
            return torch.stack([one, 1 / away], -1)
        return torch.stack([one, 1 / (away * z[..., 2].cos()), 1 / away], -1)
