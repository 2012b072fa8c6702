"""A local origin: positions are large numbers outside and small ones in the filter."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchfra.filters.forecast import Forecast
from torchfra.linalg.triangular import apply
from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.stream.arguments import numbers
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
        there = numbers("origin", place, torch.device("cpu"))
        self.offset = torch.zeros(motion.size, dtype=torch.float64)
        if there.shape != self.offset[motion.position].shape or not bool(there.isfinite().all()):
            expected = f"a finite position ({len(self.offset[motion.position])},)"
            raise ValueError(f"origin: expected {expected}, received {there.tolist()}")
        self.offset[motion.position] = there
        self.dtype = dtype
        if not _is_shift_invariant(motion, self.offset):
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

    def measured(self, sensor: Sensor, z: Tensor, u: Tensor | None = None) -> Tensor:
        """A measurement ``(..., m)`` from outside, as one of local positions, with what the models need to know.

        An element that a common shift of positions does not shift, such as a range, is measured from the sensor's own
        position, which must be local.
        """
        return (z.double() - self._measured_offset(sensor, z, u)).to(self.dtype)

    def forecast(self, sensor: Sensor, forecast: Forecast, u: Tensor | None = None) -> Forecast:
        """A forecast of the filter, in outside coordinates."""
        mean, root = forecast.measurement
        mean = mean.double() + self._measured_offset(sensor, mean, u)
        return Forecast(self.outward(forecast.belief), Gaussian(mean, root.double()))

    def _measured_offset(self, sensor: Sensor, like: Tensor, u: Tensor | None) -> Tensor:
        """The shift by the origin of each element ``(m,)`` of a measurement; 0 for one that is not just shifted."""
        offset = self.offset.to(like.device)
        size, inputs = len(offset), None if u is None else u.reshape(-1, u.shape[-1])[0].double()
        # Points at zero and as far off as the origin, in several directions: nonlinearity shows there.
        points = torch.arange(4 * size, dtype=torch.float64, device=like.device).reshape(4, size).sin()
        points = offset.abs().max() * points * torch.arange(4, device=like.device).unsqueeze(-1)
        near, far = sensor.at_points(points, inputs), sensor.at_points(points + offset, inputs)
        change = far - near
        rounding = 1e-6 * torch.maximum(near.abs(), far.abs()).amax(0)
        along = ((change - change[0]).abs() <= rounding).all(0)
        return torch.where(along, change[0], 0.0)


def _is_shift_invariant(motion: Motion, offset: Tensor) -> bool:
    """Whether a step of a state shifted by ``offset (n,)`` gives the step of the state itself, shifted by the same."""
    second = torch.ones((), dtype=offset.dtype)
    if motion.linear:
        moved = apply(motion.transition(second), offset)
    else:
        state = torch.linspace(0.5, 1.5, len(offset), dtype=offset.dtype)
        moved = motion(state + offset, second) - motion(state, second)
    return bool(torch.allclose(moved, offset.expand_as(moved), rtol=1e-9, atol=1e-9 * float(offset.abs().max())))
