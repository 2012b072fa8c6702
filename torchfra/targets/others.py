"""Filters of scans by other sensors, around the inner filter of one."""

from __future__ import annotations

import copy
from collections.abc import Mapping

from torchfra.filters.engine import INTERPRETED
from torchfra.filters.scans.jpda import JPDA
from torchfra.filters.srckf import SRCKF
from torchfra.targets.checks import check_filter


def others(filter: JPDA, sensors: Mapping[str, JPDA] | None) -> dict[str, JPDA]:
    """By name, filters with the gates, clutter and detection of other sensors, whose targets are those of ``filter``.

    They run interpreted.

    Raises:
        ValueError: one that cannot have these targets.
    """
    made = {}
    for name, other in (sensors or {}).items():
        check_filter(other)
        if type(other.motion) is not type(filter.motion) or other.motion.components != filter.motion.components:
            expected = f"the motion of the targets, {type(filter.motion).__name__}"
            raise ValueError(f"sensors: expected {expected}, received {type(other.motion).__name__} of {name!r}")
        if isinstance(filter.inner, SRCKF) and not filter.inner.fading.plain:
            raise ValueError("sensors: expected none beside fading factors, which remember measurements of one sensor")
        made[name] = around(filter, copy.deepcopy(other))
        made[name].engine = INTERPRETED
    return made


def around(filter: JPDA, other: JPDA) -> JPDA:
    """The ``other`` filter, around the inner one of ``filter`` as that is now."""
    other.inner = filter.inner.with_sensor(other.sensor)
    return other
