"""Where anchors, stations and cameras are, and what comes of them with each step."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchfra.motion.components import KINDS


def in_space(dims: int, orders: int = 1) -> list[tuple[int, tuple[str, ...]]]:
    """What a sensor expects that looks at the first components as positions and, of two orders, velocities."""
    return [(order * dims + axis, (KINDS[order],)) for order in range(orders) for axis in range(dims)]


def from_u(u: Tensor | None, count: int, what: str) -> Tensor:
    """The first ``count`` entries of ``u (..., k)``.

    Raises:
        ValueError: no ``u``, or a shorter one; ``what`` says what was expected.
    """
    if u is None or u.shape[-1] < count:
        received = None if u is None else f"(..., {u.shape[-1]})"
        raise ValueError(f"u: expected {what}, (..., {count}), received {received}")
    return u[..., :count]


def numbers(value: Any, name: str) -> Tensor:
    """Numbers as a tensor; those that are in none become doubles, and so do whole ones.

    Raises:
        ValueError: what is not numbers.
    """
    try:
        values = value if isinstance(value, Tensor) else torch.as_tensor(value, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(f"{name}: expected numbers, received {value!r}") from None
    return values if values.is_floating_point() else values.double()


def finite(value: Any, *shape: int, name: str) -> Tensor:
    """Known numbers of a shape as a tensor, as of ``numbers``.

    Raises:
        ValueError: another shape, or what is not finite.
    """
    values = numbers(value, name)
    if values.shape != shape or not bool(values.isfinite().all()):
        received = tuple(values.shape) if values.shape != shape else values.tolist()
        raise ValueError(f"{name}: expected finite numbers {shape}, received {received}")
    return values
