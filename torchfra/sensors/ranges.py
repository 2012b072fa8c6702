"""Ranges and range rates from anchors: ultra-wideband, acoustic or radio beacons."""

from __future__ import annotations

import math

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchfra.hyper import Value
from torchfra.numbers import as_numbers
from torchfra.sensors.base import Expected, Sensor
from torchfra.sensors.places import from_u, in_space


class Ranges(Sensor):
    """Distances of the target from anchors that do not move during a step, m.

    Each range is a block of its own in ``blocks``, as it comes from a device of its own.  A missing range is NaN.

    Args:
        anchors: ``(m, dims)`` positions of the anchors, m; or ``(m, 3)`` in space for states in the plane, with
            ``height``.  None with ``count``.
        std: of the measurement noise, m; a number or ``(..., m)`` with one per anchor.
        count: instead of ``anchors``, the number of anchors whose positions come with each step: ``u (..., m c)`` is
            ``[x1, y1, x2, y2, ...]`` with the ``c`` coordinates of each, m.
        dims: dimensions of space of the states; by default 2 with a ``height`` or a ``count``, otherwise those of the
            anchors.
        height: known height of the target, m, for states in the plane and anchors in space.
        noise: instead of ``std``, a root of the covariance of correlated measurement noise.

    A measurement does not locate the target: it may have too few ranges, and from anchors on a line a target and its
    mirror image have the same ranges.

    Raises:
        ValueError: both or neither of ``anchors`` and ``count``, positions of another shape or not finite, a height
            if states and anchors have the same dimensions, or none if they differ.
    """

    anchors: Tensor | None
    dims: int
    orders = 1
    """Number of derivatives of the position that it reads, the position included."""

    def __init__(
        self,
        anchors: ArrayLike | None = None,
        std: Value | None = None,
        *,
        count: int | None = None,
        dims: int | None = None,
        height: float | None = None,
        noise: Tensor | None = None,
    ) -> None:
        places = None if anchors is None else _places(anchors)
        if (places is None) == (count is None):
            raise ValueError(f"anchors, count: expected exactly one of the two, received {anchors!r}, {count}")
        if count is not None and count < 1:
            raise ValueError(f"count: expected 1 or more anchors, received {count}")
        if dims is None:
            dims = 2 if places is None or height is not None else places.shape[-1]
        self._check_height(dims, height, None if places is None else places.shape[-1])
        super().__init__(self.orders * dims, [False] * (len(places) if places is not None else count or 0), std, noise)
        self.blocks = tuple((i,) for i in range(self.size))
        self.dims, self.height = dims, None if height is None else float(height)
        self.register_buffer("anchors", places, persistent=False)  # learned values are valid with other anchors too

    @staticmethod
    def _check_height(dims: int, height: float | None, coordinates: int | None) -> None:
        """Checks that states of ``dims`` dimensions and a height go with anchors of so many ``coordinates``."""
        if dims not in (1, 2, 3):
            raise ValueError(f"dims: expected 1, 2 or 3, received {dims}")
        if height is not None and not (dims == 2 and math.isfinite(height)):
            raise ValueError(f"height: expected finite metres, for states in the plane, received {height}, dims {dims}")
        expected = dims if height is None else 3
        if coordinates is not None and coordinates != expected:
            also = " of anchors in space with a height" if height is not None else ""
            raise ValueError(
                f"anchors: expected (m, {expected}){also}, received (m, {coordinates}) and height {height}"
            )

    @property
    def expects(self) -> Expected:  # type: ignore[override]  # of this sensor, not of the class
        """The positions that it reads."""
        return in_space(self.dims)

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """The distance ``(..., m)`` of states from each anchor; its gradient is 0 on an anchor."""
        return self._away(x, self._from_anchors(u, 1)[0].to(x))[1]

    def _away(self, x: Tensor, places: Tensor) -> tuple[Tensor, Tensor]:
        """Offsets ``(..., m, dims)`` and distances ``(..., m)`` of states from each anchor."""
        offset = x[..., None, : self.dims] - places[..., : self.dims]
        squared = offset.square().sum(-1)
        if self.height is not None:
            squared = squared + (self.height - places[..., 2]).square()
        touching = squared == 0
        return offset, torch.where(touching, 0.0, torch.where(touching, 1.0, squared).sqrt())

    def _from_anchors(self, u: Tensor | None, count: int) -> tuple[Tensor, ...]:
        """The anchors' positions ``(..., m, c)`` and, with a ``count`` of 2, their velocities."""
        if self.anchors is not None:
            return self.anchors, *[torch.zeros_like(self.anchors)] * (count - 1)
        each = self.dims if self.height is None else 3
        what = " and velocities" * (count > 1)
        flat = from_u(u, count * each * self.size, f"the positions{what} of {self.size} anchors")
        places: tuple[Tensor, ...] = flat.unflatten(-1, (count, self.size, each)).unbind(-3)
        return places

    def describe(self) -> str:
        """The number of ranges, and the target's height if it is known."""
        known = "" if self.height is None else f" at a height of {self.height:g} m"
        return f"ranges from {self.size} anchor{'s' * (self.size > 1)}{known}"


class RangeRates(Ranges):
    """Rates of the distances of the target from anchors, m/s, as a Doppler radar measures them.

    States begin with position and velocity.  ``Stacked`` with ``Ranges`` measures range and range rate.

    Args:
        anchors: see ``Ranges``, as for all arguments that are not below.
        std: of the measurement noise, m/s; a number or ``(..., m)`` with one per anchor.
        count: instead of ``anchors``, the number of anchors whose positions and velocities come with each step:
            ``u (..., 2 m c)`` is all positions, see ``Ranges``, and then all velocities, m/s.

    Raises:
        ValueError: see ``Ranges``.
    """

    orders = 2

    @property
    def expects(self) -> Expected:  # type: ignore[override]  # of this sensor, not of the class
        """The positions and velocities that it reads."""
        return in_space(self.dims, 2)

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """The rate ``(..., m)`` of each distance; 0 on an anchor."""
        places, moving = (at.to(x) for at in self._from_anchors(u, 2))
        offset, distance = self._away(x, places)
        velocity = x[..., None, self.dims : 2 * self.dims] - moving[..., : self.dims]
        along = (offset * velocity).sum(-1)
        return along / torch.where(distance == 0, 1.0, distance)

    def describe(self) -> str:
        """The number of range rates, and the target's height if it is known."""
        return super().describe().replace("ranges", "range rates")


def _places(anchors: ArrayLike) -> Tensor:
    """Positions ``(m, c)`` as a tensor: see ``as_numbers``."""
    places = as_numbers(anchors, "anchors")
    if places.dim() != 2 or len(places) < 1 or places.shape[-1] not in (1, 2, 3) or not bool(places.isfinite().all()):
        received = tuple(places.shape) if bool(places.isfinite().all()) else places.tolist()
        raise ValueError(f"anchors: expected finite positions (m, 2) or (m, 3), received {received}")
    return places
