"""A local origin: positions are large numbers outside and small ones in the filter."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchfra.filters.ahead import Ahead
from torchfra.linalg.triangular import apply
from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian


class Origin:
    """Shifts beliefs and measurements to a local origin and back, in double precision.

    Args:
        motion: of the states; it must not depend on where the target is.
        place: ``(dims,)`` position of the origin, m.
        dtype: of the filter.

    Raises:
        ValueError: a place of another shape or not finite, or a motion that depends on the position.
    """

    def __init__(self, motion: Motion, place: Sequence[float] | Tensor, dtype: torch.dtype) -> None:
        there = torch.as_tensor(place, dtype=torch.float64)
        self.offset = torch.zeros(motion.size, dtype=torch.float64)
        if there.shape != self.offset[motion.position].shape or not bool(there.isfinite().all()):
            expected = f"a finite position ({len(self.offset[motion.position])},)"
            raise ValueError(f"origin: expected {expected}, received {there.tolist()}")
        self.offset[motion.position] = there
        self.dtype = dtype
        if not _carries_along(motion, self.offset):
            expected = "a motion that is the same everywhere"
            raise ValueError(f"origin: expected {expected}, received {motion.describe()}")

    def inward(self, belief: Gaussian) -> Gaussian:
        """A belief from outside, as the filter has it."""
        mean, root = belief
        return Gaussian((mean.double() - self.offset.to(mean.device)).to(self.dtype), root.to(self.dtype, copy=True))

    def outward(self, belief: Gaussian) -> Gaussian:
        """A belief of the filter, as it is outside, in double precision."""
        mean, root = belief
        return Gaussian(mean.double() + self.offset.to(mean.device), root.to(torch.float64, copy=True))

    def measured(self, sensor: Sensor, z: Tensor) -> Tensor:
        """A measurement ``(..., m)`` from outside, as one of local positions.

        Other sensors than linear ones measure from a place of their own, which must be local.
        """
        return (z.double() - self._seen(sensor, z)).to(self.dtype)

    def ahead(self, sensor: Sensor, ahead: Ahead) -> Ahead:
        """A look ahead of the filter, as it is outside."""
        mean, root = ahead.measurement
        return Ahead(self.outward(ahead.belief), Gaussian(mean.double() + self._seen(sensor, mean), root.double()))

    def _seen(self, sensor: Sensor, like: Tensor) -> Tensor:
        """What a linear sensor measures of the origin."""
        if not sensor.linear:
            return torch.zeros(sensor.size, dtype=torch.float64, device=like.device)
        seen: Tensor = sensor(self.offset.to(like.device))
        return seen


def _carries_along(motion: Motion, offset: Tensor) -> bool:
    """Whether a step moves a state that is shifted by ``offset (n,)`` to where it moves the others, and so shifted."""
    second = torch.ones((), dtype=offset.dtype)
    if motion.linear:
        moved = apply(motion.transition(second), offset)
    else:
        state = torch.linspace(0.5, 1.5, len(offset), dtype=offset.dtype)
        moved = motion(state + offset, second) - motion(state, second)
    return bool(torch.allclose(moved, offset.expand_as(moved), rtol=1e-9, atol=1e-9 * float(offset.abs().max())))
