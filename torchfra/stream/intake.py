"""Conversion of a tracker's inputs and outputs to and from the filter's dtype and coordinates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from torchfra.gaussian.arguments import PRECISIONS
from torchfra.sensors.base import Sensor
from torchfra.stream.arguments import check_finite, check_fits, check_sensors, numbers
from torchfra.stream.origin import Origin
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
        self, filter: Any, sensors: Mapping[str, Sensor] | None, origin: Any, dtype: torch.dtype, device: torch.device
    ) -> None:
        if dtype not in PRECISIONS:
            raise ValueError(f"dtype: expected one of {PRECISIONS}, received {dtype!r}")
        named = check_sensors(filter, sensors)
        self.batch = torch.Size()
        self.names, self.sensors = list(named), list(named.values())
        self.filter, self.dtype, self.device = filter, dtype, device
        self.origin = None if origin is None else Origin(filter.motion, origin, dtype)

    def start(self, prior: Gaussian) -> Any:
        """The filter's state at a prior from outside, whose batch is that of all measurements to come."""
        state = self.filter.init(self.inward(prior))
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

    def sensor(self, entry: Entry) -> Sensor:
        """The sensor that has measured."""
        return self.sensors[entry.sensor]

    def entry(self, time: float, z: Any, name: str | None, u: Any, std: Any, noise: Any) -> Entry:
        """A measurement as the filter takes it; a standard deviation that is a number is that of each element.

        Raises:
            ValueError: no finite numbers, a shape that does not fit, or no such sensor.
        """
        number = self.number(name)
        sensor = self.sensors[number]
        measured = numbers("z", z, self.device, self.dtype if self.origin is None else torch.float64)
        if measured.shape[-1:] != (sensor.size,):
            raise ValueError(f"z: expected (..., {sensor.size}), received {tuple(measured.shape)}")
        check_fits("z", measured, 1, self.batch)
        if not (u is std is noise is None):
            u, std, noise = self.inputs(u), self.tensor("std", std), self.tensor("noise", noise)
            std = std.repeat(sensor.size) if std is not None and not std.dim() else std
            for what, x, event in (("u", u, 1), ("std", std, 1), ("noise", noise, 2)):
                if x is not None:
                    check_fits(what, x, event, self.batch)
        local = measured if self.origin is None else self.origin.measured(sensor, measured, u)
        check_finite("z", local, missing=True)
        return Entry(time, number, local, u, std, noise)

    def tensor(self, name: str, x: Any) -> Tensor | None:
        """Numbers in the filter's dtype, if there are any."""
        return None if x is None else numbers(name, x, self.device, self.dtype)

    def inputs(self, u: Any) -> Tensor | None:
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

    def outward(self, belief: Gaussian) -> Gaussian:
        """A belief of the filter, as it is outside."""
        return self.told(Gaussian(*(x.clone() for x in belief)))

    def told(self, belief: Gaussian) -> Gaussian:
        """A belief that nobody else has, as it is outside."""
        return belief if self.origin is None else self.origin.outward(belief)

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
