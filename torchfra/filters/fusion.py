"""A filter in which each step of a track has a sensor of its own."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchfra import tree
from torchfra.filters.engine import Interpreted
from torchfra.filters.other_sensors import mixed, sharing
from torchfra.filters.records import Kept
from torchfra.gaussian.arguments import check
from torchfra.gaussian.inputs import Frame, Measurements, UnevenMeasurements
from torchfra.linalg.batches import broadcast_shapes
from torchfra.linalg.tracing import is_traced
from torchfra.numbers import is_integer
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian


class Fused:
    """Mixed into a view of a filter in which each step has a sensor of its own: see ``Filter.forward``."""

    viewed: Any = None
    views: list[Any]
    """The filter around each of the sensors."""
    which: list[int]
    """The index of each step's sensor."""

    def check_smooths(self) -> None:
        """Checks that the filter can be smoothed over several sensors.

        Raises:
            NotImplementedError: it cannot, with the reason.
        """
        self.viewed.check_smooths()
        self.viewed.check_smooths_several()

    def _batch(self, measurements: Measurements, prior: Gaussian, name: str = "prior") -> torch.Size:
        """Checks the arguments for each sensor; their batch."""
        sizes = [view.sensor.size for view in self.views]
        check(measurements, prior, self.viewed.motion, max(sizes), name=name, zero_dt=self.viewed.zero_dt)
        steps = measurements.z.shape[-2]
        if steps != len(self.which):
            received = f"{len(self.which)} of them"
            raise ValueError(f"which: expected the index of a sensor for each of {steps} steps, received {received}")
        beyond = torch.arange(max(sizes)) >= torch.tensor([sizes[k] for k in self.which]).unsqueeze(-1)
        wrong = (~measurements.z.isnan() & beyond.to(measurements.z.device)).reshape(-1, *beyond.shape).any(0)
        if not is_traced(measurements.z) and bool(wrong.any()):
            k, i = wrong.nonzero()[0].tolist()
            expected = f"NaN beyond the {sizes[self.which[k]]} elements of sensor {self.which[k]} at step {k}"
            raise ValueError(f"z: expected {expected}, received a number in element {i}")
        batches = [self.views[k]._batch(part, prior, name) for k, _, part in self._of_each(measurements)]
        return broadcast_shapes(*batches)

    def _frames(self, measurements: Measurements, rank: int) -> tuple[list[Frame], None]:
        """A frame for each step."""
        frames: dict[int, Frame] = {}
        for k, steps, part in self._of_each(measurements):
            frames |= zip(steps, self.views[k]._frames(part, rank)[0], strict=True)
        return [frames[step] for step in range(len(self.which))], None

    def _of_each(self, measurements: Measurements) -> list[tuple[int, list[int], Measurements]]:
        """Index, steps and measurements of each sensor that measures."""
        every = {k: [step for step, index in enumerate(self.which) if index == k] for k in sorted(set(self.which))}
        parts = (_part(measurements, steps, self.views[k].sensor.size) for k, steps in every.items())
        return [(*each, part) for each, part in zip(every.items(), parts, strict=True)]


class Stretches(Interpreted):
    """Runs a ``Fused`` filter: stretches of steps of one sensor, each by the engine of its view."""

    def over_steps(
        self, f: Any, state: Any, measurements: Measurements, rank: int, checkpoint: int | None, truncate: int | None,
        past: bool,
    ) -> tuple[Any, Kept]:  # fmt: skip
        """The state after all steps, and the kept parts of each."""
        steps = len(f.which)
        changes = {k for k in range(1, steps) if f.which[k] != f.which[k - 1]}
        bounds = sorted({0, steps} | changes | set(range(0, steps, truncate or steps)))
        kept = []
        for first, last in pairwise(bounds):
            if truncate and first and first % truncate == 0:
                state = tree.detach(state)
            view = f.views[f.which[first]]
            part = _part(measurements, list(range(first, last)), view.sensor.size)
            state, more = view.engine.over_steps(view, state, part, rank, checkpoint, None, past)
            kept.append(tree.map_tensors(lambda x: x.narrow(rank, 0, last - first), more))  # noqa: B023  # it runs now
        return state, joined(kept, rank)


def fused(f: Any, sensors: Sequence[Sensor] | None, which: Any) -> Any:
    """A view of a filter in which each step has one of the ``sensors``, by the indices ``which (T,)``.

    Raises:
        ValueError: one without the other, no sensors, or indices that are not those of the sensors.
    """
    if sensors is None or which is None:
        missing, there = ("sensors", "which") if sensors is None else ("which", "sensors")
        raise ValueError(f"{missing}: expected it beside {there}, received None")
    if not isinstance(sensors, Sequence | nn.ModuleList) or not len(sensors):
        received = "none" if isinstance(sensors, Sequence) else f"{type(sensors).__name__}: take a list"
        raise ValueError(f"sensors: expected one or more, received {received}")
    numbers = which.tolist() if isinstance(which, Tensor | np.ndarray) else which
    count = len(sensors)
    if not isinstance(numbers, Sequence) or not all(is_integer(k, 0) and k < count for k in numbers):
        raise ValueError(f"which: expected (T,) indices from 0 to {count - 1}, received {which}")
    new = sharing(f, mixed(Fused, f.__class__), engine=Stretches())
    new.__dict__.update(viewed=f, views=[f.with_sensor(sensor) for sensor in sensors], which=[int(k) for k in numbers])
    return new


def _part(measurements: Measurements, steps: list[int], size: int) -> Measurements:
    """The measurements of some steps, of their first ``size`` elements."""
    z, dt, u, std, noise = measurements
    timed = measurements.varying_dt
    return (UnevenMeasurements if timed else Measurements)(
        z[..., steps, :size],
        dt[..., steps] if timed else dt,  # type: ignore[index]  # it is a tensor
        None if u is None else u[..., steps, :],
        None if std is None else std[..., steps, :size],
        None if noise is None else noise[..., steps, :size, :size],
    )


def joined(parts: Sequence[Any], rank: int) -> Any:
    """Trees of successive stretches of time, concatenated along the dimension after ``rank`` batch dimensions.

    Dimensions of a measurement's elements are padded to the longest: with NaN, or False, or 0 for whole numbers.
    """

    def join(*xs: Tensor) -> Tensor:
        batch = broadcast_shapes(*(x.shape[:rank] for x in xs))
        event = [max(sizes) for sizes in zip(*(x.shape[rank + 1 :] for x in xs), strict=True)]
        fill = torch.nan if xs[0].is_floating_point() else 0
        filled = []
        for x in xs:
            short = [n - have for n, have in zip(event, x.shape[rank + 1 :], strict=True)]
            x = x.expand(*batch, *x.shape[rank:])
            filled.append(pad(x, [n for k in reversed(short) for n in (0, k)], value=fill) if any(short) else x)
        return torch.cat(filled, rank)

    return parts[0] if len(parts) == 1 else tree.map_tensors(join, *parts)
