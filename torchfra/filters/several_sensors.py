"""A filter around other sensors than its own, and tracks of which each step has a sensor of its own."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

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
from torchfra.steps.checks import check_models
from torchfra.steps.loop import Options, finish, start
from torchfra.types import Estimate, Gaussian

_VIEWS = 32
"""Number of views that a filter keeps.  With a new sensor for every step, every step makes a new view."""


class SensorViews:
    """A filter's views around other sensors; each is made at the first call for its sensor.

    Args:
        originals: sensors that the filter's own is a copy of: they count as its own.
    """

    def __init__(self, *originals: Sensor) -> None:
        self._originals, self._views = originals, dict[int, Any]()

    def __reduce__(self) -> tuple[type[SensorViews], tuple[Sensor, ...]]:
        return SensorViews, self._originals  # a copy of the filter makes its own

    def __call__(self, f: Any, sensor: Sensor) -> Any:
        """The view of ``f`` around ``sensor``, brought up to date with the filter."""
        if any(sensor is x for x in self._originals):
            return f
        view = self._views.pop(id(sensor), None)
        if view is None or any(f._modules[name] is not part for name, part in view.replaced.items()):
            check_models(f.motion, sensor)
            parts = f.parts_for(sensor)
            view = sharing(f, engine=f.engine.another(), **parts)
            replaced = {name: f._modules[name] for name in parts if name != "sensor"}
            view.__dict__.update(_viewed=f, replaced=replaced)
            if len(self._views) == _VIEWS:  # the one that was used least recently goes
                self._views.pop(next(iter(self._views)))
        self._views[id(sensor)] = view
        share(f, view)
        for name, part in view.replaced.items():
            if hasattr(part, "with_sensor"):
                view._modules[name] = part.with_sensor(sensor)
            else:
                share(part, view._modules[name])
        if type(f.engine) is not type(view.engine):
            view.engine = f.engine.another()
        return view


def sharing(module: nn.Module, **own: Any) -> Any:
    """A module that shares all parts and values of ``module`` except those in ``own``, without copies.

    Modules in ``own`` become its parts, other values its attributes.
    """
    new: Any = module.__new__(type(module))
    new.__dict__.update(_modules={}, _own=frozenset(own))
    share(module, new)
    for name, x in own.items():
        (new._modules if isinstance(x, nn.Module) else new.__dict__)[name] = x
    return new


def share(module: nn.Module, new: Any) -> None:
    """Updates a module made by ``sharing`` with the current parts and values of the original."""
    if "_own" not in new.__dict__:
        return  # a rule of points, which ``parts_for`` has made for the other sensor, shares nothing
    own: frozenset[str] = new._own | {"_modules"}
    new.__dict__.update({name: x for name, x in module.__dict__.items() if name not in own})
    new._modules.update({name: x for name, x in module._modules.items() if name not in own})


class SensorsInTurn:
    """The sensors of a track, of which each step has one: see ``Filter.forward``.

    Args:
        f: the filter.
        sensors: all that measure.
        which: ``(T,)`` index of each step's sensor.

    Raises:
        ValueError: one without the other, no sensors, or indices that are not those of the sensors.
    """

    def __init__(self, f: Any, sensors: Sequence[Sensor] | None, which: Any) -> None:
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
        self.filter, self.which = f, [int(k) for k in numbers]
        self.views = [f.with_sensor(sensor) for sensor in sensors]

    def _batch(self, measurements: Measurements, prior: Gaussian, name: str = "prior") -> torch.Size:
        """Checks the arguments for each sensor; their batch."""
        sizes = [view.sensor.size for view in self.views]
        check(measurements, prior, self.filter.motion, max(sizes), name=name, zero_dt=self.filter.zero_dt)
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

    def forward(
        self, f: Any, measurements: Measurements, prior: Gaussian, options: Options
    ) -> tuple[Estimate, Any, Any]:
        """Filters whole tracks from their prior, stretches of steps of one sensor by the engine of its view."""
        steps, truncate = len(self.which), options.truncate
        state, rank = start(f, measurements, prior, self._batch(measurements, prior))
        changes = {k for k in range(1, steps) if self.which[k] != self.which[k - 1]}
        bounds = sorted({0, steps} | changes | set(range(0, steps, truncate or steps)))
        parts = []
        for first, last in pairwise(bounds):
            if truncate and first and first % truncate == 0:
                state = tree.detach(state)
            view = self.views[self.which[first]]
            part = _part(measurements, list(range(first, last)), view.sensor.size)
            state, more = view.engine.scan(view, state, part, rank, options._replace(truncate=None))
            parts.append(tree.map_tensors(lambda x: x.narrow(rank, 0, last - first), more))  # noqa: B023  # it runs now
        kept = joined(parts, rank)
        return finish(f, state, kept), state, kept.past


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
