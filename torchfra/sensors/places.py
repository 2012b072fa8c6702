"""Positions of anchors, stations and cameras: fixed ones, and those that come with each step as ``u``."""

from __future__ import annotations

from numpy.typing import ArrayLike
from torch import Tensor

from torchfra.motion.base import KINDS
from torchfra.numbers import as_numbers, is_integer


def in_space(dims: int, orders: int = 1) -> list[tuple[int, tuple[str, ...]]]:
    """``Sensor.expects`` of a sensor that reads positions and, with ``orders`` of 2, velocities."""
    return [(order * dims + axis, (KINDS[order],)) for order in range(orders) for axis in range(dims)]


def heading_at(index: int) -> int:
    """The index of a vehicle's heading in a state, behind its position in the plane.

    Raises:
        ValueError: no such index.
    """
    if not is_integer(index, 2):
        raise ValueError(f"heading: expected the index of a component behind the position, received {index!r}")
    return int(index)


def from_u(u: Tensor | None, count: int, what: str) -> Tensor:
    """The first ``count`` entries of ``u (..., k)``.

    Raises:
        ValueError: no ``u``, or a shorter one; ``what`` names the entries in the message.
    """
    if u is None or u.shape[-1] < count:
        received = None if u is None else f"(..., {u.shape[-1]})"
        raise ValueError(f"u: expected {what}, (..., {count}), received {received}")
    return u[..., :count]


def finite(value: ArrayLike, *shape: int, name: str) -> Tensor:
    """``as_numbers`` of a known shape that are all finite.

    Raises:
        ValueError: another shape, or a number that is not finite.
    """
    values = as_numbers(value, name)
    if values.shape != shape or not bool(values.isfinite().all()):
        received = tuple(values.shape) if values.shape != shape else values.tolist()
        raise ValueError(f"{name}: expected finite numbers {shape}, received {received}")
    return values
