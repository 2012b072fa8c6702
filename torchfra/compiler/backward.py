"""The backward pass of a compiled filter: one kernel over all tracks, from the last step to the first."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torchfra import tree
from torchfra.compiler.expressions import Expressions
from torchfra.gaussian.inputs import BackwardStep, Frame, Measurements
from torchfra.numbers import as_tensor
from torchfra.steps.records import decided, undecided
from torchfra.steps.recursion import HasBelief, Recursion, innermost
from torchfra.types import Gaussian

_AT_ONCE = 1 << 20
"""Steps of windows that a kernel reads at once, as each step of a track is in many."""


class BackwardInputs(NamedTuple):
    """What the kernel of a backward pass reads."""

    state: HasBelief
    """To begin with, at the last step."""
    data: dict[str, Tensor]
    """Of each step its past and what is needed of the next step, its ``dt`` and ``u``, and whether it is the last."""
    timed: dict[str, bool]
    """Which of it has an entry for each step."""
    events: dict[str, int]
    """Dimensions of one track's entry."""
    batch: torch.Size
    steps: int
    like: object
    """A past, what is needed of the next step, and the past that it was predicted from, if that is another; their
    leaves come first in the data."""
    windows: bool = False
    """Whether the last dimension of the batch counts windows; the filter's own values do not have it."""

    def begin(self, f: nn.Module, book: Expressions) -> Any:
        """The state of one track, in which all is unknown but the zeros of lower roots."""
        rank = len(self.batch)
        return _lower(tree.map_tensors(lambda x: torch.ones(x.shape[rank:], dtype=x.dtype), self.state))

    def advance(self, f: Recursion, after: object, data: dict[str, Tensor]) -> tuple[Any, Any]:
        """One step back of one track: see ``retreat``."""
        return retreat(f, self.like, after, data)


def cut(past: object, rank: int, truncate: int) -> Any:
    """A past ``(..., T, ...)`` without the gradients of steps after which those of the forward pass were cut."""

    def without(x: Tensor) -> Tensor:
        steps = torch.arange(1, x.shape[rank] + 1, device=x.device).reshape(-1, *(1,) * (x.dim() - rank - 1))
        return torch.where(steps % truncate == 0, x.detach(), x)

    return tree.map_tensors(without, past)


def windows(
    f: Recursion, past: object, source: object, measurements: Measurements, rank: int, lag: int
) -> Iterator[tuple[Any, Any, Measurements]]:
    """A track of ``lag + 1`` steps for each step that has so many later ones, along one more dimension of the batch.

    What the last step of a window has not decided yet is taken as it was at the step itself.  They come in parts, each
    of ``_AT_ONCE`` steps in all or so, and the arguments are as those of ``backward_inputs``.
    """
    shape = tree.flatten(past)[0].shape[: rank + 1]
    count, most = shape[-1] - lag, max(_AT_ONCE // max(shape[:-1].numel() * (lag + 1), 1), 1)
    for first in range(0, count, most):
        size = min(most, count - first)

        def unfolded(x: Tensor, time: int, first: int = first, size: int = size) -> Tensor:
            return x.narrow(time, first, size + lag).unfold(time, lag + 1, 1).movedim(-1, time + 1)

        def ending(x: Tensor, provisional: Tensor, first: int = first, size: int = size) -> Tensor:
            end = torch.cat([provisional.narrow(rank, 0, provisional.shape[rank] - 1), x.narrow(rank, -1, 1)], rank)
            last = end.narrow(rank, first + lag, size).unsqueeze(rank + 1)
            return torch.cat([unfolded(x, rank).narrow(rank + 1, 0, lag), last], rank + 1)

        dt, u = measurements.dt, measurements.u
        if isinstance(dt, Tensor) and dt.dim():
            dt = unfolded(dt, dt.dim() - 1) if measurements.varying_dt else dt.unsqueeze(-1)
        u = None if u is None else unfolded(u, u.dim() - 2)
        ends = (None if x is None else tree.map_tensors(ending, decided(x), undecided(x)) for x in (past, source))
        yield next(ends), next(ends), measurements._replace(dt=dt, u=u)


def of_windows(smoothed: Sequence[Any], rank: int, lag: int) -> Any:
    """What parts of the windows say: each window of its first step, the very last one of all its steps."""

    def steps(*parts: Tensor) -> Tensor:
        last = parts[-1].select(rank, -1).narrow(rank, 1, lag)
        return torch.cat([*(x.select(rank + 1, 0) for x in parts), last], rank)

    return tree.map_tensors(steps, *smoothed)


def backward_inputs(
    f: Recursion, past: object, source: object, measurements: Measurements, rank: int
) -> BackwardInputs:
    """All that the kernel of this filter reads.

    Args:
        f: the filter.
        past: ``(..., T, ...)``: see ``Filter.past``.
        source: as ``past``: see ``BackwardStep``; None where it is ``past``.
        measurements: of the forward pass.
        rank: dimensions of the batch.
    """
    past, source = decided(past), decided(source)
    following = past.of_next() if hasattr(past, "of_next") else past
    following = tree.map_tensors(lambda x: x.roll(-1, rank), following)
    varying, like, u = measurements.varying_dt, measurements.z, measurements.u
    seconds = as_tensor(measurements.dt if varying else measurements.common_dt, like)
    data = {f"past{i}": x for i, x in enumerate(tree.flatten((past, following, source)))}
    events = {name: x.dim() - rank - 1 for name, x in data.items()} | {"last": 0, "dt": 0}
    batch, steps = data["past0"].shape[:rank], data["past0"].shape[rank]
    at = torch.arange(steps, device=like.device)
    data |= {"last": (at == steps - 1).to(like), "dt": seconds.roll(-1, -1) if varying else seconds}
    if u is not None:
        data["u"], events["u"] = u.roll(-1, -2), 1
    state, _ = f.last(tree.map_tensors(lambda x: x.select(rank, -1), past))
    return BackwardInputs(
        state, data, {k: varying or k != "dt" for k in data}, events, batch, steps, (past, following, source)
    )


def _lower(x: object) -> Any:
    """The same tree, that says which entries of the roots of Gaussians are zero."""
    if isinstance(x, Gaussian):
        return Gaussian(x.mean, x.scale_tril.tril())
    if not isinstance(x, tuple):
        return x
    parts = [_lower(part) for part in x]
    return type(x)(*parts) if hasattr(x, "_fields") else tuple(parts)


def retreat(f: Recursion, like: object, after: object, data: dict[str, Tensor]) -> tuple[Any, Any]:
    """One step back of one track; at the last step, where it begins, what that says."""
    leaves = iter([x for name, x in data.items() if name.startswith("past")])
    past, following, source = _lower(tree.unflatten(like, leaves))
    dt, u, motion = data["dt"], data.get("u"), innermost(f).motion
    models = motion.transition_by(dt, u) if motion.linear else None, motion.shift(dt, u)
    noise = motion.process_noise_by(dt, u), motion.adaptation(dt)
    frame = Frame(None, None, None, dt, u, *models, *noise, f.sensor)  # type: ignore[arg-type]  # nothing is measured
    stepped = f.retreat(BackwardStep(past, following, frame, past if source is None else source), after)
    begun_or_stepped: tuple[Any, Any] = tree.where(data["last"] > 0, f.last(past), stepped)
    return begun_or_stepped
