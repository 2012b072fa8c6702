"""A filter whose step runs as one kernel over all tracks and steps: what ``Filter.compile`` makes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

from torchfra.filters import traced
from torchfra.filters.compiled_back import Given, given, retreat
from torchfra.gaussian.arguments import check_seconds, check_values
from torchfra.gaussian.inputs import Frame, Measurements
from torchfra.hyper import Hyper
from torchfra.kernel.run import BUILDING, Kernels
from torchfra.kernel.source import SCALARS
from torchfra.kernel.step import Input, Step, frozen
from torchfra.linalg.tracing import is_traced
from torchfra.tree import flatten, map_tensors, ranks
from torchfra.types import Innovation


class _Value(NamedTuple):
    """A parameter, a number, or the value of a hyperparameter."""

    path: str
    module: nn.Module
    key: str
    event: int

    def __call__(self) -> Tensor:
        for part in (self.module._parameters, self.module._buffers):
            x = part.get(self.key)
            if x is not None:
                return x
        return torch.tensor(getattr(self.module, self.key), dtype=torch.float64)


class _Plan(NamedTuple):
    """What a form of call comes to."""

    kernels: Kernels
    batch: torch.Size
    shapes: list[torch.Size]
    """Of what a kernel is given: leaves of the state, data, values, all with the full batch."""
    counts: bool
    """Whether some of what is kept of a step are whole numbers."""


class _Version:
    """A filter as it is at the moment, and the kernels that take it for granted."""

    def __init__(self, f: nn.Module) -> None:
        self.kernels: dict[tuple[Any, ...], Kernels] = {}
        self.steps: dict[tuple[Any, ...], _Plan] = {}
        self.frozen = frozen(f)
        self.values: list[_Value] = []
        self.owners: list[tuple[dict[str, Any], int]] = []
        self.watched: list[tuple[dict[str, Any], str, Any, int | None]] = []
        for path, module in f.named_modules():
            numbers = getattr(module, "kernel_numbers", ())
            parts = (module.__dict__, module._modules, module._parameters, module._buffers)
            if not any(parts[1:]) and module.__dict__.keys() <= _EMPTY:
                continue  # a side that does nothing has nothing that could change
            self.owners += [(part, len(part)) for part in parts if not isinstance(module, Hyper)]
            for part in parts:
                for key, x in part.items():
                    event = 0 if key in numbers else _event(module, part, x)
                    if event is not None:
                        self.values.append(_Value(f"{path}.{key}".lstrip("."), module, key, event))
                    elif part is not module.__dict__ or key not in _PLUMBING:
                        self.watched.append((part, key, x, x._version if isinstance(x, Tensor) else None))

    def holds(self) -> bool:
        """Whether nothing has changed since."""
        for owner, key, seen, version in self.watched:
            x = owner.get(key)
            if x is not seen or (version is not None and x._version != version):
                return False
        return all(len(owner) == size for owner, size in self.owners)

    def plan(
        self, advance: Callable[..., Any], state: Any, data: Sequence[Tensor | None], timed: Sequence[bool],
        back: Given | None = None,
    ) -> _Plan:  # fmt: skip
        """What is to be done with this ``data``, which has an entry for each step where ``timed``."""
        first, events = flatten(state)[0], ranks(Measurements) if back is None else back.events
        dtype, alone = first.dtype, state.belief.mean.shape[:-1] if back is None else back.batch
        values = [(value, value().shape, value().dim() - value.event) for value in self.values]
        batch = torch.broadcast_shapes(alone, *(shape[:rank] for _, shape, rank in values))
        inputs, shapes = {}, []
        for (name, event), x, varies in zip(events.items(), data, timed, strict=True):
            if x is not None:
                inputs[name] = Input(x.shape[x.dim() - event :], varies, False)
                shapes.append(batch + x.shape[x.dim() - event - varies :])
        for value, shape, rank in values:
            inputs[value.path] = Input(shape[rank:], False, True)
            shapes.append(batch + shape[rank:])
        key = (advance if back is None else retreat, dtype, tuple(inputs.items()))
        if key not in self.kernels:
            begin = traced.begin if back is None else back.begin
            self.kernels[key] = Kernels(Step(self.frozen, begin, advance, inputs, dtype, timed[0], back is not None))
        kernels = self.kernels[key]
        counts = any(not (x.is_floating_point() or x.dtype == torch.bool) for x in flatten(kernels.step.record))
        return _Plan(kernels, batch, [batch + zero.shape for zero in kernels.step.zero] + shapes, counts)

    def run(
        self, plan: _Plan, steps: int, state: Any, data: Sequence[Tensor | None], *options: int | None
    ) -> tuple[Any, Any]:
        """Does it."""
        dtype, leaves = plan.kernels.step.dtype, flatten(state)
        tensors = [*leaves, *(x for x in data if x is not None), *(value() for value in self.values)]
        full = [
            x if x.shape == shape and x.dtype == dtype and x.is_cpu else x.to("cpu", dtype).expand(shape)
            for x, shape in zip(tensors, plan.shapes, strict=True)
        ]
        state, record = plan.kernels.run(plan.batch, steps, full[: len(leaves)], full[len(leaves) :], *options)
        return state, map_tensors(_whole, record, plan.kernels.step.record) if plan.counts else record


def _whole(x: Tensor, like: Tensor) -> Tensor:
    """A count, which kernels hold as a floating point number, as the whole number that it is."""
    return x if like.is_floating_point() else x.to(like.dtype)


def _event(module: nn.Module, part: dict[str, Any], x: Any) -> int | None:
    """The number of dimensions, without a batch, of what is read when a kernel runs; None for what is part of it.

    Read are hyperparameters, parameters, and buffers that have gradients.
    """
    if isinstance(module, Hyper) and (part is module._parameters or part is module._buffers):
        return module.event_dim
    read = part is module._parameters or (part is module._buffers and x is not None and x.requires_grad)
    return x.dim() if read and x is not None else None


_EMPTY = nn.Module().__dict__.keys()
_PLUMBING = {*_EMPTY, "_kernels"} - {"training"}
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
        self._versions: list[_Version] = []

    def __reduce__(self) -> tuple[type[Compiled], tuple[()]]:
        return Compiled, ()  # kernels are no part of a copy

    def _now(self, f: nn.Module) -> _Version:
        """The kernels that hold for the filter as it is; the version used last comes first."""
        if self._versions and self._versions[0].holds():
            return self._versions[0]
        with BUILDING:
            held = next((version for version in self._versions if version.holds()), None) or _Version(f)
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
            and not is_traced(z)
            and torch._C._functorch.peek_interpreter_stack() is None
            and forward_ad._current_level < 0
        )

    def forward(
        self, f: Any, state: Any, measurements: Measurements, checkpoint: int | None, truncate: int | None, past: bool
    ) -> tuple[Any, Any]:
        """The state after whole tracks, and what ``f.keep`` keeps of each step.

        All has been checked.
        """
        z = measurements.z
        seconds = measurements.dt if measurements.varying_dt else measurements.common_dt
        data = (z, torch.as_tensor(seconds, dtype=z.dtype), *measurements[2:])
        now = self._now(f)
        keep, timed = traced.keep_past if past else traced.keep, (True, measurements.varying_dt, True, True, True)
        with BUILDING:
            plan = now.plan(keep, state, data, timed)
        return now.run(plan, z.shape[-2], state, data, checkpoint, truncate)

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
        z, dt, *rest = measurements
        now = self._now(f)
        tensors = (z, dt, *rest, *flatten(state), *(value() for value in now.values))
        form = (type(state), *((x.shape, x.dtype) if isinstance(x, Tensor) else type(x) for x in tensors))
        plan = now.steps.get(form)
        if plan is None:
            check()
        elif isinstance(dt, Tensor) or measurements.std is not None or measurements.noise is not None:
            check_values(measurements.as_track(), f.instants)
        data = (z, dt if isinstance(dt, Tensor) else _seconds(dt, z.dtype, f.instants), *rest)
        if plan is None:
            with BUILDING:
                if len(now.steps) == _FORMS:
                    now.steps.clear()
                plan = now.steps[form] = now.plan(traced.observe, state, data, (False,) * 5)
        return now.run(plan, 1, state, data)


@lru_cache(maxsize=64)
def _seconds(dt: float, dtype: torch.dtype, instants: bool) -> Tensor:
    """A time step that is known to be finite, and 0 or more (without ``instants`` more)."""
    check_seconds(dt, dtype, instants)
    return torch.tensor(dt, dtype=dtype)
