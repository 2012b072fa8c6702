"""Tracks of which each step has a sensor of its own."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchfra import tree
from torchfra.gaussian.arguments import check
from torchfra.gaussian.inputs import Frame, Measurements, UnevenMeasurements
from torchfra.linalg.batches import broadcast_shapes
from torchfra.linalg.tracing import is_traced
from torchfra.numbers import is_integer
from torchfra.sensors.base import Sensor
from torchfra.steps.engine import Engine
from torchfra.steps.loop import Options, finish, start
from torchfra.steps.recursion import Recursion, S
from torchfra.types import Estimate, Gaussian

T = TypeVar("T")  # a tree


class SensorsInTurn:
    """The sensors of a track, of which each step has one: see ``Filter.forward``.

    Args:
        f: the filter.
        engine: that runs its steps.
        sensors: all that measure.
        which: ``(T,)`` index of each step's sensor.

    Raises:
        ValueError: one without the other, no sensors, or indices that are not those of the sensors.
    """

    def __init__(
        self, f: Recursion, engine: Engine, sensors: Sequence[Sensor] | None, which: Tensor | Sequence[int] | None
    ) -> None:
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
        self.filter, self.engine, self.which = f, engine, [int(k) for k in numbers]
        self.sensors = [f.other_sensor(sensor) for sensor in sensors]
        self.sizes = [(sensor or f.sensor).size for sensor in self.sensors]

    def _batch(self, measurements: Measurements, prior: Gaussian, name: str = "prior") -> torch.Size:
        """Checks the arguments for each sensor; their batch."""
        sizes = self.sizes
        check(measurements, prior, self.filter.motion, max(sizes), name=name, zero_dt=self.filter.limits.zero_dt)
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
        batches = [self.filter._batch(part, prior, name) for _, part in self._of_each(measurements)]
        return broadcast_shapes(*batches)

    def _frames(self, measurements: Measurements, rank: int) -> tuple[list[Frame], None]:
        """A frame for each step."""
        frames: dict[int, Frame] = {}
        for steps, part in self._of_each(measurements):
            frames |= zip(steps, self.filter._frames(part, rank)[0], strict=True)
        return [frames[step] for step in range(len(self.which))], None

    def _of_each(self, measurements: Measurements) -> list[tuple[list[int], Measurements]]:
        """Steps and measurements of each sensor that measures."""
        every = ([step for step, index in enumerate(self.which) if index == k] for k in sorted(set(self.which)))
        return [(steps, self._part(measurements, steps)) for steps in every]

    def forward(
        self, f: Recursion[S], measurements: Measurements, prior: Gaussian, options: Options
    ) -> tuple[Estimate, S, Any]:
        """Filters whole tracks from their prior, in stretches of steps of one sensor."""
        steps, truncate = len(self.which), options.truncate
        state, rank = start(f, measurements, prior, self._batch(measurements, prior))
        changes = {k for k in range(1, steps) if self.which[k] != self.which[k - 1]}
        bounds = sorted({0, steps} | changes | set(range(0, steps, truncate or steps)))
        parts = []
        for first, last in pairwise(bounds):
            if truncate and first and first % truncate == 0:
                state = tree.detach(state)
            part = self._part(measurements, list(range(first, last)))
            state, more = self.engine.scan(f, state, part, rank, options._replace(truncate=None))
            parts.append(tree.map_tensors(lambda x: x.narrow(rank, 0, last - first), more))  # noqa: B023  # it runs now
        kept = joined(parts, rank)
        return finish(f, state, kept), state, kept.past

    def _part(self, measurements: Measurements, steps: list[int]) -> Measurements:
        """The measurements of some steps, all of one sensor."""
        z, dt, u, std, noise, _ = measurements
        k, timed = self.which[steps[0]], measurements.varying_dt
        size = self.sizes[k]
        return (UnevenMeasurements if timed else Measurements)(
            z[..., steps, :size],
            dt[..., steps] if timed else dt,  # type: ignore[index]  # it is a tensor
            None if u is None else u[..., steps, :],
            None if std is None else std[..., steps, :size],
            None if noise is None else noise[..., steps, :size, :size],
            self.sensors[k],
        )


def joined(parts: Sequence[T], rank: int) -> T:
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
