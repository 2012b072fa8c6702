"""The robust update of a preset from its keywords."""

from __future__ import annotations

import copy
from collections.abc import Collection, Sequence
from typing import TypeVar

from torchfra.hyper import Value
from torchfra.robust.base import Robust
from torchfra.robust.weights import Huber
from torchfra.sensors.base import Sensor

States = slice | Sequence[slice] | None
"""State components that fade: one group, or several; None for the default of ``Fading``."""
Share = Value | Sequence[float] | None
"""Share of the fading factor of each group; None for 1."""
R = TypeVar("R", bound=Robust)


def robust_side(
    sensor: Sensor, robust: R | None, threshold: Value | None, per_element: bool, learn: Collection[str]
) -> R | Huber:
    """The robust update of the argument (a copy, if anything learns), or Huber weights with a threshold.

    Raises:
        ValueError: a robust update together with options of Huber weights.
    """
    if robust is None:
        return Huber(1.345 if threshold is None else threshold, elements=sensor.size if per_element else None)
    if threshold is not None or per_element:
        raise ValueError(
            "robust, threshold, per_element: expected a robust update or options of Huber weights, not both"
        )
    return copy.deepcopy(robust) if learn else robust
