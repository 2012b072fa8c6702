"""The check that a motion and a sensor go together."""

from __future__ import annotations

from torch import nn

from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.sensors.correlated import Correlated

_OF_A_MODULE = {
    "motion": """, which these lines make one:
    class Mine(torchfra.motion.Motion):
        def __init__(self, module):
            super().__init__(dims=2, orders=2, q=1.0)  # [x, y, vx, vy]; variance of the acceleration noise, m^2/s^4
            self.module = module
        def forward(self, x, dt, u=None):
            return self.module(x)""",
    "sensor": """, which these lines make one:
    class Mine(torchfra.sensors.Sensor):
        def __init__(self, module):
            super().__init__(reads=2, angles=[False, False], std=1.0)  # [x, y] of the state; noise of each element
            self.module = module
        def forward(self, x, u=None):
            return self.module(x[..., :2])""",
}
"""By the name of the argument."""


def check_models(motion: Motion, sensor: Sensor) -> None:
    """Checks that a motion and a sensor go together.

    Raises:
        ValueError: an argument is not a motion or not a sensor, the sensor reads more components or dimensions of space
            than the motion has, or it expects other kinds of components than the motion states.
    """
    for name, model, kind in (("motion", motion, Motion), ("sensor", sensor, Sensor)):
        if not isinstance(model, kind):
            received = model.__name__ if isinstance(model, type) else type(model).__name__
            expected = f"an instance of torchfra's {kind.__name__}"
            raise ValueError(f"{name}: expected {expected}, received {received}{of_a_module(name, model)}")
    if any(isinstance(part, Correlated) for part in sensor.modules()):
        expected = "one without time-correlated errors (a preset of single targets takes them, outermost or in Stacked)"
        raise ValueError(f"sensor: expected {expected}, received {sensor.describe()}")
    if sensor.reads > motion.size:
        expected = f"one that reads at most {motion.size} states [{', '.join(motion.components)}]"
        raise ValueError(f"sensor: expected {expected}, received one that reads {sensor.reads}")
    if sensor.dims is not None and sensor.dims > motion.dims:
        raise ValueError(f"sensor: expected one of at most {motion.dims} dimensions of space, received {sensor.dims}")
    for i, kinds in sensor.expects:
        if motion.stated[i] not in (*kinds, "other"):
            has = f"{motion.components[i]!r}, {motion.stated[i]}, in [{', '.join(motion.components)}]"
            expected = f"a motion whose component {i} is {' or '.join(kinds)}"
            raise ValueError(f"sensor: {sensor.describe()}: expected {expected}, received {has}")


def of_a_module(name: str, model: object) -> str:
    """What turns a module of torch into a motion or a sensor, for an error about it; nothing for anything else."""
    return _OF_A_MODULE[name] if isinstance(model, nn.Module) and not isinstance(model, Motion | Sensor) else ""
