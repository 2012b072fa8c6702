"""A filter whose step runs as one kernel over all tracks and steps: what ``Filter.compile`` makes."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

from torchfra.filters import traced
from torchfra.filters.compiled_back import given
from torchfra.filters.compiled_step import Data, check_changing, is_ordinary, number
from torchfra.filters.compiled_tracks import form_of, may_be_ready, seconds_of
from torchfra.filters.compiled_version import Plan, Version
from torchfra.gaussian.arguments import check_seconds
from torchfra.gaussian.inputs import Frame, Measurements
from torchfra.kernel.program import BUILDING
from torchfra.kernel.source import SCALARS
from torchfra.linalg.tracing import is_traced
from torchfra.tree import flatten
from torchfra.types import Gaussian, Innovation

_VERSIONS = 4
"""How many are remembered: a filter may go back and forth, between soft decisions and hard ones say."""
_FORMS = 64
"""How many forms of a single step are remembered."""


class Compiled:
    """Kernels of a filter, one set for each form of call; they are made when first needed.

    Hyperparameters, parameters, ``kernel_numbers`` and data are read when a kernel runs.  All else is part of it: when
    an attribute, a buffer or a part of the filter has been replaced, or a tensor has changed, there are other kernels.
    (A list or dictionary that changes inside is not noticed.)
    """

    def __init__(self) -> None:
        self._versions: list[Version] = []

    def __reduce__(self) -> tuple[type[Compiled], tuple[()]]:
        return Compiled, ()  # kernels are no part of a copy

    def _now(self, f: nn.Module) -> Version:
        """The kernels that hold for the filter as it is; the version used last comes first."""
        if self._versions and self._versions[0].holds():
            return self._versions[0]
        with BUILDING:
            held = next((version for version in self._versions if version.holds()), None) or Version(f)
            others = [version for version in self._versions if version is not held]
            self._versions = [held, *others[: _VERSIONS - 1]]
        return held

    @staticmethod
    def takes(z: Any) -> bool:
        """Whether kernels can work on it: a tensor on the CPU, and not inside ``torch.compile`` or a transform."""
        return (
            isinstance(z, Tensor)
            and z.is_cpu
            and z.dtype in SCALARS
            and not is_traced()
            and torch._C._functorch.peek_interpreter_stack() is None
            and forward_ad._current_level < 0
        )

    def ready(self, f: Any, measurements: Measurements, prior: Gaussian, past: bool) -> tuple[Any, Any] | None:
        """What ``forward`` gives for the state of a prior; None unless a call of the same form has been checked.

        Raises:
            ValueError: the time steps or the noise have a bad value.
        """
        if not self._versions or not isinstance(prior, Gaussian):
            return None
        now = self._now(f)
        return now.tracks(form_of(measurements, past), prior, measurements, now.read, f.instants)

    def get_ready(self, f: Any, state: Any, measurements: Measurements, prior: Gaussian, past: bool) -> None:
        """Makes later calls of ``forward`` like this one ready, if they are short; ``state`` is that of the prior."""
        z = measurements.z
        if f.home is f and not f.scans and may_be_ready(z.shape[:-2].numel(), z.shape[-2]):
            now, plan, data = self._plan(f, state, measurements, past)
            now.get_tracks_ready(form_of(measurements, past), plan, prior, state, data)

    def forward(
        self, f: Any, state: Any, measurements: Measurements, checkpoint: int | None, truncate: int | None, past: bool
    ) -> tuple[Any, Any]:
        """The state after whole tracks, and what ``f.keep`` keeps of each step.

        All has been checked.
        """
        now, plan, data = self._plan(f, state, measurements, past)
        return now.run(plan, measurements.z.shape[-2], state, data, checkpoint, truncate)

    def _plan(self, f: Any, state: Any, measurements: Measurements, past: bool) -> tuple[Version, Plan, Data]:
        """The kernels that hold for the filter, what this form of call comes to, and its data."""
        data, now = (measurements.z, seconds_of(measurements), *measurements[2:]), self._now(f)
        keep, timed = traced.keep_past if past else traced.keep, (True, measurements.varying_dt, True, True, True)
        with BUILDING:
            return now, now.plan(keep, state, data, timed), data

    def back(self, f: Any, past: Any, measurements: Measurements, rank: int) -> Any:
        """What the way back says of every step, time behind ``rank`` batch dimensions: see ``Smoother``."""
        back, now = given(f, past, measurements, rank), self._now(f)
        data, timed = list(back.data.values()), list(back.timed.values())
        with BUILDING:
            plan = now.plan(back.advance, back.state, data, timed, back)
        return now.run(plan, back.steps, back.state, data)[1]

    def step(
        self, f: Any, state: Any, measurements: Measurements, check: Callable[[], Frame]
    ) -> tuple[Any, Innovation]:
        """The state after one measurement, and its innovation.

        ``check`` is called unless a call of the same shapes has passed it before.
        """
        z, dt, u, std, noise = measurements
        if not isinstance(dt, (Tensor, float, int)):
            check()
        now = self._now(f)
        data = (z, dt if isinstance(dt, Tensor) else _seconds(dt, z.dtype, f.instants), u, std, noise)
        checked = not isinstance(dt, Tensor) and std is None and noise is None
        done = now.ready(state, data, now.read(), None if checked else f.instants)
        return self._prepare(f, now, state, data, check) if done is None else done

    @staticmethod
    def _prepare(f: Any, now: Version, state: Any, data: Data, check: Callable[[], Frame]) -> tuple[Any, Innovation]:
        """The same where no step is ready, which then becomes ready if it can."""
        tensors = (*data, *flatten(state), *now.read())
        form = (type(state), *((x.shape, x.dtype) if isinstance(x, Tensor) else type(x) for x in tensors))
        plan = now.steps.get(form)
        if plan is None:
            check()
            with BUILDING:
                if len(now.steps) == _FORMS:
                    now.steps.clear()
                plan = now.steps[form] = now.plan(traced.observe, state, data, (False,) * 5)
        else:
            check_changing(data, f.instants)
        now.get_ready(plan, state, data)
        return now.run(plan, 1, state, data)


@lru_cache(maxsize=64)
def _seconds(dt: float, dtype: torch.dtype, instants: bool) -> Tensor:
    """A time step that has been checked."""
    seconds = number(dt, dtype)
    if not is_ordinary(seconds, dtype):
        check_seconds(dt, dtype, instants)
    return seconds
