"""Checks of what is handed to a filter, before any work."""

from __future__ import annotations

from typing import Any

from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor


def check_models(motion: Motion, sensor: Sensor) -> None:
    """Checks that these are a motion and a sensor that go together.

    Raises:
        ValueError: one is neither, or the sensor reads more components or dimensions of space than the motion has.
    """
    for name, model, kind in (("motion", motion, Motion), ("sensor", sensor, Sensor)):
        if not isinstance(model, kind):
            received = model.__name__ if isinstance(model, type) else type(model).__name__
            raise ValueError(f"{name}: expected an instance of torchfra's {kind.__name__}, received {received}")
    if sensor.reads > motion.size:
        raise ValueError(f"sensor: expected one that reads at most {motion.size} states, this reads {sensor.reads}")
    if sensor.dims is not None and sensor.dims > motion.dims:
        raise ValueError(f"sensor: expected one of at most {motion.dims} dimensions of space, received {sensor.dims}")


def check_sides(**sides: tuple[Any, type]) -> None:
    """Checks that each side is of its kind: ``check_sides(robust=(robust, Robust))``.

    Raises:
        ValueError: names the first that is not.
    """
    for name, (side, kind) in sides.items():
        if not isinstance(side, kind):
            expected = f"{kind.__name__} of torchfra.{'robust' if name == 'robust' else 'adaptive'}, or a kind of it"
            raise ValueError(f"{name}: expected {expected}, received {type(side).__name__}")


def check_state(state: Any) -> None:
    """Checks that this is the state of a filter.

    Raises:
        ValueError: it is something else, a prior say.
    """
    if not hasattr(state, "belief"):
        raise ValueError(f"state: expected what init or step has returned, received {type(state).__name__}")


def check_lengths(**lengths: int | None) -> None:
    """Whether these are numbers of steps, or None.

    Raises:
        ValueError: names the first that is not.
    """
    for name, length in lengths.items():
        if length is not None and length < 1:
            raise ValueError(f"{name}: expected at least 1 step, received {length}")
