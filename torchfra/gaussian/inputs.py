"""What a filter can know of a step before it has a belief: checked once, and made for all steps at once."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torchfra.hyper import hypers
from torchfra.linalg.tracing import is_traced
from torchfra.motion.base import Adaptation, Motion
from torchfra.sensors.base import MeasurementNoise, Sensor
from torchfra.types import Gaussian

Time = float | Tensor


class Frame(NamedTuple):
    """All of a step that does not depend on the belief."""

    z: Tensor
    """``(..., m)``, 0 where missing."""
    seen: Tensor
    """``(..., m)``, 1 where measured and 0 where missing."""
    measurement_noise: MeasurementNoise
    dt: Tensor
    u: Tensor | None
    transition: Tensor | None
    """``F (..., n, n)``, None for a motion that is not linear."""
    shift: Tensor | None
    process_noise: Tensor
    """``S_Q (..., n, q)``."""
    adaptation: Adaptation | None
    """How shift and process follow the state."""


def make_frames(
    motion: Motion,
    sensor: Sensor,
    z: Tensor,
    dt: Time,
    u: Tensor | None,
    std: Tensor | None,
    noise: Tensor | None,
    rank: int,
) -> tuple[list[Frame], Tensor]:
    """One frame for each step of ``z (..., T, m)``, and the log of their noise, time first.

    ``rank`` is the number of batch dimensions, those of the hyperparameters included.
    """
    steps = z.shape[-2]

    def lead(x: Tensor | None, event: int) -> Tensor | None:
        """Time in front of the batch, the batch filled up to its rank."""
        if x is None:
            return None
        x = x.to(z).movedim(-1 - event, 0)
        return x.reshape(x.shape[:1] + (1,) * (rank + 1 + event - x.dim()) + x.shape[1:])

    def each(x: Any, timed: bool = True) -> Iterable[Any]:
        """One entry per step."""
        if x is None or not timed:
            return [x] * steps
        return x.unbind(0) if isinstance(x, Tensor) else (type(x)(*step) for step in zip(*map(each, x), strict=True))

    z = _certain(lead(z, 1)).contiguous()
    u = lead(u, 1)
    dt = torch.as_tensor(dt, dtype=z.dtype, device=z.device)
    timed = dt.dim() > 0 and dt.shape[-1] > 1
    dt = _certain(lead(dt, 0)) if timed else dt[..., 0] if dt.dim() else dt
    missing = z.isnan()
    scale = sensor.measurement_noise(z, lead(std, 1), lead(noise, 2))
    shift = motion.shift(dt, u)
    moving = shift is not None and shift.dim() > rank + 1 + motion.stacked
    columns = (
        each(torch.where(missing, 0.0, z)),
        each(1.0 - missing.to(z)),
        each(scale),
        each(dt, timed),
        each(u),
        each(motion.transition(dt) if motion.linear else None, timed),
        each(shift, moving),
        each(motion.process_noise(dt), timed),
        each(motion.adaptation(dt), timed),
    )
    return [Frame(*frame) for frame in zip(*columns, strict=True)], scale.log_norm


def _certain(x: Tensor | None) -> Tensor:
    assert x is not None
    return x


def batch_rank(module: nn.Module) -> int:
    """Batch dimensions that the hyperparameters of a filter bring."""
    return max(hyper.batch_rank for hyper in hypers(module).values())


def check(
    motion: Motion,
    sensor: Sensor,
    z: Tensor,
    prior: Gaussian,
    dt: Time,
    u: Tensor | None,
    std: Tensor | None,
    noise: Tensor | None,
    *,
    scans: bool = False,
) -> torch.Size:
    """The batch of what a user hands in, once shapes and values are known to fit; time is in front of the vector.

    With ``scans`` measurements are ``(..., T, J, m)`` and priors ``(..., N, n)``; targets are no part of the batch.

    Raises:
        ValueError: names the argument, what was expected and what came.
    """
    n, m = motion.size, sensor.size
    if not z.is_floating_point():
        raise ValueError(f"z: expected floating point numbers, received {z.dtype}")
    event = 2 + scans
    if z.dim() < event or z.shape[-1] != m or 0 in z.shape[-event:]:
        raise ValueError(f"z: expected (..., T, {'J, ' if scans else ''}{m}), received {tuple(z.shape)}")
    steps, each = z.shape[-event], tuple(z.shape[-2:-1]) if scans else ()
    batch = {"z": z.shape[:-event]}
    targets = (None,) if scans else ()
    root = (*targets, n, n) if prior.scale_tril.dim() > 2 else (n, n)
    for name, x, shape in (
        ("prior.mean", prior.mean, (*targets, n)),
        ("prior.scale_tril", prior.scale_tril, root),
        ("u", u, (steps, None)),
        ("std", std, (steps, *each, m)),
        ("noise", noise, (steps, *each, m, m)),
    ):
        if x is None:
            continue
        fits = x.dim() >= len(shape) and all(
            b is None or a == b for a, b in zip(x.shape[-len(shape) :], shape, strict=True)
        )
        if not fits:
            unknown = "N" if name.startswith("prior") else "k"
            wanted = ", ".join(unknown if s is None else str(s) for s in shape)
            raise ValueError(f"{name}: expected (..., {wanted}), received {tuple(x.shape)}")
        batch[name] = x.shape[: x.dim() - len(shape)]
    if scans and prior.scale_tril.dim() > 2 and prior.scale_tril.shape[-3] != prior.mean.shape[-2]:
        count = prior.mean.shape[-2]
        raise ValueError(
            f"prior.scale_tril: expected one for each of {count} targets, received {tuple(prior.scale_tril.shape)}"
        )
    if isinstance(dt, Tensor):
        if dt.dim() and dt.shape[-1] not in (1, steps):
            raise ValueError(f"dt: expected a number or (..., {steps}) or (..., 1), received {tuple(dt.shape)}")
        batch["dt"] = dt.shape[:-1]
    if not (isinstance(dt, Tensor) and is_traced(dt)) and not bool((torch.as_tensor(dt) > 0).all()):
        raise ValueError(f"dt: expected seconds above 0, received {dt}")
    try:
        return torch.Size(torch.broadcast_shapes(*batch.values()))
    except RuntimeError:
        said = ", ".join(f"{name} {tuple(shape)}" for name, shape in batch.items())
        raise ValueError(f"batch: expected shapes that broadcast, received {said}") from None
