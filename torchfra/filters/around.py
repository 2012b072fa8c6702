"""The base of filters around another one, whose models they use."""

from __future__ import annotations

from torchfra.filters.base import Filter
from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.steps.recursion import S


class Around(Filter[S]):
    """Abstract: a filter around another one.

    Args:
        inner: the other one, or a copy of it.
        sensor: the sensor that the user has, if ``inner`` has a copy or another form of it.
    """

    inner: Filter

    def __init__(self, inner: Filter, sensor: Sensor | None = None) -> None:
        super().__init__()
        self.inner, self._given = inner, (sensor,)  # in a tuple it is no part

    @property
    def motion(self) -> Motion:  # type: ignore[override]
        """The motion of the inner filter."""
        return self.inner.motion

    @property
    def sensor(self) -> Sensor:  # type: ignore[override]
        """The sensor of the inner filter."""
        return self.inner.sensor

    def other_sensor(self, sensor: Sensor | None) -> Sensor | None:
        """A sensor that is neither the filter's own nor that of ``inner``, which both check it: see ``Filter``."""
        return None if sensor in self._given else self.inner.other_sensor(super().other_sensor(sensor))
