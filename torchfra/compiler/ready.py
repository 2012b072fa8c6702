"""Calls of a compiled filter whose form is known: they do little but run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from functools import lru_cache
from typing import Any, TypeVar

import torch
from torch import Tensor

from torchfra.compiler.forms import flattener, guard, unflattener
from torchfra.compiler.learning import Learning
from torchfra.compiler.program import Ready
from torchfra.compiler.track_kernel import TrackKernel
from torchfra.gaussian.arguments import PRECISIONS, check_values
from torchfra.gaussian.inputs import Measurements, Time
from torchfra.linalg.triangular import tria
from torchfra.numbers import NUMBERS
from torchfra.steps.recursion import HasBelief, Recursion
from torchfra.tree import flatten
from torchfra.types import Estimate, Failure, Gaussian

Data = tuple[Tensor, Tensor, Tensor | None, Tensor | None, Tensor | None]
"""``z``, ``dt``, ``u``, ``std``, ``noise`` of a step."""
_FORMS = 64
"""How many forms are remembered, of steps and of tracks."""
_RANGES = {dtype: (torch.finfo(dtype).tiny, torch.finfo(dtype).max) for dtype in PRECISIONS}
"""From the least normal number on to the largest, in each precision."""
_SHORT = 4096
"""Steps of all tracks up to which a form gets ready at its first call: such calls are little but overhead."""
_OFTEN = 8
"""Every so many calls a longer form is made ready, unless it is: to compile its boundary takes half a second."""
_LEARNING = 256
"""The same of calls with a gradient, whose boundary takes one to three seconds and saves one to three milliseconds."""
_COUNTED = 256
"""How many longer forms are counted."""
T = TypeVar("T")


class _Known(dict[Hashable, list[T]]):
    """What has been made ready by the form of the call, the latest first; all is forgotten when there is too much."""

    def add(self, form: Hashable, made: T) -> None:
        """Remembers one more."""
        if sum(map(len, self.values())) >= _FORMS:
            self.clear()
        self[form] = [made, *self.get(form, ())]


class ReadyStep:
    """A step for tensors of one form.

    Args:
        ready: the kernel.
        inputs: a state, data and values like those to come.
        made: the state and the record that the kernel writes, of one track.
    """

    def __init__(self, ready: Ready, inputs: tuple[Any, Data, tuple[Tensor, ...]], made: object) -> None:
        self.run, self.made = ready, unflattener(made)
        self._leaves = flattener(inputs)
        self._fit = guard(flatten(inputs))

    def tensors(self, state: HasBelief, data: Data, values: Sequence[Tensor]) -> tuple[Tensor, ...] | None:
        """What the kernel reads; None for tensors of another form."""
        try:
            leaves = self._leaves((state, data, values))
        except (IndexError, TypeError):  # another structure
            return None
        return leaves if leaves is not None and self._fit(*leaves) else None


class ReadySteps:
    """All that have been made ready."""

    def __init__(self) -> None:
        self._known = _Known[ReadyStep]()

    def __call__(
        self, state: HasBelief, data: Data, values: Sequence[Tensor], zero_dt: bool | None
    ) -> tuple[Any, Any] | None:
        """The next state and the record of the step; None where no step is ready.

        Args:
            state: before the step.
            data: of the step.
            values: what the filter holds.
            zero_dt: whether ``dt`` may be 0, to check what comes with the measurement; None where that is good.

        Raises:
            ValueError: the time step or the noise has a bad value.
        """
        for step in self._known.get(_kind(state, data), ()):
            tensors = step.tensors(state, data, values)
            if tensors is not None:
                if zero_dt is not None:
                    check_changing(data, zero_dt)
                made: tuple[Any, Any] = step.made(step.run(tensors))
                return made
        return None

    def add(self, step: ReadyStep, state: HasBelief, data: Data) -> None:
        """Remembers a step."""
        self._known.add(_kind(state, data), step)


def _kind(state: HasBelief, data: Data) -> Hashable:
    _, _, u, std, noise = data
    return type(state), u is None, std is None, noise is None, torch.is_grad_enabled()


@lru_cache(maxsize=64)
def number(value: float, dtype: torch.dtype = torch.float64) -> Tensor:
    """A number as a tensor that nobody changes, and that may be saved for a gradient wherever it was first needed."""
    with torch.inference_mode(False):
        return torch.tensor(float(value), dtype=dtype)


def check_changing(data: Data, zero_dt: bool) -> None:
    """Checks the values that come with each measurement.

    Raises:
        ValueError: one is bad.
    """
    z, dt, _, std, noise = data
    if noise is not None or not all(x is None or is_ordinary(x, z.dtype) for x in (dt, std)):
        check_values(Measurements(*data).as_track(), zero_dt)


def is_ordinary(x: Time, dtype: torch.dtype) -> bool:
    """Whether a few time steps or deviations are good beyond doubt, seen without arithmetic on tensors."""
    least, most = _RANGES[dtype]
    if not isinstance(x, Tensor):
        return least <= float(x) <= most
    if x.dim() > 1 or x.numel() > 16:
        return False
    return all(least <= value <= most for value in x.reshape(-1).tolist())


class ReadyTracks:
    """Tracks of one form.

    Args:
        run: the kernel.
        batch: of the tracks.
        tensors: a prior, and what the kernel reads besides the state: data, values.
        state: that of the prior.
        made: the state and the record of one track.
    """

    def __init__(
        self, run: Ready, batch: torch.Size, tensors: Sequence[Tensor], state: HasBelief, made: object
    ) -> None:
        self._run, self._shape = run, (*batch, tensors[0].shape[-1])
        self._leaves, self._made = flattener(state), unflattener(made)
        self.fit = guard(tensors)

    def __call__(self, begin: Callable[[Gaussian], Any], tensors: Sequence[Tensor]) -> tuple[Any, Any]:
        """The state after the last step, and what is kept of each."""
        mean, root = tensors[:2]
        state = begin(Gaussian(mean.expand(self._shape), tria(root).expand((*self._shape, root.shape[-1]))))
        leaves = self._leaves(state)
        assert leaves is not None
        made: tuple[Any, Any] = self._made(self._run((*map(Tensor.contiguous, leaves), *tensors[2:])))
        return made


class WholeTracks:
    """Tracks of one form whose beginning and end are part of a kernel too.

    Args:
        kernel: of whole tracks.
        tensors: as of ``ReadyTracks``.
    """

    def __init__(self, kernel: TrackKernel | Learning, tensors: Sequence[Tensor]) -> None:
        self._kernel = kernel
        tree = kernel.made._replace(failure=Failure(tensors[0], tensors[1]))
        self._made = unflattener(tree, [*kernel.places, -2, -1])
        self.fit = guard(tensors)

    def __call__(self, begin: Callable[[Gaussian], Any], tensors: Sequence[Tensor]) -> Estimate:
        """What ``forward`` returns, except for the causes of failures: the failure is None where there may be any."""
        written, sound = self._kernel(tensors)
        made: Estimate = self._made(written)
        return made if sound else made._replace(failure=None)


class AllReadyTracks:
    """All that have been made ready."""

    def __init__(self) -> None:
        self.known = _Known[ReadyTracks | WholeTracks]()
        self._calls: Counter[Hashable] = Counter()

    def due(self, form: Hashable, steps: int, learns: bool) -> bool:
        """Whether to get a form ready that has been called once more: of so many steps, with a gradient or without."""
        if is_short(steps) and not learns:
            return True
        if len(self._calls) >= _COUNTED:
            self._calls.clear()
        self._calls[form, learns] += 1
        # Not just once: memory may lie otherwise.
        return self._calls[form, learns] % (_LEARNING if learns else _OFTEN) == 0

    def __call__(
        self, f: Recursion, form: Hashable, prior: Gaussian, measurements: Measurements, values: Callable[[], Any]
    ) -> Estimate | tuple[Any, Any] | None:
        """The estimate, or the state after the last step and what is kept of each; None where no such tracks are ready.

        Args:
            f: the filter.
            form: of the call.
            prior: of the tracks.
            measurements: that are checked for bad values here.
            values: what the filter holds.

        Raises:
            ValueError: the time steps or the noise have a bad value.
        """
        known = self.known.get(form, ())
        z, dt, *rest = measurements[:5]
        if not known or not isinstance(dt, (Tensor, *NUMBERS)):
            return None
        seconds = seconds_of(measurements)
        tensors = (*prior, z, seconds, *(x for x in rest if x is not None), *values())
        for tracks in known:
            if tracks.fit(*tensors):
                if not (is_ordinary(dt, z.dtype) and rest[1] is rest[2] is None):
                    check_values(measurements, f.limits.zero_dt)
                return tracks(f.begin, tensors)
        return None


def is_short(steps: int) -> bool:
    """Whether so many steps of all tracks get ready at the first call of a form."""
    return steps <= _SHORT


def seconds_of(measurements: Measurements) -> Tensor:
    """The time step, one for all or one for each, in the precision of the measurements."""
    dt = measurements.dt if measurements.varying_dt else measurements.common_dt
    return dt.to(measurements.z.dtype) if isinstance(dt, Tensor) else number(dt, measurements.z.dtype)


def form_of(measurements: Measurements, *how: bool) -> Hashable:
    """What of a call is no form of a tensor."""
    _, dt, u, std, noise, _ = measurements
    given = u is None, std is None, noise is None, isinstance(dt, Tensor), measurements.varying_dt
    return given, how, torch.is_grad_enabled()
