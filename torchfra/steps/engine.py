"""The engine that runs the steps of a filter in Python; compiled ones answer the same calls."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Concatenate, ParamSpec, TypeVar

from torchfra import tree
from torchfra.gaussian.inputs import Frame, Measurements
from torchfra.hyper import spoilt
from torchfra.steps.checks import check_step
from torchfra.steps.loop import Options, backward, finish, observe, observe_apart, scan, start
from torchfra.steps.records import Kept, Smoothed, decided, kept
from torchfra.steps.recursion import Recursion, S
from torchfra.types import Estimate, Gaussian

F = TypeVar("F", bound=Recursion)
P = ParamSpec("P")
T = TypeVar("T")  # a past
Function = Callable[[Any, S, Frame], tuple[S, Any]]
"""From a filter, its state and a frame to the next state and a result of the step."""


class Engine:
    """Runs the steps of a filter one after the other.  A filter holds an engine; ``Filter.compile`` replaces it."""

    def call(
        self, method: Callable[Concatenate[F, P], Estimate], f: F, *arguments: P.args, **options: P.kwargs
    ) -> Estimate:
        """The result of a method of the filter for whole tracks, ``method(f, *arguments, **options)``."""
        return method(f, *arguments, **options)

    def step(self, f: Recursion[S], state: S, measurements: Measurements, apart: bool = False) -> tuple[S, Any]:
        """The state after one measurement, which is checked, and its innovation.

        Args:
            f: the filter.
            state: before the measurement.
            measurements: of the step.
            apart: whether to return, instead of the innovation, a pair of it and a copy of the belief.
        """
        function = observe_apart if apart else observe
        return self._once(f, function, state, check_step(f, state, measurements))

    def once(self, f: Recursion, function: Function[S], state: S, measurements: Measurements) -> tuple[S, Any]:
        """The result of ``function(f, state, frame)`` for one measurement that has been checked."""
        return self._once(f, function, state, measurements.as_track(scans=f.scans))

    @staticmethod
    def _once(f: Recursion, function: Function[S], state: S, track: Measurements) -> tuple[S, Any]:
        (frame,), _ = f._frames(track, state.belief.mean.dim() - 1)
        return function(f, spoilt(f, state, track.sensor), frame)

    def scan(
        self, f: Recursion[S], state: S, measurements: Measurements, rank: int, options: Options
    ) -> tuple[S, Kept]:
        """The state after all steps of checked tracks, and what is kept of each, time behind ``rank`` dimensions."""
        frames, log_norm = f._frames(measurements, rank)
        state = spoilt(f, state, measurements.sensor)
        state, records = scan(f.advance, state, frames, options.checkpoint, options.truncate)
        past = options.past
        needed = [r._replace(residual=None, evidence=None, past=r.past if past else None) for r in records]
        return state, kept(tree.stack(needed, rank), log_norm.movedim(0, -1))

    def forward(
        self, f: Recursion[S], measurements: Measurements, prior: Gaussian, options: Options
    ) -> tuple[Estimate, S, Any]:
        """Filters whole tracks: the estimate, and for a backward pass the last state and ``Record.past``."""
        state, rank = start(f, measurements, prior)
        state, steps = self.scan(f, state, measurements, rank, options)
        return finish(f, state, steps), state, steps.past

    def backward(
        self, f: Recursion, past: T, measurements: Measurements, rank: int, frames: Callable[[], Sequence[Frame]],
        lag: int | None, options: Options,
    ) -> Smoothed:  # fmt: skip
        """The backward pass over a ``past``, time behind ``rank`` batch dimensions.

        Args:
            f: the filter.
            past: see ``Filter.past``.
            measurements: of the forward pass.
            rank: batch dimensions.
            frames: makes those of the forward pass.
            lag: number of later steps whose measurements count; None for all.
            options: of the forward pass.
        """
        steps = frames()
        *earlier, last = tree.unbind(tree.map_tensors(lambda x: x.movedim(rank, 0), past), len(steps))
        return backward(f, [*earlier, decided(last)], steps, rank, lag, options)

    def __reduce__(self) -> str | tuple[Any, ...]:
        return "INTERPRETED"  # the copy of a filter has this very engine


INTERPRETED = Engine()
"""The engine of every filter that has not been compiled."""
