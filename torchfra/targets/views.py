"""Fields of view of sensors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchfra.numbers import as_number
from torchfra.targets.checks import by_sensor


class FieldOfView:
    """The ring around a sensor in which it measures targets; a target outside is not missed.

    Args:
        farthest: distance, m.
        nearest: distance, m.
        place: ``(dims,)`` position of the sensor, m; None for one that moves, whose position is the first ``dims``
            entries of ``u`` of every scan.

    Raises:
        ValueError: not ``0 <= nearest < farthest``, or a place that is no finite position.
    """

    def __init__(self, farthest: float, nearest: float = 0.0, place: Sequence[float] | Tensor | None = None) -> None:
        if not 0 <= as_number(nearest) < as_number(farthest) <= math.inf:
            raise ValueError(f"nearest, farthest: expected 0 <= nearest < farthest, received {nearest}, {farthest}")
        self.nearest, self.farthest = float(nearest), float(farthest)
        self.place = None if place is None else torch.as_tensor(place, dtype=torch.float64)
        if self.place is not None and (self.place.dim() != 1 or not bool(self.place.isfinite().all())):
            raise ValueError(f"place: expected (dims,) finite metres, received {place!r}")

    def __call__(self, position: Tensor, u: Tensor | None) -> Tensor:
        """Whether targets at positions ``(N, dims)`` are inside, ``(N,)`` bool; ``u (N, k)`` is that of their scans."""
        dims = position.shape[-1]
        if self.place is None:
            assert u is not None  # as checked before
            place = u[:, :dims]
        else:
            place = self.place.to(position)
        distance = (position - place).norm(dim=-1)
        inside: Tensor = (distance >= self.nearest) & (distance <= self.farthest)
        return inside

    def __repr__(self) -> str:
        place = None if self.place is None else tuple(self.place.tolist())
        return f"FieldOfView({self.farthest:g}, nearest={self.nearest:g}, place={place})"


def check_views(
    views: Mapping[str | None, FieldOfView] | None, names: Sequence[str], dims: int
) -> dict[str | None, FieldOfView]:
    """Fields of view by the name of the sensor, None for the filter's own, checked.

    Raises:
        ValueError: one of no sensor, what is no field of view, or a place in other dimensions.
    """
    checked = by_sensor("views", views, names, FieldOfView)
    for name, view in checked.items():
        if view.place is not None and len(view.place) != dims:
            raise ValueError(f"views: expected a place of {dims} dimensions of {name!r}, received {len(view.place)}")
    return checked


def check_place(view: FieldOfView | None, u: Tensor | None, dims: int) -> None:
    """Checks that the position of a sensor with a field of view is known.

    Raises:
        ValueError: it is not.
    """
    if view is not None and view.place is None and (u is None or u.shape[-1] < dims):
        received = "none" if u is None else f"{u.shape[-1]} numbers"
        raise ValueError(
            f"u: expected the place of the sensor, {dims} numbers, as its field of view needs, received {received}"
        )
