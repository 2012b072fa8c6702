"""A filter whose step runs as one kernel over all tracks and steps: what ``Filter.compile`` makes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torchfra.filters.frames import Frame, Time, make_frames
from torchfra.hyper import Hyper
from torchfra.kernel.entries import Entries
from torchfra.kernel.expressions import Expressions
from torchfra.kernel.run import Kernels
from torchfra.kernel.source import SCALARS
from torchfra.kernel.step import Input, Step
from torchfra.linalg import is_traced
from torchfra.types import Gaussian, Innovation, flatten

Given = tuple[Tensor, Time, Tensor | None, Tensor | None, Tensor | None]
"""``z``, ``dt``, ``u``, ``std`` and ``noise`` of a call."""

_NAMES = ("z", "dt", "u", "std", "noise")
_EVENTS = (1, 0, 1, 1, 2)


class _Watched(NamedTuple):
    """Something of the filter that kernels take for granted."""

    owner: dict[str, Any]
    key: str
    found: Any
    version: int | None


class _Value(NamedTuple):
    """A parameter, or the value of a hyperparameter."""

    path: str
    module: nn.Module
    key: str
    event: int

    def __call__(self) -> Tensor:
        x = self.module._parameters.get(self.key)
        return self.module._buffers[self.key] if x is None else x  # type: ignore[return-value]


class _Plan(NamedTuple):
    """What a form of call comes to."""

    kernels: Kernels
    batch: torch.Size
    shapes: list[torch.Size]
    """Of what a kernel is given, values last, batches full."""


class _Version:
    """A filter as it is at the moment, and the kernels that take it for granted."""

    def __init__(self, f: nn.Module) -> None:
        self.kernels: dict[tuple[Any, ...], Kernels] = {}
        self.steps: dict[tuple[Any, ...], _Plan] = {}
        self.watched: list[_Watched] = []
        self.values: list[_Value] = []
        for path, module in f.named_modules():
            for owner in (module._parameters, module._buffers):
                self.values += [_Value(f"{path}.{key}".lstrip("."), module, key, event)
                                for key, x in owner.items() if (event := _event(module, x)) is not None]  # fmt: skip
            plain = {key: x for key, x in module.__dict__.items() if key not in _PLUMBING}
            fixed = {key: x for key, x in module._buffers.items() if _event(module, x) is None}
            for owner, part in ((module.__dict__, plain), (module._modules, module._modules), (module._buffers, fixed)):
                self.watched += [
                    _Watched(owner, key, x, x._version if isinstance(x, Tensor) else None) for key, x in part.items()
                ]

    def holds(self) -> bool:
        """Whether nothing has changed since."""
        for owner, key, found, version in self.watched:
            x = owner.get(key)
            if x is not found or (version is not None and x._version != version):
                return False
        return True

    def plan(
        self,
        f: Any,
        advance: Callable[..., Any],
        state: Any,
        given: Sequence[Tensor | None],
        timed: Sequence[bool],
    ) -> _Plan:
        """What is to be done with what is ``given``, and has its own for each step where ``timed``."""
        mean, dtype = state.belief.mean, state.belief.mean.dtype
        own = [(value, value().shape, value().dim() - value.event) for value in self.values]
        batch = torch.broadcast_shapes(mean.shape[:-1], *(shape[:rank] for _, shape, rank in own))
        inputs, shapes = {}, []
        for name, x, event, varies in zip(_NAMES, given, _EVENTS, timed, strict=True):
            if x is not None:
                inputs[name] = Input(x.shape[x.dim() - event :], varies, False)
                shapes.append(batch + x.shape[x.dim() - event - varies :])
        for value, shape, rank in own:
            inputs[value.path] = Input(shape[rank:], False, True)
            shapes.append(batch + shape[rank:])
        key = (advance, dtype, tuple(inputs.items()))
        if key not in self.kernels:
            self.kernels[key] = Kernels(Step(f, _begin, advance, inputs, dtype, timed[0]))
        return _Plan(self.kernels[key], batch, shapes)

    def run(
        self, plan: _Plan, steps: int, state: Any, given: Sequence[Tensor | None], *options: int | None
    ) -> tuple[Any, Any]:
        """Does it."""
        mean = state.belief.mean
        leaves, rank, dtype = flatten(state), mean.dim() - 1, mean.dtype
        if mean.shape[:-1] != plan.batch:
            leaves = [x.expand(plan.batch + x.shape[rank:]) for x in leaves]
        tensors = [x for x in given if x is not None] + [value() for value in self.values]
        full = [
            x if x.shape == shape and x.dtype == dtype else x.to(dtype).expand(shape)
            for x, shape in zip(tensors, plan.shapes, strict=True)
        ]
        return plan.kernels.run(plan.batch, steps, leaves, full, *options)


def _event(module: nn.Module, x: Tensor | None) -> int | None:
    """The number of dimensions, without a batch, of what is read when a kernel runs; None for what is part of it.

    Read are hyperparameters, parameters, and buffers that are single numbers.
    """
    if isinstance(module, Hyper):
        return module.event
    if isinstance(x, nn.Parameter):
        return x.dim()
    return 0 if x is not None and x.dim() == 0 and x.is_floating_point() else None


_PLUMBING = {*nn.Module().__dict__, "_compiled"}
_VERSIONS = 4
"""How many are remembered: a filter may go back and forth, between soft decisions and hard ones say."""


class Compiled:
    """Kernels of a filter, one set for each form of call; they are made when first needed.

    Hyperparameters, parameters, single numbers and data are read when a kernel runs.  All else is part of it: when an
    attribute, a buffer or a part of the filter has changed, there are other kernels.
    """

    def __init__(self) -> None:
        self._versions: list[_Version] = []

    def __reduce__(self) -> tuple[type[Compiled], tuple[()]]:
        return Compiled, ()  # kernels are no part of a copy

    def _now(self, f: nn.Module) -> _Version:
        """The kernels that hold for the filter as it is; the version used last comes first."""
        for k, version in enumerate(self._versions):
            if version.holds():
                if k:
                    self._versions.insert(0, self._versions.pop(k))
                return version
        self._versions = [_Version(f), *self._versions[: _VERSIONS - 1]]
        return self._versions[0]

    @staticmethod
    def takes(z: Tensor) -> bool:
        """Whether kernels can work on it: on the CPU, and not inside ``torch.compile`` or a transform."""
        return z.device.type == "cpu" and z.dtype in SCALARS and not is_traced(z)

    def forward(
        self, f: Any, state: Any, given: Given, checkpoint: int | None, truncate: int | None
    ) -> tuple[Any, Any]:
        """The state after whole tracks, and what ``f.keep`` keeps of each step.

        All has been checked, and the batch of ``state`` is that of all that is given.
        """
        z, dt, *rest = given
        seconds = torch.as_tensor(dt, dtype=z.dtype)
        stays = seconds.dim() == 0 or seconds.shape[-1] == 1
        seconds = seconds[..., 0] if stays and seconds.dim() else seconds
        now = self._now(f)
        plan = now.plan(f, _keep, state, (z, seconds, *rest), (True, not stays, True, True, True))
        return now.run(plan, z.shape[-2], state, (z, seconds, *rest), checkpoint, truncate)

    def step(self, f: Any, state: Any, given: Given, check: Callable[[], None]) -> tuple[Any, Innovation]:
        """The state after one measurement, and its innovation.

        ``check`` is called unless a call of the same shapes has passed it before.
        """
        z, dt, *rest = given
        seconds = dt if isinstance(dt, Tensor) else _seconds(dt, z.dtype)
        now = self._now(f)
        mean = state.belief.mean
        shapes = [None if x is None else x.shape for x in (z, seconds, *rest, *(value() for value in now.values))]
        form = (z.dtype, mean.dtype, mean.shape, *shapes)
        plan = now.steps.get(form)
        if plan is None or not (isinstance(dt, float) and dt > 0):
            check()
        if plan is None:
            plan = now.steps[form] = now.plan(f, _observe, state, (z, seconds, *rest), (False,) * 5)
        return now.run(plan, 1, state, (z, seconds, *rest))


@lru_cache(maxsize=64)
def _seconds(dt: float, dtype: torch.dtype) -> Tensor:
    return torch.tensor(dt, dtype=dtype)


def _begin(f: Any) -> Any:
    n, dtype, book = f.motion.size, torch.float64, Expressions()
    root = Entries.inputs(book, (n, n), dtype).ids.tril()
    return f.begin(Gaussian(Entries.inputs(book, (n,), dtype), Entries(book, root, dtype)))


def _frame(f: Any, given: dict[str, Tensor]) -> Frame:
    """The frame of one step of one track."""
    z, u, std, noise = (given[name].unsqueeze(0) if name in given else None for name in ("z", "u", "std", "noise"))
    assert z is not None
    (frame,), _ = make_frames(f.motion, f.sensor, z, given["dt"], u, std, noise, 0)
    return frame


def _keep(f: Any, state: Any, given: dict[str, Tensor]) -> Any:
    return f.keep(state, _frame(f, given))


def _observe(f: Any, state: Any, given: dict[str, Tensor]) -> Any:
    return f.observe(state, _frame(f, given))
