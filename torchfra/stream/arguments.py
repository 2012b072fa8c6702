"""Checks of a tracker's arguments, before any work."""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping
from typing import SupportsFloat

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchfra.filters.base import Filter
from torchfra.hyper import one_of
from torchfra.numbers import as_numbers, is_integer
from torchfra.sensors.base import Sensor

OWN = "sensor"
"""The name of the filter's own sensor, where there are no others."""
_CODES = {torch.float32: "f", torch.float64: "d"}
"""Type codes of arrays, by dtype."""


def check_sensors(filter: Filter, sensors: Mapping[str, Sensor] | None) -> dict[str, Sensor]:
    """The sensors of a tracker by name, once the filter is known to take each of them.

    Raises:
        ValueError: not a filter of single targets, no sensors, names that are no strings, or a sensor that the filter
            cannot have.
    """
    if not isinstance(filter, Filter) or filter.scans:
        raise ValueError(
            f"filter: expected one of single tracks, such as presets.gpb, received {type(filter).__name__}"
        )
    if sensors is None:
        return {OWN: filter.sensor}
    if not isinstance(sensors, Mapping) or not sensors or not all(isinstance(name, str) for name in sensors):
        raise ValueError(f"sensors: expected one or more by name, received {sensors!r}")
    for sensor in sensors.values():
        filter.other_sensor(sensor)
    return dict(sensors)


def check_counts(lag: float, steps: int | None, old: str, jump: float | None) -> None:
    """Checks how much of a track is kept, and the treatment of measurements that come too late.

    Raises:
        ValueError: names the first that is wrong.
    """
    if not _number(lag) >= 0:
        raise ValueError(f"lag: expected seconds of 0 or more, received {lag!r}")
    if steps is not None and not is_integer(steps, 1):
        raise ValueError(f"steps: expected 1 or more measurements, or None, received {steps!r}")
    one_of(old=(old, ("refuse", "count")))
    if jump is not None and not math.inf > _number(jump) > lag:
        raise ValueError(f"jump: expected seconds above the lag of {lag}, or None, received {jump!r}")


def seconds(name: str, x: SupportsFloat | str) -> float:
    """A time or a duration as a float.

    Raises:
        ValueError: it is no finite number.
    """
    value = _number(x)
    if not math.isfinite(value):
        raise ValueError(f"{name}: expected finite seconds, received {x!r}")
    return value


def _number(x: SupportsFloat | str) -> float:
    """The argument as a float; NaN if it is no number."""
    try:
        return float(x)
    except (TypeError, ValueError, RuntimeError):
        return math.nan


def numbers(name: str, x: ArrayLike, device: torch.device, dtype: torch.dtype = torch.float64) -> Tensor:
    """A copy of numbers as a tensor, as the caller may write into the original later.

    Raises:
        ValueError: they are no real numbers.
    """
    if isinstance(x, list | tuple) and {*map(type, x)} == {float} and device.type == "cpu":
        return torch.frombuffer(array(_CODES[dtype], x), dtype=dtype)  # in a third of the time that torch.tensor takes
    return as_numbers(x, name).to(device, dtype, copy=True)


def check_fits(name: str, x: Tensor, event: int, batch: torch.Size) -> None:
    """Checks that numbers have ``event`` dimensions behind a batch that is that of the prior, or expands to it.

    Raises:
        ValueError: they do not.
    """
    if x.dim() == event:
        return
    own = x.shape[: max(x.dim() - event, 0)]
    fits = x.dim() >= event and len(own) <= len(batch)
    if not fits or any(n not in (1, size) for n, size in zip(reversed(own), reversed(batch), strict=False)):
        expected = f"{event} {'dimension' if event == 1 else 'dimensions'} behind the prior's batch {tuple(batch)}"
        raise ValueError(f"{name}: expected {expected}, received {tuple(x.shape)}")


def check_finite(name: str, x: Tensor, *, missing: bool = False) -> None:
    """Checks that numbers are finite, or NaN where they may be ``missing``.

    Raises:
        ValueError: one is not.
    """
    if x.dim() == 1:  # of one track, and few
        bad = any(map(math.isinf, x.tolist())) if missing else not all(map(math.isfinite, x.tolist()))
    else:
        bad = bool((x.isinf() if missing else ~x.isfinite()).any())
    if bad:
        expected = f"finite numbers{', or NaN for what is missing' if missing else ''}, in {x.dtype}"
        raise ValueError(f"{name}: expected {expected}, received {x.tolist()}")
