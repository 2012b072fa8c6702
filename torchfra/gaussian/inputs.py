"""The inputs of a filter, and the frame of each step: the part of the step that does not depend on the belief."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from torchfra import tree
from torchfra.hyper import hypers
from torchfra.linalg.batches import broadcast_shapes
from torchfra.motion.base import Adaptation, Motion
from torchfra.numbers import as_tensor
from torchfra.sensors.base import MeasurementNoise, Sensor
from torchfra.tree import event_ranks

Time = float | Tensor
T = TypeVar("T")  # a tree


@event_ranks(z=1, dt=0, u=1, std=1, noise=2)
class Measurements(NamedTuple):
    """Measurements with their time steps, inputs and noise; time stands before the dimensions of the event."""

    z: Tensor
    """``(..., T, m)``, or ``(..., T, J, m)`` for scans; NaN is missing."""
    dt: Time = 1.0
    """Seconds since the step before: a number, or a tensor that broadcasts with ``(..., T)``."""
    u: Tensor | None = None
    """``(..., T, k)`` or ``(T, k)`` inputs that the models need at a step."""
    std: Tensor | None = None
    """Standard deviations of the measurement noise, shaped like ``z``; None for the sensor's."""
    noise: Tensor | None = None
    """Roots of the noise covariance, shaped like ``z`` with one more ``m``; None for the sensor's."""
    sensor: Sensor | None = None
    """What has measured, if it is another sensor than the filter's own."""

    @property
    def varying_dt(self) -> bool:
        """Whether each step has its own ``dt``."""
        return isinstance(self.dt, Tensor) and self.dt.dim() > 0 and self.dt.shape[-1] > 1

    @property
    def common_dt(self) -> Time:
        """``dt`` without the dimension of time, where it does not vary."""
        return self.dt[..., 0] if isinstance(self.dt, Tensor) and self.dt.dim() else self.dt

    def as_track(self, *, scans: bool = False) -> Measurements:
        """A single step as a track of one step: ``z (..., m)`` and all others get a dimension of time.

        Raises:
            ValueError: a tensor has fewer dimensions than a step of it.
        """
        dt = self.dt.unsqueeze(-1) if isinstance(self.dt, Tensor) and self.dt.dim() else self.dt
        timed = {}
        for name, event in (("z", 1 + scans), ("u", 1), ("std", 1 + scans), ("noise", 2 + scans)):
            x: Tensor | None = getattr(self, name)
            if x is not None and x.dim() < event:
                raise ValueError(f"{name}: expected {event} or more dimensions, received {tuple(x.shape)}")
            timed[name] = None if x is None else x.unsqueeze(-1 - event)
        return Measurements(dt=dt, sensor=self.sensor, **timed)  # type: ignore[arg-type]  # z is one


@event_ranks(z=1, dt=0, u=1, std=1, noise=2)
class UnevenMeasurements(Measurements):
    """Part of a track in which each step has its own ``dt``, even if the part is a single step."""

    varying_dt = True


@event_ranks(z=1, dt=0, u=1, std=1, noise=2)
class CompleteScans(Measurements):
    """Scans whose measurements are complete or missing, and have the same noise."""


@event_ranks(z=1, measured=1, dt=0, u=1, transition=2, shift=1, process_noise=2)
class Frame(NamedTuple):
    """The part of a step that does not depend on the belief."""

    z: Tensor
    """``(..., m)``, 0 where missing."""
    measured: Tensor
    """``(..., m)``, 1 where measured and 0 where missing."""
    measurement_noise: MeasurementNoise
    dt: Tensor
    u: Tensor | None
    transition: Tensor | None
    """``F (..., n, n)``, None for a motion that is not linear."""
    shift: Tensor | None
    process_noise: Tensor
    """``S_Q (..., n, r)``."""
    adaptation: Adaptation | None
    """How shift and process noise depend on the estimated acceleration; None where they do not."""
    sensor: Sensor
    """What has measured."""


class BackwardStep(NamedTuple):
    """One step of the backward pass: what the forward pass kept of two successive steps, and the frame between them."""

    past: Any
    """The past of the step that is smoothed: see ``Filter.past``."""
    next: Any
    """The past of the step after it."""
    frame: Frame
    """The frame of the time step between the two."""
    source: Any
    """The past from which the next step was predicted: ``past``, detached if the forward pass was truncated after it.

    Later measurements enter as the difference of the smoothed state and this prediction.  If only one of the two had a
    gradient, the gradient of their difference would be dominated by rounding errors.
    """


def make_frames(measurements: Measurements, motion: Motion, sensor: Sensor, rank: int) -> tuple[list[Frame], Tensor]:
    """One frame for each step of ``z (..., T, m)``, and the log norms of their measurement noise, ``(T, ...)``.

    ``rank`` is the number of batch dimensions, those of the hyperparameters included.
    """
    varying, like = measurements.varying_dt, measurements.z

    def time_first(event: int, x: Tensor) -> Tensor:
        """The tensor with time in front of a batch of full rank."""
        x = x.to(like).movedim(-1 - event, 0)
        return x.reshape(x.shape[:1] + (1,) * (rank + 1 + event - x.dim()) + x.shape[1:])

    own = measurements if varying else measurements._replace(dt=None)  # type: ignore[arg-type]  # one dt for all
    z, every_dt, u, std, noise, _ = tree.map_ranked(time_first, own)
    z = z.contiguous()
    dt = every_dt if isinstance(every_dt, Tensor) else as_tensor(measurements.common_dt, z)
    missing = z.isnan()
    measurement_noise = sensor.measurement_noise(z, std, noise)
    shift = motion.shift(dt, u)
    transition = motion.transition_by(dt, u) if motion.linear else None
    models = (transition, motion.process_noise_by(dt, u), motion.adaptation(dt))
    _check_models(motion, shift, *models[:2])
    steps = len(z)

    def timed(x: Tensor | None, event: int) -> bool:
        """Whether a result of the motion has a dimension of time: with ``u`` even where all steps have one ``dt``."""
        return x is not None and (varying or x.dim() > rank + event + motion.stacked)

    def with_time(event: int, x: Tensor) -> Tensor:
        """A result of the motion with a dimension of time."""
        return x.expand(steps, *x.shape) if x.dim() < 1 + rank + motion.stacked + event else x

    if varying:
        models, shift = tree.map_ranked(with_time, models, rank=2), None if shift is None else with_time(1, shift)

    def each(x: T, by_step: bool = True) -> list[T]:
        return tree.unbind(x, steps) if by_step else [x] * steps

    transition, process_noise, adaptation = models
    columns = (
        each((torch.where(missing, 0.0, z), 1.0 - missing.to(z), measurement_noise, u)),
        each((dt, adaptation), varying),
        each(transition, timed(transition, 2)),
        each(shift, timed(shift, 1)),
        each(process_noise, timed(process_noise, 2)),
    )
    frames = [
        Frame(z, measured, unit, dt, u, transition, shift, process_noise, adaptation, sensor)
        for (z, measured, unit, u), (dt, adaptation), transition, shift, process_noise in zip(*columns, strict=True)
    ]
    return frames, measurement_noise.log_norm


def _check_models(motion: Motion, shift: Tensor | None, transition: Tensor | None, noise: Tensor) -> None:
    """Checks the shapes of shift, transition and process noise of a motion.

    Raises:
        ValueError: names the motion, the shape that was expected and the one that came.
    """
    n = motion.size
    parts = {"shift": (shift, (n,)), "transition": (transition, (n, n)), "process_noise": (noise, (n, "r"))}
    for name, (x, shape) in parts.items():
        if x is None:
            continue
        received = tuple(x.shape[-len(shape) :])
        if len(received) < len(shape) or received[0] != n or received[-1] != shape[-1] != "r":
            expected = ", ".join(map(str, shape))
            raise ValueError(f"{type(motion).__name__}.{name}: expected (..., {expected}), received {tuple(x.shape)}")


def value_batches(module: nn.Module) -> dict[str, torch.Size]:
    """The batches of a filter's hyperparameters that have one, by path."""
    known = hypers(module).items()
    return {path: hyper.raw.shape[: hyper.batch_rank] for path, hyper in known if hyper.raw.dim() > hyper.event_dim}


def batch_rank(module: nn.Module) -> int:
    """Number of batch dimensions of a filter's hyperparameters."""
    return max([0, *[len(x) for x in value_batches(module).values()]])


def broadcast_with_values(batch: torch.Size, batches: dict[str, torch.Size]) -> torch.Size:
    """The batch of tracks broadcast with the ``batches`` of hyperparameters, by path.

    Raises:
        ValueError: values that do not broadcast with the tracks.
    """
    common = batch
    for path, values in batches.items():
        try:
            common = broadcast_shapes(common, values)
        except RuntimeError:
            expected = f"values that broadcast with tracks {tuple(batch)}"
            raise ValueError(f"{path}: expected {expected}, received {tuple(values)}") from None
    return common
