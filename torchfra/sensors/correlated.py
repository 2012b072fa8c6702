"""Sensors whose errors last: alike from one measurement to the next, on top of the noise that differs."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchfra.hyper import Value
from torchfra.motion.correlated import GaussMarkov
from torchfra.sensors.base import Expected, MeasurementNoise, Sensor
from torchfra.sensors.composed import Stacked
from torchfra.sensors.places import numbers


class Correlated(Sensor):
    """A sensor with errors that last, beside its noise: a few metres over 10 to 100 s, of any GPS, range or radar.

    Each element has an error of its own, a first-order Gauss-Markov process of zero mean.  A preset of single targets
    carries it in its state beside the target; priors and estimates stay those of the target alone::

        presets.gpb(ConstantVelocity(1.0), Correlated(Position(1.0), std=3.0, time=60.0))

    ``std`` and ``time`` learn by these names.  ``Stacked`` takes such sensors among others.  ``forward`` is the
    measurement without the error.

    Args:
        sensor: what measures; its own noise is white.
        std: standard deviation of the errors, in the measurement's units: a number, or ``(m,)`` one for each element.
        time: s after which the correlation has fallen to ``exp(-1)``: a number, or ``(m,)``.

    Raises:
        ValueError: no sensor, or one with errors that last already; ``std`` below 0, ``time`` not above 0, or another
            shape.

    Source: Brown & Hwang (2012), "Introduction to Random Signals and Applied Kalman Filtering", section 3.6.
    """

    def __init__(self, sensor: Sensor, std: Value, time: Value) -> None:
        if not isinstance(sensor, Sensor) or errors_of(sensor):
            received = "one that has" if isinstance(sensor, Sensor) else type(sensor).__name__
            raise ValueError(f"sensor: expected a sensor without errors that last, received {received}")
        self._lay_out(sensor.reads, sensor.angles.tolist())
        self.sensor, self.blocks, self.dims = sensor, sensor.blocks, sensor.dims
        values = [numbers(std, "std"), numbers(time, "time")]
        for name, value in zip(("std", "time"), values, strict=True):
            if value.shape not in ((), (self.size,)):
                raise ValueError(f"{name}: expected a number or ({self.size},), received {tuple(value.shape)}")
        if any(value.dim() for value in values):
            each = zip(*(value.expand(self.size) for value in values), strict=True)
            self.errors = nn.ModuleList(GaussMarkov(*of_one) for of_one in each)
        else:
            self.errors = nn.ModuleList([GaussMarkov(values[0], values[1], self.size)])

    @property
    def linear(self) -> bool:  # type: ignore[override]  # of this sensor, not of the class
        """Whether that sensor is."""
        return self.sensor.linear

    @property
    def root(self) -> Tensor | None:  # type: ignore[override]  # of that sensor
        """As of that sensor."""
        return self.sensor.root

    @property
    def expects(self) -> Expected:  # type: ignore[override]  # of this sensor, not of the class
        """What that sensor does."""
        return self.sensor.expects

    @property
    def locates(self) -> bool:  # type: ignore[override]  # of this sensor, not of the class
        """Whether that sensor does."""
        return self.sensor.locates

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """The measurement ``(..., m)`` without errors."""
        measured: Tensor = self.sensor(x, u)
        return measured

    def difference(self, a: Tensor, b: Tensor) -> Tensor:
        """As of that sensor."""
        return self.sensor.difference(a, b)

    def locate(self, z: Tensor) -> Tensor:
        """As of that sensor."""
        return self.sensor.locate(z)

    def measurement_noise(self, z: Tensor, std: Tensor | None = None, root: Tensor | None = None) -> MeasurementNoise:
        """The white noise of that sensor."""
        return self.sensor.measurement_noise(z, std, root)

    def describe(self) -> str:
        """The sensor, and that its errors last."""
        return f"{self.sensor.describe()} with errors that last"


def errors_of(sensor: Sensor) -> list[GaussMarkov]:
    """The errors of a sensor that last, in the order of the elements that have some."""
    if isinstance(sensor, Correlated):
        return list(sensor.errors)  # type: ignore[arg-type]  # a ModuleList does not know what it holds
    if isinstance(sensor, Stacked):
        return [error for part in sensor.parts for error in errors_of(part)]  # type: ignore[arg-type]
    return []


def erring(sensor: Sensor) -> list[bool]:
    """For each element of a measurement, whether it has an error that lasts."""
    if isinstance(sensor, Stacked):
        return [flag for part in sensor.parts for flag in erring(part)]  # type: ignore[arg-type]
    return [isinstance(sensor, Correlated)] * sensor.size


def without_errors(sensor: Sensor) -> Sensor:
    """The sensor with its noise alone."""
    if isinstance(sensor, Correlated):
        return sensor.sensor
    if isinstance(sensor, Stacked) and errors_of(sensor):
        parts = [without_errors(part) for part in sensor.parts]  # type: ignore[arg-type]
        return Stacked(*parts, inputs=sensor.inputs)
    return sensor


def stationary(errors: list[GaussMarkov], like: Tensor) -> Tensor:
    """Standard deviations ``(..., E)`` of the errors at any time, beside a mean ``like (..., n)``."""
    each = [error.std(like).unsqueeze(-1).expand(*like.shape[:-1], error.size) for error in errors]
    return torch.cat(each, -1)
