"""Odometry and asynchronous measurements on one axis of time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchfra.numbers import as_numbers, positive


class Merged(NamedTuple):
    """Steps for a filter: ``f(merged.z, prior, dt=merged.dt, u=merged.u, sensors=[...], which=merged.which)``."""

    time: Tensor
    """``(T,)`` s, of each step."""
    z: Tensor
    """``(T, m)`` of the sensor that measures at the step, NaN behind its elements; all NaN where none does."""
    dt: Tensor
    """``(T,)`` s since the step before, of the first since the start."""
    u: Tensor
    """``(T, k)``: the odometry over the step, and behind it the inputs of its measurement, 0 where there are none."""
    which: Tensor
    """``(T,)`` number of the sensor, in the order of the measurements."""


def merge(
    odometry: tuple[ArrayLike, ArrayLike], measurements: Mapping[str, Sequence[ArrayLike]], *, longest: float,
    start: float | None = None,
) -> Merged:  # fmt: skip
    """Puts readings of odometry and measurements at any times of their own onto one axis of time.

    A reading holds from its time to that of the next one, as velocities do that ``motion.body_velocities`` makes of
    poses.  Each reading ends a step, and so does each measurement, so that no step has several readings in it and no
    reading counts twice.  The reading of an instant that a step begins at is that of the step.

    Args:
        odometry: ``(S,)`` times of readings, s, increasing, and their ``(S, k)`` inputs.
        measurements: by the sensor's name, ``(J,)`` times, s, in any order, ``(J, m)`` values, and maybe ``(J, l)``
            further inputs, such as where the landmark of each measurement stands.
        longest: seconds that a reading may hold.  A longer gap would be bridged by a single arc, which is wrong
            wherever the robot turned in between, so it is an error.
        start: s, when the prior holds; None for the first reading.

    Raises:
        ValueError: shapes that do not fit, times that do not increase or are not finite, a measurement before the start
            or later than the last reading may hold, a gap in the odometry.

    Example:
        >>> gps = ([0.5, 1.5], [[0.6, 0.0], [1.4, 0.1]])
        >>> merged = torchfra.stream.merge(([0.0, 1.0], [[1.0, 0.0, 0.0], [1.0, 0.0, 0.1]]), {"gps": gps}, longest=1.0)
        >>> merged.time.tolist(), merged.dt.tolist(), merged.u[:, 2].tolist()
        ([0.5, 1.0, 1.5], [0.5, 0.5, 0.5], [0.0, 0.0, 0.1])
    """
    longest = positive("longest", longest, "seconds")
    times, readings = (as_numbers(x, "odometry").double() for x in odometry)
    if times.dim() != 1 or readings.dim() != 2 or len(times) != len(readings) or not len(times):
        raise ValueError(
            f"odometry: expected times (S,) and readings (S, k), received {tuple(times.shape)}, {tuple(readings.shape)}"
        )
    if not bool(times.isfinite().all() & (times.diff() > 0).all()):
        raise ValueError("odometry: expected finite times that increase, received some that do not")
    first = float(times[0]) if start is None else float(start)
    if not float(times[0]) <= first <= float(times[-1]):
        raise ValueError(f"start: expected seconds from {float(times[0]):g} to {float(times[-1]):g}, received {start}")
    seen = [_measured(name, *given) for name, given in measurements.items()]
    if not seen:
        raise ValueError("measurements: expected those of one sensor or more, received none")
    each = torch.cat([time for time, _, _ in seen])
    which = torch.cat([torch.full((len(time),), i) for i, (time, _, _) in enumerate(seen)])
    z, own = _together([z for _, z, _ in seen], torch.nan), _together([u for _, _, u in seen], 0.0)
    if bool((each < first).any()):
        raise ValueError(f"measurements: expected none before {first:g} s, received one at {float(each.min()):g} s")
    ends = times[(times > first) & ~torch.isin(times, each)]
    time = torch.cat([each, ends])
    order = torch.sort(time, stable=True).indices
    time = time[order]
    begins = torch.cat([time.new_tensor([first]), time[:-1]])
    reading = torch.searchsorted(times, begins, right=True) - 1
    stale = time - times[reading] > longest * (1 + 1e-9)
    if bool(stale.any()):
        i = int(stale.nonzero()[0])
        expected = f"a reading every {longest:g} s at least (longest), as one arc over a gap is wrong where it turned"
        received = f"none from {float(times[reading[i]]):g} to {float(time[i]):g} s"
        raise ValueError(f"odometry: expected {expected}, received {received}")
    rest, pad = len(ends), torch.nn.functional.pad
    z, own = pad(z, (0, 0, 0, rest), value=torch.nan)[order], pad(own, (0, 0, 0, rest))[order]
    return Merged(time, z, time - begins, torch.cat([readings[reading], own], 1), pad(which, (0, rest))[order])


def _together(parts: Sequence[Tensor], fill: float) -> Tensor:
    """Rows of several tables, those of narrower ones filled up."""
    width = max(x.shape[1] for x in parts)
    return torch.cat([torch.nn.functional.pad(x, (0, width - x.shape[1]), value=fill) for x in parts])


def _measured(name: str, time: ArrayLike, z: ArrayLike, u: ArrayLike | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Times ``(J,)``, values ``(J, m)`` and further inputs ``(J, l)`` of a sensor's measurements."""
    when, values = as_numbers(time, name).double(), as_numbers(z, name).double()
    inputs = values.new_zeros(len(values), 0) if u is None else as_numbers(u, name).double()
    if when.dim() != 1 or values.dim() != 2 or inputs.dim() != 2 or not len(when) == len(values) == len(inputs):
        received = ", ".join(str(tuple(x.shape)) for x in (when, values, inputs))
        raise ValueError(f"measurements: {name}: expected (J,), (J, m) and (J, l), received {received}")
    if not bool(when.isfinite().all()):
        raise ValueError(f"measurements: {name}: expected finite times, received {when.tolist()}")
    return when, values, inputs
