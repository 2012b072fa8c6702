"""Conversion of a tracker's inputs and outputs to and from the filter's dtype and coordinates.

Positions may be large numbers outside and small ones, relative to a local origin, in the filter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import index
from typing import Any

import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from torchfra.filters.base import Filter
from torchfra.filters.forecast import Forecast
from torchfra.gaussian.arguments import PRECISIONS
from torchfra.linalg.triangular import apply
from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.steps.recursion import HasBelief
from torchfra.stream.arguments import check_finite, check_fits, check_sensors, numbers
from torchfra.stream.window import Entry
from torchfra.types import Gaussian


class Intake:
    """Measurements as the filter takes them, and beliefs as they are outside.

    Args:
        filter: of the tracker.
        sensors: by name; None for the filter's own.
        origin: see ``Tracker``.
        dtype: of the filter.
        device: where it runs.

    Raises:
        ValueError: see ``Tracker``.
    """

    def __init__(
        self,
        filter: Filter,
        sensors: Mapping[str, Sensor] | None,
        origin: Sequence[float] | Tensor | None,
        dtype: torch.dtype,
        device: torch.device,
    ) -> None:
        if dtype not in PRECISIONS:
            raise ValueError(f"dtype: expected one of {PRECISIONS}, received {dtype!r}")
        named = check_sensors(filter, sensors)
        self.batch = torch.Size()
        self.names, self.sensors = list(named), list(named.values())
        self.others = [filter.other_sensor(sensor) for sensor in self.sensors]
        """Of each whether it is another than the filter's own: the sensor, or None."""
        self.filter, self.dtype, self.device = filter, dtype, device
        self.origin = None if origin is None else Origin(filter.motion, origin, dtype)

    def start(self, prior: Gaussian) -> HasBelief:
        """The filter's state at a prior from outside, whose batch is that of all measurements to come."""
        state: HasBelief = self.filter.init(self.inward(prior))
        self.batch = state.belief.mean.shape[:-1]
        return state

    def number(self, name: str | None) -> int:
        """The number of a sensor, by its name.

        Raises:
            ValueError: there is none of that name, or no name where there are several.
        """
        if name is None and len(self.names) == 1:
            return 0
        if name not in self.names:
            raise ValueError(f"sensor: expected one of {self.names}, received {name!r}")
        return self.names.index(name)

    def entry(
        self, time: float, z: ArrayLike, name: str | None, u: ArrayLike | None, std: ArrayLike | None,
        noise: ArrayLike | None,
    ) -> Entry:  # fmt: skip
        """A measurement as the filter takes it; a standard deviation that is a number is that of each element.

        Raises:
            ValueError: no finite numbers, a shape that does not fit, or no such sensor.
        """
        number = self.number(name)
        sensor = self.sensors[number]
        measured = numbers("z", z, self.device, self.dtype if self.origin is None else torch.float64)
        inputs, stated, root = self.inputs(u), self.tensor("std", std), self.tensor("noise", noise)
        stated = stated.repeat(sensor.size) if stated is not None and not stated.dim() else stated
        self.check(Entry(time, number, measured, inputs, stated, root))
        local = measured if self.origin is None else self.origin.measured(sensor, measured, inputs)
        check_finite("z", local, missing=True)
        return Entry(time, number, local, inputs, stated, root)

    def check(self, entry: Entry) -> None:
        """Checks that an entry is of one of the sensors, and its numbers of the shapes of this batch.

        Raises:
            ValueError: it is not.
        """
        if not 0 <= index(entry.sensor) < len(self.sensors):
            raise ValueError(f"sensor: expected the number of one of {self.names}, received {entry.sensor}")
        size = self.sensors[entry.sensor].size
        if entry.z.shape[-1:] != (size,):
            raise ValueError(f"z: expected (..., {size}), received {tuple(entry.z.shape)}")
        check_fits("z", entry.z, 1, self.batch)
        for what, x, event in (("u", entry.u, 1), ("std", entry.std, 1), ("noise", entry.noise, 2)):
            if x is not None:
                check_fits(what, x, event, self.batch)

    def tensor(self, name: str, x: ArrayLike | None) -> Tensor | None:
        """Numbers in the filter's dtype, if there are any."""
        return None if x is None else numbers(name, x, self.device, self.dtype)

    def inputs(self, u: ArrayLike | None) -> Tensor | None:
        """The inputs ``u`` of the models, if there are any.

        Raises:
            ValueError: no finite numbers.
        """
        values = self.tensor("u", u)
        if values is not None:
            check_finite("u", values)
        return values

    def inward(self, belief: Gaussian) -> Gaussian:
        """A belief from outside, as the filter has it."""
        if self.origin is not None:
            return self.origin.inward(belief)
        return Gaussian(*(x.to(self.dtype, copy=True) for x in belief))

    def outward(self, belief: Gaussian, *, copy: bool = True) -> Gaussian:
        """A belief of the filter, as it is outside; ``copy`` unless nothing else holds its tensors."""
        if self.origin is not None:
            return self.origin.outward(belief)
        return Gaussian(*(x.clone() for x in belief)) if copy else belief

    def kind(self) -> dict[str, Any]:
        """A description of filter, sensors and origin, by which a saved track is recognised as one of this tracker."""
        origin = None if self.origin is None else self.origin.offset.tolist()
        kind = {"filter": type(self.filter).__name__, "sensors": self.names, "origin": origin}
        for name, sensor in zip(self.names, self.sensors, strict=True):
            kind |= _parts(f"sensor {name}", sensor)
            kind[f"angles of {name}"] = sensor.angles.tolist()
        return _parts("filter", self.filter) | kind


def _parts(name: str, module: nn.Module) -> dict[str, str]:
    """A description of a module and of each of its parts, by path: class, ``extra_repr`` and options."""
    words = {}
    for part, x in module.named_modules(prefix=name):
        values = {key: value for key, value in vars(x).items() if key[0] != "_" and key != "training"}
        options = [f"{key}={value}" for key, value in values.items() if isinstance(value, bool | int | float | str)]
        words[part] = f"{type(x).__name__}({', '.join(filter(None, [x.extra_repr(), *options]))})"
    return words


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
        """A measurement ``(..., m)`` from outside, in local coordinates, with the inputs ``u`` of the models.

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
        # Points at zero and at the distance of the origin, in several directions: a nonlinear sensor shows there.
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
