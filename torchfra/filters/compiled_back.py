"""The way back of a compiled filter: one kernel over all tracks, from the last step to the first."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfra import tree
from torchfra.filters.smoothing import Told
from torchfra.gaussian.inputs import Frame, Measurements
from torchfra.tree import event_ranks
from torchfra.types import Gaussian


@event_ranks(mean=1, scale_tril=2, factor=0, dt=0, u=1, last=0)
class Back(NamedTuple):
    """What the way back is given at a step: its filtered belief, and of the step that led on from it all else."""

    mean: Tensor
    scale_tril: Tensor
    factor: Tensor | None
    dt: Tensor
    u: Tensor | None
    last: Tensor
    """``(...)`` 1 at the last step of a track, which nothing leads on from."""


def given(past: Any, measurements: Measurements, rank: int) -> tuple[Told, Any, tuple[bool, ...]]:
    """The state to begin with, what the kernel is given (see ``Back``), and which of it varies over time.

    Args:
        past: ``(..., T, ...)``: see ``filters.tracks.Past``.
        measurements: of the way forward.
        rank: dimensions of the batch.
    """
    (mean, root), factor, _ = past
    varying, like, u = measurements.varying_dt, measurements.z, measurements.u
    seconds = torch.as_tensor(measurements.dt if varying else measurements.common_dt).to(like)
    at = torch.arange(mean.shape[rank], device=mean.device)
    data = Back(
        mean,
        root,
        None if factor is None else factor.roll(-1, -1),
        seconds.roll(-1, -1) if varying else seconds,
        None if u is None else u.roll(-1, -2),
        (at == len(at) - 1).to(like),
    )
    state = Told(Gaussian(mean.select(rank, -1), root.select(rank, -1)))
    return state, data, (True, True, True, varying, True, True)


def retreat(f: Any, after: Told, data: dict[str, Tensor]) -> tuple[Told, Told]:
    """One step back of one track; at the last step, where it begins, the filtered belief."""
    x = Back(*(data.get(name) for name in Back._fields))  # type: ignore[arg-type]  # only factor and u are ever None
    belief, motion = Gaussian(x.mean, x.scale_tril.tril()), f.motion
    models = motion.transition(x.dt) if motion.linear else None, motion.shift(x.dt, x.u)
    noise = motion.process_noise(x.dt), motion.adaptation(x.dt)
    frame = Frame(None, None, None, x.dt, x.u, *models, *noise)  # type: ignore[arg-type]  # nothing is measured
    told = f.reverse(belief, f.carry(belief, frame, x.factor), after.belief)
    told = told._replace(belief=tree.where(x.last > 0, belief, told.belief))
    return Told(told.belief), told
