"""A filter as it is at the moment: the kernels that take it for granted, and what they read of it when they run."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Hashable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torchfra.compiler import traced
from torchfra.compiler.backward import BackwardInputs, retreat
from torchfra.compiler.program import Program
from torchfra.compiler.ready import AllReadyTracks, Data, ReadyStep, ReadySteps, ReadyTracks, WholeTracks, number
from torchfra.compiler.run import Kernels, has_gradient
from torchfra.compiler.step import Input, Step, frozen
from torchfra.gaussian.inputs import Measurements
from torchfra.hyper import Hyper
from torchfra.linalg.batches import broadcast_shapes
from torchfra.linalg.tracing import has_tangents
from torchfra.steps.recursion import HasBelief
from torchfra.tree import flatten, map_tensors, ranks
from torchfra.types import Gaussian


class _Value(NamedTuple):
    """A parameter, a number, or the value of a hyperparameter."""

    path: str
    module: nn.Module
    key: str
    event: int
    """Dimensions behind the batch."""
    alone: int
    """Dimensions behind the batch where each target is a track, as on the backward pass of scans."""

    @property
    def part(self) -> dict[str, Any]:
        """Where it is now: learning makes a buffer a parameter."""
        return next(part for part in (self.module._parameters, self.module._buffers, self.module.__dict__)
                    if part.get(self.key) is not None)  # fmt: skip


class Task(NamedTuple):
    """What a form of call comes to."""

    kernels: Kernels
    batch: torch.Size
    shapes: list[torch.Size]
    """What a kernel reads: leaves of the state, data, values, all with the full batch."""
    dtypes: list[torch.dtype]
    """Dtypes of these tensors."""
    counts: bool
    """Whether some of what is kept of a step are whole numbers."""
    device: torch.device
    """Where the kernels run: where the state is."""

    @property
    def forwards(self) -> Program:
        """The kernel of the forward pass."""
        return self.kernels.forwards(self.batch, self.device)


class Version:
    """A filter as it is at the moment, and the kernels that take it for granted."""

    def __init__(self, f: nn.Module) -> None:
        self.kernels: dict[tuple[Any, ...], Kernels] = {}
        self.steps: dict[tuple[Any, ...], Task] = {}
        # Of complete scans or not, with a copy of the belief or not.
        self.ready: dict[tuple[bool, bool], ReadySteps] = defaultdict(ReadySteps)
        self.tracks = AllReadyTracks()
        self.frozen = frozen(f)
        self.scans = bool(getattr(f, "scans", False))
        self.values: list[_Value] = []
        sizes, items = list[dict[str, Any]](), list[tuple[dict[str, Any], str, Any]]()
        for path, module in f.named_modules():
            numbers = getattr(module, "annealed", ())
            parts = (module.__dict__, module._modules, module._parameters, module._buffers)
            if not any(parts[1:]) and module.__dict__.keys() <= _EMPTY:
                continue  # a side that does nothing has nothing that could change
            if not isinstance(module, Hyper):
                sizes += parts
            for part in parts:
                for key, x in part.items():
                    event, alone = (0 if key in numbers else _event(module, part, x, s) for s in (self.scans, False))
                    if event is not None and alone is not None:
                        self.values.append(_Value(f"{path}.{key}".lstrip("."), module, key, event, alone))
                    elif part is not module.__dict__ or key not in _PLUMBING:
                        items.append((part, key, x))
        self._unchanged = _unchanged(sizes, items)
        self._locate()

    @property
    def _events(self) -> dict[str, int]:
        """Dimensions of what is measured at a step."""
        events = ranks(Measurements)
        return {name: rank + (self.scans and name in ("z", "std", "noise")) for name, rank in events.items()}

    def holds(self) -> bool:
        """Whether nothing has changed since."""
        try:
            return self._unchanged()
        except KeyError:  # something is gone
            return False

    def _locate(self) -> None:
        """Finds the values where they are now."""
        self._places = [value.part for value in self.values]
        self._names = [value.key for value in self.values]
        self._numbers = [i for i, value in enumerate(self.values) if self._places[i] is value.module.__dict__]

    def read(self) -> list[Tensor]:
        """The values as they are at the moment."""
        try:
            values = list(map(dict.__getitem__, self._places, self._names))
        except KeyError:  # a buffer has become a parameter
            self._locate()
            return self.read()
        for i in self._numbers:
            values[i] = number(values[i])
        return values

    def task(
        self, advance: Callable[..., Any], state: HasBelief, data: Sequence[Tensor | None], timed: Sequence[bool],
        back: BackwardInputs | None = None,
    ) -> Task:  # fmt: skip
        """What is to be done with this ``data``, which has an entry for each step where ``timed``."""
        first, events = flatten(state)[0], self._events if back is None else back.events
        dtype, targets = first.dtype, () if back else tuple(state.belief.mean.shape[-1 - self.scans : -1])
        alone = back.batch if back else state.belief.mean.shape[: -1 - self.scans]
        pairs = zip(self.values, self._read_for(back), strict=True)
        values = [(value, x, x.dim() - (value.alone if back else value.event)) for value, x in pairs]
        batch = broadcast_shapes(alone, *(x.shape[:rank] for _, x, rank in values))
        inputs, shapes = {}, []
        for (name, event), x, varies in zip(events.items(), data, timed, strict=True):
            if x is not None:
                inputs[name] = Input(x.shape[x.dim() - event :], varies, False)
                shapes.append(batch + x.shape[x.dim() - event - varies :])
        for value, x, rank in values:
            double = x.dtype == torch.float64 != dtype  # read as it is: to convert it would take longer than to filter
            inputs[value.path] = Input(x.shape[rank:], False, True, double)
            shapes.append(batch + x.shape[rank:])
        key = (retreat if back else advance, dtype, targets, tuple(inputs.items()), tuple(map(type, state)))  # type: ignore[call-overload]  # a tuple
        if key not in self.kernels:
            begin = back.begin if back else partial(traced.begin, targets=targets, like=state)
            with torch.inference_mode(False):  # in which torch does not take operations apart
                step = Step(self.frozen, begin, advance, inputs, dtype, timed[0], back is not None)
            self.kernels[key] = Kernels(step)
        kernels = self.kernels[key]
        counts = any(not (x.is_floating_point() or x.dtype == torch.bool) for x in flatten(kernels.step.record))
        shapes = [batch + zero.shape for zero in kernels.step.zero] + shapes
        dtypes = [dtype] * len(kernels.step.zero) + [torch.float64 if x.double else dtype for x in inputs.values()]
        return Task(kernels, batch, shapes, dtypes, counts, first.device)

    def _read_for(self, back: BackwardInputs | None) -> list[Tensor]:
        """The values as they are now; with windows, a batch of values gets a dimension of size 1 for them."""
        if back is None or not back.windows:
            return self.read()
        pairs = ((x, x.dim() - value.alone) for value, x in zip(self.values, self.read(), strict=True))
        return [x.unsqueeze(rank) if rank else x for x, rank in pairs]

    def get_ready(self, task: Task, state: HasBelief, data: Data, kind: tuple[bool, bool]) -> None:
        """Makes later steps like this one ready, if they need no gradient and all is read where it lies."""
        tensors = [*flatten(state), *(x for x in data if x is not None), *self.read()]
        if task.counts or self._changes(tensors):
            return
        full, step = self.full(task, tensors), task.kernels.step
        if any(x.data_ptr() != y.data_ptr() for x, y in zip(full, tensors, strict=True)):
            return
        ready = task.forwards.ready(task.batch, 1, full)
        if ready is not None:
            inputs = state, data, tuple(self.read())
            self.ready[kind].add(ReadyStep(ready, inputs, (step.state, step.record)), state, data)

    def get_tracks_ready(
        self, form: Hashable, task: Task, prior: Gaussian, state: HasBelief, data: Data, past: bool, plain: bool
    ) -> None:
        """Makes later tracks like these ready as well; with a gradient where the gradient pass is ``plain``."""
        steps, inputs = data[0].shape[-2], [*(x for x in data if x is not None), *self.read()]
        tensors, leaves = [*prior, *inputs], [x.contiguous() for x in flatten(state)]
        full, kernels, learns = self.full(task, [*leaves, *inputs]), task.kernels, has_gradient(tensors)
        if (
            self._changes(tensors, learns and plain and not past and kernels.remembers(task.batch, steps))
            or any(x.dtype != task.dtypes[0] or x.device != task.device for x in prior)
            or any(x.data_ptr() != y.data_ptr() for x, y in zip(full, [*leaves, *inputs], strict=True))
        ):
            return
        run = kernels.forwards(task.batch, task.device, learns).ready(task.batch, steps, full)
        if run is None:
            return
        kernel = None if past else kernels.tracks(run, task.batch, tensors, full[len(leaves) :])
        if kernel is not None:
            self.tracks.known.add(form, WholeTracks(kernel, tensors))
        elif not (learns or task.counts):
            made = kernels.step.state, kernels.step.record
            self.tracks.known.add(form, ReadyTracks(run, task.batch, tensors, state, made))

    @staticmethod
    def _changes(tensors: Sequence[Tensor], learns: bool = False) -> bool:
        """Whether a call needs gradients, unless it ``learns``, or its tensors alone do not distinguish it."""
        gradients = (has_gradient(tensors) and not learns) or has_tangents()
        twice = len({*map(id, tensors)}) < len(tensors)  # as in the first state of some filters; guards refuse that
        return gradients or twice

    def full(self, task: Task, tensors: Sequence[Tensor]) -> list[Tensor]:
        """Leaves of the state, data and values as kernels take them: with the full batch."""
        return [
            x
            if x.shape == shape and x.dtype == dtype and x.device == task.device
            else x.to(task.device, dtype).expand(shape)
            for x, shape, dtype in zip(tensors, task.shapes, task.dtypes, strict=True)
        ]

    def run(
        self, task: Task, steps: int, state: HasBelief, data: Sequence[Tensor | None], *options: int | None,
        back: BackwardInputs | None = None,
    ) -> tuple[Any, Any]:  # fmt: skip
        """Runs the kernels of a task on these tensors: the state after all steps, and the record of each."""
        count = len(task.kernels.step.zero)
        full = self.full(task, [*flatten(state), *(x for x in data if x is not None), *self._read_for(back)])
        state, record = task.kernels.run(task.batch, steps, full[:count], full[count:], *options)
        return state, map_tensors(_as_count, record, task.kernels.step.record) if task.counts else record


def _as_count(x: Tensor, like: Tensor) -> Tensor:
    """A count, which kernels hold as a floating point number, as the whole number that it is."""
    return x if like.is_floating_point() else x.to(like.dtype)


def _event(module: nn.Module, part: dict[str, Any], x: Tensor | None, scans: bool) -> int | None:
    """The number of dimensions, without a batch, of what is read when a kernel runs; None for what is part of it.

    Read are hyperparameters, parameters, and buffers that have gradients.  Those that differ between the targets of
    ``scans`` are no batch.
    """
    if isinstance(module, Hyper) and (part is module._parameters or part is module._buffers):
        return module.event_dim + (scans and module.batch_rank > 0)
    read = part is module._parameters or (part is module._buffers and x is not None and x.requires_grad)
    return x.dim() if read and x is not None else None


_EMPTY = nn.Module().__dict__.keys()
_PLUMBING = {*_EMPTY, "engine"} - {"training"}


def _unchanged(sizes: Sequence[dict[str, Any]], items: Sequence[tuple[dict[str, Any], str, Any]]) -> Callable[[], bool]:
    """What says whether all is as it is now; it raises ``KeyError`` where something is gone.

    It is written as Python, like ``forms.flattener``, in a third of the time of a loop: every call begins with it.

    Args:
        sizes: dictionaries that are to have as many entries as now.
        items: dictionaries, keys and what is there; of tensors nobody may have written to.
    """
    known: dict[str, Any] = {}
    names: dict[int, str] = {}

    def name(x: object) -> str:
        known.setdefault(names.setdefault(id(x), f"x{len(names)}"), x)
        return names[id(x)]

    same = [f"{name(part)}[{key!r}] is {name(x)}" for part, key, x in items]
    long = [f"len({name(part)}) == {len(part)}" for part in sizes]
    tensors = {id(x): x for *_, x in items if isinstance(x, Tensor)}.values()
    versions = [f"{name(x)}._version == {x._version}" for x in tensors]
    function: Callable[[], bool] = eval(f"lambda: {' and '.join([*same, *long, *versions, 'True'])}", known)
    return function
