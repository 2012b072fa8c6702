"""A filter whose step runs as one kernel over all tracks and steps: what ``Filter.compile`` makes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torchfra.filters.frames import Frame, Time, make_frames
from torchfra.hyper import Hyper
from torchfra.kernel.entries import Entries
from torchfra.kernel.expressions import Expressions
from torchfra.kernel.run import Kernels
from torchfra.kernel.source import SCALARS
from torchfra.kernel.step import Input, Step, flatten
from torchfra.linalg import is_traced
from torchfra.types import Gaussian, Innovation

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


class Compiled:
    """Kernels of a filter, one set for each form of call; they are made when first needed.

    Hyperparameters, parameters and data are read when a kernel runs.  All else is part of it: when an attribute, a
    buffer or a part of the filter has changed, kernels are made anew.
    """

    def __init__(self) -> None:
        self._kernels: dict[tuple[Any, ...], Kernels] = {}
        self._steps: dict[tuple[Any, ...], _Plan] = {}
        self._watched: list[_Watched] = []
        self._values: list[_Value] = []

    def __reduce__(self) -> tuple[type[Compiled], tuple[()]]:
        return Compiled, ()  # kernels are no part of a copy

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
        self._watch(f)
        plan = self._plan(f, _keep, state, (z, seconds, *rest), (True, not stays, True, True, True))
        return self._run(plan, z.shape[-2], state, (z, seconds, *rest), checkpoint, truncate)

    def step(self, f: Any, state: Any, given: Given, check: Callable[[], None]) -> tuple[Any, Innovation]:
        """The state after one measurement, and its innovation.

        ``check`` is called unless a call of the same shapes has passed it before.
        """
        z, dt, *rest = given
        seconds = torch.as_tensor(dt, dtype=z.dtype)
        self._watch(f)
        mean = state.belief.mean
        form = (z.dtype, mean.dtype, mean.shape, *(None if x is None else x.shape for x in (z, seconds, *rest)))
        plan = self._steps.get(form)
        if plan is None or not (isinstance(dt, float) and dt > 0):
            check()
        if plan is None:
            plan = self._steps[form] = self._plan(f, _observe, state, (z, seconds, *rest), (False,) * 5)
        state, innovation = self._run(plan, 1, state, (z, seconds, *rest))
        return state, Innovation(*(x.select(len(plan.batch), 0) for x in innovation))

    def _plan(
        self, f: Any, advance: Callable[..., Any], state: Any, given: Sequence[Tensor | None], timed: Sequence[bool]
    ) -> _Plan:
        mean = state.belief.mean
        batch, dtype = mean.shape[:-1], mean.dtype
        inputs, shapes = {}, []
        for name, x, event, varies in zip(_NAMES, given, _EVENTS, timed, strict=True):
            if x is not None:
                inputs[name] = Input(x.shape[x.dim() - event :], varies, False)
                shapes.append(batch + x.shape[x.dim() - event - varies :])
        for value in self._values:
            own = value().shape[value().dim() - value.event :]
            inputs[value.path] = Input(own, False, True)
            shapes.append(batch + own)
        key = (advance, dtype, tuple(inputs.items()))
        if key not in self._kernels:
            self._kernels[key] = Kernels(Step(f, _begin, advance, inputs, dtype))
        return _Plan(self._kernels[key], batch, shapes)

    def _run(self, plan: _Plan, steps: int, state: Any, given: Sequence[Tensor | None], *options: int | None) -> Any:
        tensors = [x for x in given if x is not None] + [value() for value in self._values]
        leaves = flatten(state)
        dtype = leaves[0].dtype
        full = [
            (x if x.dtype == dtype else x.to(dtype)).expand(shape) if x.shape != shape or x.dtype != dtype else x
            for x, shape in zip(tensors, plan.shapes, strict=True)
        ]
        return plan.kernels.run(plan.batch, steps, leaves, full, *options)

    def _watch(self, f: nn.Module) -> None:
        """Forgets all kernels if something in the filter has changed that they take for granted."""
        for owner, key, found, version in self._watched:
            x = owner.get(key)
            if x is not found or (version is not None and x._version != version):
                break
        else:
            if self._watched:
                return
        self._kernels.clear()
        self._steps.clear()
        self._watched, self._values = [], []
        for path, module in f.named_modules():
            hyper = isinstance(module, Hyper)
            self._values += [
                _Value(f"{path}.{key}" if path else key, module, key, module.event if isinstance(module, Hyper) else x.dim())
                for key, x in ({"raw": module.raw} if isinstance(module, Hyper) else module._parameters).items()
                if x is not None
            ]
            plain = {key for key in module.__dict__ if key not in _PLUMBING}
            for owner, keys in ((module.__dict__, plain), (module._modules, module._modules), (module._buffers, () if hyper else module._buffers)):
                for key in keys:
                    x = owner[key]
                    self._watched.append(_Watched(owner, key, x, x._version if isinstance(x, Tensor) else None))


_PLUMBING = {*nn.Module().__dict__, "_compiled"}


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
