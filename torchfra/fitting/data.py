"""The data of a fit: tracks as one batch, from scenarios, functions, tensors, loaders or recordings.

Tracks without a prior get one from their first measurement.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Mapping
from itertools import chain
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad
from torch.utils.data import DataLoader, Dataset

from torchfra.filters import Filter
from torchfra.motion.base import Motion
from torchfra.numbers import Array, as_tensor, unmasked
from torchfra.scenarios.base import Scenario, Tracks
from torchfra.sensors.base import Sensor
from torchfra.targets.births import OnePoint
from torchfra.targets.places import place
from torchfra.tree import flatten, map_tensors
from torchfra.types import Gaussian

FIELDS = ("z", "std", "dt", "u", "prior", "truth")
"""Names of tensors; all but ``z`` are optional."""
Simulator = Callable[..., Any]
Source = Scenario | Simulator | Tensor | Tracks | Mapping[str, Any] | Iterable[Any]


@runtime_checkable
class Recorded(Protocol):
    """The track of one target, such as a recording that ``readers.read`` has read."""

    name: str
    """Of the target; estimates, whose positions are no measurements, have times and positions too, but no name."""
    time: Array
    """``(T,)`` seconds."""
    position: Array
    """``(T, d)`` metres."""


class First(NamedTuple):
    """The first measurement of a track, from which its prior is made with the current noise; it is not used again."""

    z: Tensor
    """``(N, m)``."""
    u: Tensor | None
    """``(N, k)`` inputs of the sensor."""
    step: Tensor
    """``(N,)`` m/s, the speed of the first step; NaN where it is not measured."""
    speed: Tensor
    """``(N,)`` m/s, the standard deviation of the velocity in each direction."""


class Batch(NamedTuple):
    """N tracks; those with fewer steps than the longest are padded with NaN."""

    z: Tensor
    """``(N, T, m)`` measurements, or scans ``(N, T, J, m)``."""
    prior: Gaussian | First
    """``(N, n)`` and ``(N, n, n)``, one ``dt`` before the first measurement; for several targets ``(N, K, n)``.  For
    tracks without a prior: their first measurement, one ``dt`` before the first of ``z``."""
    dt: Tensor
    """``(N, T)`` seconds since the step before."""
    u: Tensor | None
    """``(N, T, k)`` inputs of the models."""
    truth: Tensor | None
    """``(N, T, n)`` states, NaN where unknown; None if none is known."""
    std: Tensor | None = None
    """``(N, T, m)`` standard deviations of the measurements; None for the sensor's."""

    def rows(self, index: Tensor | slice) -> Batch:
        """Some of the tracks."""
        rows: Batch = map_tensors(lambda x: x[index], self)
        return rows

    def to(self, dtype: torch.dtype) -> Batch:
        """The batch in another precision."""
        batch: Batch = map_tensors(lambda x: x.to(dtype), self)
        return batch

    def belief(self, f: Filter) -> Gaussian:
        """The priors of the tracks for the filter with its current values."""
        return self.prior if isinstance(self.prior, Gaussian) else started(f.motion, f.sensor, self.prior)

    def begun_as(self, others: Batch) -> Batch:
        """The batch with velocities in its priors that are as uncertain as the first steps of ``others`` say."""
        if isinstance(self.prior, Gaussian) or isinstance(others.prior, Gaussian):
            return self
        step = self.prior.step
        return self._replace(prior=self.prior._replace(speed=_uncertain(others.prior.step).expand_as(step)))

    def sums(self) -> list[list[float]]:
        """Weighted sums of what was given of each track, by which a resumed fit knows the tracks.

        They are of means over time, and of deviations from these, which large coordinates would hide.  On another
        processor they differ by rounding, as computed coordinates do.
        """
        # A ``First`` has more, which z says.
        given = flatten((self.z, self.prior[:2], self.dt, self.u, self.truth, self.std))
        parts = torch.cat([_means_and_deviations(x.detach().to("cpu", torch.float64)) for x in given], -1)
        weights = torch.linspace(1.0, 2.0, parts.shape[-1], dtype=torch.float64)
        sums: list[list[float]] = (parts.nan_to_num(math.pi) * weights).sum(-1).T.tolist()
        return sums


def _means_and_deviations(x: Tensor) -> Tensor:
    """``(2, N, K)``: means over time of tracks ``(N, T, ...)``, and the deviations from them."""
    mean = x.nanmean(1, keepdim=True).expand_as(x)
    deviation = x - mean
    deviation = torch.where(deviation.abs() < 1e-9 * mean.abs(), 0.0, deviation)  # rounding of what is constant
    return torch.stack([mean, deviation]).flatten(2)


def batch_of(f: Filter, data: Source, *, runs: int, seed: int) -> Batch:
    """The tracks of any source as one batch, where the filter is.

    Args:
        f: the filter that learns.
        data: see ``torchfra.fit``.
        runs: tracks of a scenario or a function.
        seed: of a scenario or a function.

    Raises:
        ValueError: data of no known form, shapes that do not fit, or no prior where the sensor does not locate targets.
    """
    if isinstance(data, Scenario):
        return _as_batch(f, {**data.simulate(runs, seed)._asdict(), "dt": data.dt})
    if callable(data) and not isinstance(data, DataLoader):
        takes_runs = len(inspect.signature(data).parameters) > 1
        data = data(seed, runs) if takes_runs else data(seed)
    rank = 3 + f.scans
    if isinstance(data, Tensor | np.ndarray | Mapping | Tracks):
        fields = _fields(data)
        return _as_batch(f, _joined([fields], rank) if np.ndim(fields["z"]) == rank - 1 else fields)
    if isinstance(data, Dataset) and hasattr(data, "__len__"):
        data = [data[i] for i in range(len(data))]
    if not isinstance(data, Iterable):
        expected = "a Scenario, a function of a seed, tensors, a DataLoader or recordings"
        raise ValueError(f"data: expected {expected}, received {type(data).__name__}")
    items = list(data)
    if items and all(isinstance(item, Recorded) for item in items):
        return _recorded(f, items)
    if not items:
        raise ValueError("data: expected one track or more, received none")
    return _as_batch(f, _joined([_fields(item) for item in items], rank))


def _fields(item: object) -> dict[str, Any]:
    """Tensors by name.

    Raises:
        ValueError: something else, or an unknown name.
    """
    if hasattr(item, "_asdict"):
        item = item._asdict()
    elif isinstance(item, Tensor | np.ndarray):
        item = {"z": item}
    elif isinstance(item, list | tuple) and len(item) == 1:  # of a TensorDataset
        item = {"z": item[0]}
    if not isinstance(item, Mapping) or "z" not in item or not set(item) <= set(FIELDS):
        received = sorted(map(str, item)) if isinstance(item, Mapping) else type(item).__name__
        raise ValueError(f"data: expected z (N, T, m), or a dictionary of {', '.join(FIELDS)}, received {received}")
    return {name: unmasked(x) for name, x in item.items() if x is not None}


def _joined(items: list[dict[str, Any]], rank: int) -> dict[str, Any]:
    """Single tracks, or batches of them, one after the other, padded to the longest."""
    if any(set(item) != set(items[0]) for item in items):
        raise ValueError(f"data: expected the same names in each item, received {[sorted(item) for item in items[:3]]}")
    parts = [_batched(item, rank) for item in items]
    if any(part["z"].shape[2:] != parts[0]["z"].shape[2:] for part in parts):
        received = sorted({tuple(part["z"].shape[2:]) for part in parts})
        raise ValueError(f"z: expected measurements of one size in all items, received {received}")
    longest = max(part["z"].shape[1] for part in parts)
    fills = {"z": math.nan, "truth": math.nan, "std": 1.0, "dt": 1.0, "u": 0.0}
    joined: dict[str, Any] = {
        name: torch.cat(
            [lengthened(part[name], longest, fill, 2 if rank == 4 and name == "truth" else 1) for part in parts]
        )
        for name, fill in fills.items()
        if name in parts[0]
    }
    if "mean" in parts[0]:
        joined["prior"] = Gaussian(*(torch.cat([part[name] for part in parts]) for name in ("mean", "root")))
    return joined


def _batched(item: dict[str, Any], rank: int) -> dict[str, Tensor]:
    """A track or a batch of them as a batch, whose tensors are all expanded to it."""
    z, scans = as_tensor(item["z"]), rank - 3
    many = z.dim() == rank
    z = z if many else z.unsqueeze(0)
    count, steps = z.shape[:2]
    batch = {"z": z}
    if "dt" in item:
        dt = torch.as_tensor(item["dt"], dtype=torch.float64)
        each = many and dt.dim() == 1 and len(dt) == count  # a loader has put the numbers of its tracks together
        batch["dt"] = _expanded("dt", dt.unsqueeze(-1) if each else dt, (count, steps))
    if "u" in item:
        batch["u"] = _expanded("u", as_tensor(item["u"]), (count, steps, -1))
    if "std" in item:
        batch["std"] = _expanded("std", as_tensor(item["std"]), z.shape)
    if "truth" in item:
        truth = as_tensor(item["truth"])
        batch["truth"] = truth if many else truth.unsqueeze(0)
    if "prior" in item:
        mean, root = _belief(item["prior"])
        batch["mean"] = mean.expand(count, *mean.shape[mean.dim() - 1 - scans :])
        batch["root"] = root.expand(*batch["mean"].shape, mean.shape[-1])
    return batch


def _expanded(name: str, x: Tensor, shape: tuple[int, ...]) -> Tensor:
    """A tensor, expanded to each step of each track.

    Raises:
        ValueError: it does not broadcast to them.
    """
    try:
        return x.expand(shape)
    except RuntimeError:
        letters = "(N, T)" if len(shape) == 2 else "(N, T, k)"
        received = f"{tuple(x.shape)} for N, T = {shape[:2]}"
        raise ValueError(f"{name}: expected a shape that broadcasts to {letters}, received {received}") from None


def _belief(prior: object) -> tuple[Tensor, Tensor]:
    """Mean and root of a prior.

    Raises:
        ValueError: it is no prior.
    """
    if not isinstance(prior, tuple) or len(prior) != 2:
        raise ValueError(f"prior: expected a Gaussian, received {type(prior).__name__}")
    mean, root = map(as_tensor, prior)
    return mean, root


def lengthened(x: Tensor, longest: int, fill: float, time: int) -> Tensor:
    """The tensor with its dimension ``time`` padded to ``longest`` steps."""
    more = list(x.shape)
    more[time] = longest - x.shape[time]
    return torch.cat([x, x.new_full(more, fill)], time)


def _recorded(f: Filter, recordings: list[Recorded]) -> Batch:
    """The fixes of recordings as measurements."""
    size = f.sensor.size
    if any(recording.position.shape[1] < size for recording in recordings):
        raise ValueError(f"data: expected recordings of {size} dimensions, as the sensor has, received fewer")
    tracks = [{"z": x.position[:, :size], "dt": np.diff(x.time - x.time[0], prepend=-1.0)} for x in recordings]
    return _as_batch(f, _joined(tracks, 3))


def _as_batch(f: Filter, fields: dict[str, Any]) -> Batch:
    """The batch of tensors, all with tracks first.

    Raises:
        ValueError: a shape that does not fit, or no prior where the sensor does not locate targets.
    """
    z = as_tensor(fields["z"]).to(next(chain(f.parameters(), f.buffers())).device)
    rank = 3 + f.scans
    if z.dim() != rank or z.shape[-1] != f.sensor.size or not z.is_floating_point():
        letters = f"(N, T, J, {f.sensor.size})" if f.scans else f"(N, T, {f.sensor.size})"
        raise ValueError(f"z: expected floating point numbers {letters}, received {tuple(z.shape)} {z.dtype}")
    count, steps = z.shape[:2]
    if not count:
        raise ValueError("data: expected one track or more, received none")
    if isinstance(fields.get("dt"), str):
        raise ValueError(f"dt: expected seconds, received {fields['dt']!r}")
    dt = as_tensor(fields.get("dt", 1.0), z)
    dt = _expanded("dt", dt, (count, steps)).contiguous()
    u, truth = fields.get("u"), fields.get("truth")
    u = None if u is None else _expanded("u", as_tensor(u, z), (count, steps, -1))
    truth = None if truth is None else as_tensor(truth, z)
    if truth is not None and (len(truth), truth.shape[1 + f.scans]) != (count, steps):
        raise ValueError(f"truth: expected {count} tracks of {steps} steps, received {tuple(truth.shape)}")
    if truth is not None and bool(truth.isnan().all()):
        truth = None
    if "prior" not in fields:
        if f.scans or "std" in fields:
            which = "per target and track of scans" if f.scans else "per track where std is given"
            raise ValueError(f"prior: expected one belief {which}, received none")
        return _started(f, z, dt, u, truth)
    mean, root = (x.to(z) for x in _belief(fields["prior"]))
    if mean.dim() > 1 + f.scans and len(mean) not in (1, count):
        raise ValueError(f"prior: expected one, or one for each of {count} tracks, received {len(mean)}")
    mean = mean.expand(count, *mean.shape[mean.dim() - 1 - f.scans :])
    prior = Gaussian(mean, root.expand(*mean.shape, mean.shape[-1]))
    std = _expanded("std", as_tensor(fields["std"], z), z.shape) if "std" in fields else None
    return Batch(z, prior, dt, u, truth, std)


def _started(f: Filter, z: Tensor, dt: Tensor, u: Tensor | None, truth: Tensor | None) -> Batch:
    """Tracks without a prior: their first complete measurement becomes it.

    The velocity is uncertain by twice the speed of a typical first step.

    Raises:
        ValueError: the sensor does not locate targets, a track without a complete measurement, or tracks of one step.
    """
    if not f.sensor.locates:
        expected = f"one belief per track, as {f.sensor.describe()} does not tell where a target is (locates, locate)"
        raise ValueError(f"prior: expected {expected}, received none")
    z, dt, u, truth = _from_first_measurement(z, dt, u, truth)
    if z.shape[1] < 2:
        raise ValueError("data: expected two steps or more in tracks without a prior, received one")
    inputs = [None if u is None else u[:, k] for k in (0, 1)]
    with torch.no_grad():
        here, there = (place(f.motion, f.sensor, z[:, k], inputs[k]).mean for k in (0, 1))
    step = torch.linalg.vector_norm((there - here) / dt[:, 1:2], dim=-1)
    first = First(z[:, 0], inputs[0], step, _uncertain(step).expand_as(step))
    u, truth = (None if x is None else x[:, 1:] for x in (u, truth))
    return Batch(z[:, 1:], first, dt[:, 1:], u, truth)


def _uncertain(step: Tensor) -> Tensor:
    """Standard deviation ``()`` of velocities: twice the root mean square of the finite speeds of first steps ``(N,)``.

    Where none is above 0 it is that of a birth.
    """
    speed = step[step.isfinite()].square().mean().sqrt()
    return torch.where(speed > 0, 2.0 * speed, OnePoint().velocity)


def _from_first_measurement(
    z: Tensor, dt: Tensor, u: Tensor | None, truth: Tensor | None
) -> tuple[Tensor, Tensor, Tensor | None, Tensor | None]:
    """Tracks ``(N, T, ...)`` shifted so that they begin with their first complete measurement.

    Measurements are padded with NaN, all else with the last step.
    """
    complete = ~z.isnan().any(-1)
    if not bool(complete.any(1).all()):
        lacking = (~complete.any(1)).nonzero().flatten().tolist()
        raise ValueError(f"data: expected a complete measurement in each track, received none in tracks {lacking[:5]}")
    steps = torch.arange(z.shape[1], device=z.device) + complete.to(torch.int8).argmax(1, keepdim=True)  # (N, T)
    over, steps = steps >= z.shape[1], steps.clamp_max(z.shape[1] - 1)

    def moved(x: Tensor) -> Tensor:
        index = steps.reshape(*steps.shape, *[1] * (x.dim() - 2)).expand(*steps.shape, *x.shape[2:])
        return x.gather(1, index)

    u, truth = (None if x is None else moved(x) for x in (u, truth))
    return torch.where(over.unsqueeze(-1), torch.nan, moved(z)), moved(dt), u, truth


def started(motion: Motion, sensor: Sensor, first: First) -> Gaussian:
    """Beliefs ``(..., N, n)`` at the first measurements, with the sensor's current noise and a velocity of 0.

    All other components are those of a birth (``torchfra.targets.births.OnePoint``).
    """
    at = place(motion, sensor, first.z, first.u)
    dims = at.mean.shape[-1]
    free = first.speed[:, None, None] * torch.eye(dims, dtype=at.mean.dtype, device=at.mean.device)
    free = free.expand_as(at.scale_tril)
    both = torch.cat([pad(at.scale_tril, (0, dims)), pad(free, (dims, 0))], -2)
    return OnePoint().belief(motion, pad(at.mean, (0, dims)), both)
