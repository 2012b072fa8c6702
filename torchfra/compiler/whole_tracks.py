"""Whole tracks of a compiled filter, made ready once for each form of call, so that a call does little but run them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import torch
from torch import Tensor

from torchfra.compiler.guards import guard
from torchfra.compiler.learning import Learning
from torchfra.compiler.program import Ready
from torchfra.compiler.single_steps import is_ordinary, number
from torchfra.compiler.track_kernel import TrackKernel
from torchfra.compiler.trees import flattener, unflattener
from torchfra.gaussian.arguments import check_values
from torchfra.gaussian.inputs import Measurements
from torchfra.linalg.triangular import tria
from torchfra.types import Estimate, Failure, Gaussian

_FORMS = 16
"""How many forms are remembered."""
_SHORT = 4096
"""Steps of all tracks up to which a form gets ready at its first call: such calls are little but overhead."""
_OFTEN = 8
"""Every so many calls a longer form is made ready, unless it is: to compile its boundary takes half a second."""
_LEARNING = 256
"""The same of calls with a gradient, whose boundary takes one to three seconds and saves one to three milliseconds."""
_COUNTED = 256
"""How many longer forms are counted."""


class ReadyTracks:
    """Tracks of one form.

    Args:
        run: the kernel.
        batch: of the tracks.
        tensors: a prior, and what the kernel reads besides the state: data, values.
        state: that of the prior.
        made: the state and the record of one track.
    """

    def __init__(self, run: Ready, batch: torch.Size, tensors: Sequence[Tensor], state: Any, made: Any) -> None:
        self._run, self._shape = run, (*batch, tensors[0].shape[-1])
        self._leaves, self._made = flattener(state), unflattener(made)
        self.fit = guard(tensors)

    def __call__(self, begin: Callable[[Gaussian], Any], tensors: Sequence[Tensor]) -> tuple[Any, Any]:
        """The state after the last step, and what is kept of each."""
        mean, root = tensors[:2]
        state = begin(Gaussian(mean.expand(self._shape), tria(root).expand((*self._shape, root.shape[-1]))))
        leaves: Any = self._leaves(state)
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
        tree = kernel.made._replace(failure=Failure(*tensors[:2]))
        self._made = unflattener(tree, [*kernel.places, -2, -1])
        self.fit = guard(tensors)

    def __call__(self, begin: Callable[[Gaussian], Any], tensors: Sequence[Tensor]) -> Estimate:
        """What ``forward`` returns, but for the causes of failures: the failure is None where there may be any."""
        written, sound = self._kernel(tensors)
        made: Estimate = self._made(written)
        return made if sound else made._replace(failure=None)


class AllReadyTracks:
    """All that have been made ready."""

    def __init__(self) -> None:
        self._known: dict[Hashable, list[ReadyTracks | WholeTracks]] = {}
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
        self, f: Any, form: Hashable, prior: Gaussian, measurements: Measurements, values: Callable[[], Any]
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
        known = self._known.get(form, ())
        z, dt, *rest = measurements
        if not known or not isinstance(dt, (Tensor, float, int)):
            return None
        seconds = seconds_of(measurements)
        tensors = (*prior, z, seconds, *(x for x in rest if x is not None), *values())
        for tracks in known:
            if tracks.fit(*tensors):
                if not (is_ordinary(dt, z.dtype) and rest[1] is rest[2] is None):
                    check_values(measurements, f.zero_dt)
                return tracks(f.begin, tensors)
        return None

    def add(self, form: Hashable, tracks: ReadyTracks | WholeTracks) -> None:
        """Remembers tracks; all others are forgotten when there are too many."""
        if sum(map(len, self._known.values())) >= _FORMS:
            self._known, self._calls = {}, Counter()
        self._known[form] = [tracks, *self._known.get(form, ())]


def is_short(steps: int) -> bool:
    """Whether so many steps of all tracks get ready at the first call of a form."""
    return steps <= _SHORT


def seconds_of(measurements: Measurements) -> Tensor:
    """The time step, one for all or one for each, in the precision of the measurements."""
    dt = measurements.dt if measurements.varying_dt else measurements.common_dt
    return dt.to(measurements.z.dtype) if isinstance(dt, Tensor) else number(dt, measurements.z.dtype)


def form_of(measurements: Measurements, *how: bool) -> Hashable:
    """What of a call is no form of a tensor."""
    _, dt, u, std, noise = measurements
    given = u is None, std is None, noise is None, isinstance(dt, Tensor), measurements.varying_dt
    return given, how, torch.is_grad_enabled()
