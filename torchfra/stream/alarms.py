"""Whether each of a tracker's sensors is faulty, from measurement to measurement."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfra.filters.alarms import lasting
from torchfra.sensors.base import Sensor
from torchfra.types import Alarm

Alarms = tuple[Alarm, ...]
"""The alarm of each sensor at its last measurement; empty for filters without alarms."""


class Known(NamedTuple):
    """State of the filter and alarms after a measurement."""

    state: Any
    """State of the filter."""
    alarms: Alarms


def silent(sensor: Sensor, mean: Tensor) -> Alarm:
    """The alarm of a sensor before its first measurement, batched like a mean ``(..., n)``."""
    blocks, elements = (mean.new_zeros(*mean.shape[:-1], count) for count in (len(sensor.blocks), sensor.size))
    return Alarm(blocks, blocks.clone(), elements)


def measured(alarms: Alarms, number: int, said: Alarm | None, z: Tensor, dt: float) -> Alarms:
    """All alarms after a measurement ``z (..., m)`` by the sensor of this number, ``dt`` seconds after the last one.

    Args:
        alarms: before it.
        number: of the sensor.
        said: by the filter, of this measurement; None of filters that do not say.
        z: NaN is missing; where all is, the alarm stays.
        dt: seconds.
    """
    if said is None:
        return ()
    seen = ~z.isnan().all(-1, keepdim=True)
    after = []
    for i, (probability, lasted, offset) in enumerate(alarms):
        now = torch.where(seen, said.probability, probability) if i == number else probability
        off = torch.where(seen, said.offset, offset) if i == number else offset
        after.append(Alarm(now, lasting(lasted, probability, now, lasted.new_tensor(dt)), off))
    return tuple(after)
