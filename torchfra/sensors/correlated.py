"""Sensors with time-correlated errors (coloured noise), on top of their white noise."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchfra.hyper import Value
from torchfra.motion.correlated import GaussMarkov
from torchfra.numbers import as_numbers
from torchfra.sensors.base import Sensor
from torchfra.sensors.composed import Around, Stacked


class Correlated(Around):
    """A sensor with time-correlated errors beside its white noise: a few metres over 10 to 100 s, as GPS or radar has.

    Each element has an error of its own, a first-order Gauss-Markov process of zero mean.  The filter of a preset for
    single targets has it in its state beside the target; priors and estimates stay those of the target alone::

        presets.gpb(ConstantVelocity(1.0), Correlated(Position(1.0), std=3.0, time=60.0))

    ``std`` and ``time`` learn by these names.  ``Stacked`` takes such sensors too.  ``forward`` is the measurement
    without the error.

    Args:
        sensor: the sensor, whose own noise is white.
        std: standard deviation of the errors, in the measurement's units: a number, or ``(m,)`` one for each element.
        time: correlation time, s, after which the correlation is ``exp(-1)``: a number, or ``(m,)``.

    Raises:
        ValueError: no sensor, or one that has such errors already; ``std`` below 0, ``time`` not above 0, or another
            shape.

    Source: Brown & Hwang (2012), "Introduction to Random Signals and Applied Kalman Filtering", section 3.6.
    """

    def __init__(self, sensor: Sensor, std: Value, time: Value) -> None:
        if not isinstance(sensor, Sensor) or errors_of(sensor):
            received = "one that has" if isinstance(sensor, Sensor) else type(sensor).__name__
            raise ValueError(f"sensor: expected a sensor without time-correlated errors, received {received}")
        self._surround(sensor, 0)
        self.sensor, self.locates = sensor, sensor.locates
        values = [as_numbers(std, "std"), as_numbers(time, "time")]
        for name, value in zip(("std", "time"), values, strict=True):
            if value.shape not in ((), (self.size,)):
                raise ValueError(f"{name}: expected a number or ({self.size},), received {tuple(value.shape)}")
        if any(value.dim() for value in values):
            pairs = zip(*(value.expand(self.size) for value in values), strict=True)
            self.errors = nn.ModuleList(GaussMarkov(*pair) for pair in pairs)
        else:
            self.errors = nn.ModuleList([GaussMarkov(values[0], values[1], self.size)])

    @property
    def inside(self) -> Sensor:
        """The sensor without such errors."""
        return self.sensor

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """The measurement ``(..., m)`` without errors."""
        measured: Tensor = self.sensor(x, u)
        return measured

    def locate(self, z: Tensor) -> Tensor:
        """Where a measurement ``(..., m)`` locates the target, as the sensor does."""
        return self.sensor.locate(z)

    def describe(self) -> str:
        """The sensor, and that it has time-correlated errors."""
        return f"{self.sensor.describe()} with time-correlated errors"


def errors_of(sensor: Sensor) -> list[GaussMarkov]:
    """The time-correlated errors of a sensor, in the order of its elements."""
    if isinstance(sensor, Correlated):
        return list(sensor.errors)  # type: ignore[arg-type]  # a ModuleList does not know what it holds
    if isinstance(sensor, Stacked):
        return [error for part in sensor.parts for error in errors_of(part)]  # type: ignore[arg-type]
    return []


def have_errors(sensor: Sensor) -> list[bool]:
    """For each element of a measurement, whether it has a time-correlated error."""
    if isinstance(sensor, Stacked):
        return [flag for part in sensor.parts for flag in have_errors(part)]  # type: ignore[arg-type]
    return [isinstance(sensor, Correlated)] * sensor.size


def without_errors(sensor: Sensor) -> Sensor:
    """The sensor with its white noise alone."""
    if isinstance(sensor, Correlated):
        return sensor.sensor
    if isinstance(sensor, Stacked) and errors_of(sensor):
        parts = [without_errors(part) for part in sensor.parts]  # type: ignore[arg-type]
        return Stacked(*parts, inputs=sensor.inputs)
    return sensor


def stationary(errors: list[GaussMarkov], like: Tensor) -> Tensor:
    """Stationary standard deviations ``(..., E)`` of the errors, for a mean ``like (..., n)``."""
    each = [error.std(like).unsqueeze(-1).expand(*like.shape[:-1], error.size) for error in errors]
    return torch.cat(each, -1)
