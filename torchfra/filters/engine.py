"""How a filter runs: its step over time, forwards and backwards."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Protocol

import torch

from torchfra import tree
from torchfra.filters.records import Kept, Smoothed
from torchfra.gaussian.inputs import BackwardStep, Frame, Measurements
from torchfra.hyper import same_values, spoilt
from torchfra.types import Estimate, Gaussian

Function = Callable[[Any, Any, Frame], tuple[Any, Any]]
"""From a filter, its state and a frame to the next state and a result of the step."""


class Engine(Protocol):
    """Runs the steps of one filter.  A filter holds an engine; ``Filter.compile`` replaces it."""

    def call(self, method: Callable[..., Estimate], f: Any, *arguments: Any, **options: Any) -> Estimate:
        """The result of a method of the filter for whole tracks, ``method(f, *arguments, **options)``."""

    def step(self, f: Any, state: Any, measurements: Measurements, watched: bool = False) -> tuple[Any, Any]:
        """The state after one measurement, and its innovation; it checks shapes and values.

        Args:
            f: the filter.
            state: before the measurement.
            measurements: of the step.
            watched: whether to return, instead of the innovation, a triple of innovation, alarm and a copy of the
                belief.
        """

    def once(self, f: Any, function: Function, state: Any, measurements: Measurements) -> tuple[Any, Any]:
        """The result of ``function(f, state, frame)`` for one measurement that has been checked."""

    def over_steps(
        self, f: Any, state: Any, measurements: Measurements, rank: int, checkpoint: int | None, truncate: int | None,
        past: bool,
    ) -> tuple[Any, Kept]:  # fmt: skip
        """The state after all steps, and the ``Kept`` parts of each, time behind ``rank`` batch dimensions.

        Args:
            f: the filter.
            state: before the first step.
            measurements: of all steps, checked.
            rank: batch dimensions.
            checkpoint: steps between states that are kept for gradients; the steps between are computed again.
            truncate: steps after which gradients flow no further back.
            past: whether to keep ``Record.past`` for the backward pass.
        """

    def forward(
        self, f: Any, measurements: Measurements, prior: Gaussian, checkpoint: int | None, truncate: int | None,
        past: bool,
    ) -> tuple[Estimate, Any, Any]:  # fmt: skip
        """Filters whole tracks: the estimate, and for a backward pass the last state and ``Record.past``."""

    def backward(
        self, f: Any, past: Any, measurements: Measurements, rank: int, frames: Callable[[], Sequence[Frame]],
        checkpoint: int | None, lag: int | None, truncate: int | None,
    ) -> Smoothed:  # fmt: skip
        """The backward pass over a ``past``, time behind ``rank`` batch dimensions.

        Args:
            f: the filter.
            past: see ``Filter.past``.
            measurements: of the forward pass.
            rank: batch dimensions.
            frames: makes those of the forward pass.
            checkpoint: steps between states that are kept for gradients.
            lag: number of later steps whose measurements count; None for all.
            truncate: steps after which the forward pass has cut gradients.
        """

    def another(self) -> Engine:
        """An engine of the same kind for another filter."""


class Interpreted:
    """Runs a filter in Python, one step after the other."""

    def call(self, method: Callable[..., Estimate], f: Any, *arguments: Any, **options: Any) -> Estimate:
        """The result of a method of the filter for whole tracks."""
        return method(f, *arguments, **options)

    def step(self, f: Any, state: Any, measurements: Measurements, watched: bool = False) -> tuple[Any, Any]:
        """The state after one measurement, and its innovation; if ``watched``, with alarm and a copy of the belief."""
        frame = f._frame(state, measurements)
        state, record = f.one_step(spoilt(f, state), frame)
        innovation = f.innovation_of(record, frame)
        if not watched:
            return state, innovation
        alarm = record.info.alarm if f.alarms else None
        return state, (innovation, alarm, tree.map_tensors(torch.clone, state.belief))

    def once(self, f: Any, function: Function, state: Any, measurements: Measurements) -> tuple[Any, Any]:
        """The result of ``function(f, state, frame)`` for one measurement."""
        (frame,), _ = f._frames(measurements.as_track(scans=f.scans), state.belief.mean.dim() - 1)
        return function(f, spoilt(f, state), frame)

    def over_steps(
        self, f: Any, state: Any, measurements: Measurements, rank: int, checkpoint: int | None,
        truncate: int | None, past: bool,
    ) -> tuple[Any, Kept]:  # fmt: skip
        """The state after all steps, and the kept parts of each."""
        frames, log_norm = f._frames(measurements, rank)
        with _constants(checkpoint):
            state, records = over_steps(f.one_step, spoilt(f, state), frames, checkpoint, truncate)
        needed = [r._replace(residual=None, evidence=None, past=r.past if past else None) for r in records]
        return state, f.kept_of(tree.stack(needed, rank), log_norm.movedim(0, -1))

    def forward(
        self, f: Any, measurements: Measurements, prior: Gaussian, checkpoint: int | None, truncate: int | None,
        past: bool,
    ) -> tuple[Estimate, Any, Any]:  # fmt: skip
        """Filters whole tracks from their prior."""
        state, rank = f.first_state(measurements, prior)
        state, kept = self.over_steps(f, state, measurements, rank, checkpoint, truncate, past)
        return f.estimate_of(state, kept), state, kept.past

    def backward(
        self, f: Any, past: Any, measurements: Measurements, rank: int, frames: Callable[[], Sequence[Frame]],
        checkpoint: int | None, lag: int | None, truncate: int | None,
    ) -> Smoothed:  # fmt: skip
        """The backward pass."""
        steps = frames()
        *earlier, last = tree.unbind(tree.map_tensors(lambda x: x.movedim(rank, 0), past), len(steps))
        with _constants(checkpoint):
            return backward_pass(f, [*earlier, last.decided()], steps, rank, checkpoint, lag, truncate)

    def another(self) -> Engine:
        """This engine itself, as it holds nothing of a filter."""
        return self

    def __reduce__(self) -> str | tuple[Any, ...]:
        return "INTERPRETED"  # the copy of a filter has this very engine


def _constants(checkpoint: int | None) -> AbstractContextManager[None]:
    """``same_values``, where no step runs again for its gradient; ``torch.compile`` finds equal expressions itself."""
    return same_values() if checkpoint is None and not torch.compiler.is_compiling() else nullcontext()


INTERPRETED = Interpreted()
"""The engine of every filter that has not been compiled."""


def over_steps(
    step: Callable[[Any, Any], tuple[Any, Any]],
    state: Any,
    inputs: Sequence[Any],
    checkpoint: int | None,
    truncate: int | None = None,
) -> tuple[Any, list[Any]]:
    """The state after all steps, and the record of each.

    Args:
        step: from a state and an input to the next state and a record.
        state: before the first step.
        inputs: one for each step.
        checkpoint: steps between states that are kept for gradients; the steps between are computed again.
        truncate: steps after which gradients flow no further back.
    """

    def stretch(state: Any, first: int, last: int) -> tuple[Any, list[Any]]:
        records = []
        for k in range(first, last):
            if truncate is not None and k and k % truncate == 0:
                state = tree.detach(state)
            state, record = step(state, inputs[k])
            records.append(record)
        return state, records

    if checkpoint is None or not torch.is_grad_enabled():
        return stretch(state, 0, len(inputs))
    from torch.utils.checkpoint import checkpoint as recompute  # before torch 2.11 it imports half of torch's compiler

    records: list[Any] = []
    for first in range(0, len(inputs), checkpoint):
        last = min(first + checkpoint, len(inputs))
        state, more = recompute(stretch, state, first, last, use_reentrant=False)
        records += more
    return state, records


def backward_pass(
    f: Any, past: Any, frames: Sequence[Frame], rank: int, checkpoint: int | None, lag: int | None,
    truncate: int | None = None,
) -> Smoothed:  # fmt: skip
    """The smoothed estimates of all steps, stacked over time behind ``rank`` batch dimensions.

    Args:
        f: the filter.
        past: one for each step.
        frames: one for each step.
        rank: batch dimensions.
        checkpoint: steps between states that are kept for gradients.
        lag: number of later steps whose measurements count; None for all.
        truncate: steps after which the forward pass has cut gradients.
    """
    sources = [tree.detach(x) if truncate and k % truncate == 0 else x for k, x in enumerate(past, 1)]
    steps = [BackwardStep(*of) for of in zip(past[:-1], past[1:], frames[1:], sources[:-1], strict=True)]
    state, end = f.last(past[-1])
    if lag is not None:
        state = tree.stack([state] * lag, 0)

    def back(after: Any, step: BackwardStep) -> tuple[Any, Smoothed]:
        stepped: tuple[Any, Smoothed] = f.retreat(step, after) if lag is None else _lagged(f, after, step)
        return stepped

    _, smoothed = over_steps(back, state, steps[::-1], checkpoint)
    stacked: Smoothed = tree.stack([*smoothed[::-1], end], rank)
    return stacked


def _lagged(f: Any, window: Any, step: BackwardStep) -> tuple[Any, Smoothed]:
    """One step of the backward pass with a fixed lag: ``window[l]`` is smoothed by the ``l`` steps after its own.

    For ``window[0]`` the past of the next step is provisional: no later measurement has decided that step.
    """
    provisional = step.next.undecided()
    if provisional is step.next:
        before, smoothed = f.retreat(step, window)
    else:
        before, smoothed = f.retreat(step._replace(next=provisional), tree.map_tensors(lambda x: x[:1], window))
        if len(tree.flatten(window)[0]) > 1:
            older, smoothed = f.retreat(step, tree.map_tensors(lambda x: x[1:], window))
            before = tree.map_tensors(lambda *xs: torch.cat(xs), before, older)
    now, _ = f.last(step.past.undecided())
    window = tree.map_tensors(lambda x, older: torch.cat([x.unsqueeze(0), older[:-1]]), now, before)
    return window, tree.map_tensors(lambda x: x[-1], smoothed)
