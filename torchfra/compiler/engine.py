"""Engines of compiled filters, whose step runs as one kernel over all tracks and steps, made at once or meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from functools import lru_cache, partialmethod
from typing import Any

import torch
from torch import Tensor, nn

from torchfra.compiler import one_operation, traced
from torchfra.compiler.backward import BackwardInputs, backward_inputs, cut, of_windows, windows
from torchfra.compiler.forms import hooked, late
from torchfra.compiler.llvm import is_installed
from torchfra.compiler.pieces import is_long
from torchfra.compiler.program import Making, building
from torchfra.compiler.ready import Data, check_changing, form_of, is_ordinary, is_short, number, seconds_of
from torchfra.compiler.run import has_gradient
from torchfra.compiler.source import SCALARS
from torchfra.compiler.version import Task, Version
from torchfra.gaussian.arguments import check_seconds
from torchfra.gaussian.inputs import Frame, Measurements
from torchfra.linalg.tracing import has_tangents, is_traced
from torchfra.numbers import NUMBERS
from torchfra.steps.checks import check_step
from torchfra.steps.engine import INTERPRETED, Engine
from torchfra.steps.loop import Options, finish, observe, observe_apart, start
from torchfra.steps.recursion import HasBelief, Recursion
from torchfra.tree import flatten, map_tensors, unflatten
from torchfra.types import Estimate, Gaussian

_VERSIONS = 4
"""How many are remembered: a filter may go back and forth, between soft decisions and hard ones say."""
_SENSORS = 32
"""Of how many other sensors kernels are remembered: with a new one for every step, every step makes new ones."""
_FORMS = 64
"""How many forms of a single step are remembered."""


class Compiled(Engine):
    """Kernels of a filter, one set for each form of call; they are made when first needed.

    Hyperparameters, parameters, ``kernel_numbers`` and data are read when a kernel runs.  All else is part of it: when
    an attribute, a buffer or a part of the filter has been replaced, or a tensor has changed, there are other kernels.
    (A list or dictionary that changes inside is not noticed.)
    """

    def __init__(self) -> None:
        self._versions, self.calls = list[Version](), one_operation.Calls()
        self._of_others = dict[int, tuple[nn.Module, list[Version]]]()

    def __reduce__(self) -> tuple[type[Compiled], tuple[()]]:
        return Compiled, ()  # kernels are no part of a copy

    def _now(self, f: nn.Module, sensor: nn.Module | None = None) -> Version:
        """The kernels that hold for the filter as it is, and another ``sensor``; the version used last comes first."""
        if sensor is None:
            module, versions = f, self._versions
        else:
            known = self._of_others.pop(id(sensor), None)
            if len(self._of_others) == _SENSORS:  # the one that was used least recently goes
                self._of_others.pop(next(iter(self._of_others)))
            module, versions = self._of_others[id(sensor)] = known or (traced.WithSensor(f, sensor), [])
        if versions and versions[0].holds():
            return versions[0]
        with building():
            now = next((x for x in versions if x.holds()), None) or Version(module)
            versions[:] = [now, *(x for x in versions if x is not now)][:_VERSIONS]
        return now

    @staticmethod
    def takes(z: object) -> bool:
        """Whether kernels can work on it: on the CPU or NVIDIA's GPUs, not inside ``torch.compile`` or a transform."""
        return (
            isinstance(z, Tensor)
            and z.dtype in SCALARS
            and not is_traced()
            and ((z.is_cpu and is_installed()) or (z.is_cuda and torch.version.hip is None))
            and not one_operation.in_transform()
            and not (torch.is_grad_enabled() and has_tangents())
        )

    def call(self, method: Callable[..., Estimate], f: Recursion, *arguments: Any, **options: Any) -> Estimate:
        """What a method of the filter gives for whole tracks: to ``torch.compile`` it is one operation."""
        if one_operation.takes(f, options):
            return one_operation.call(method.__name__, f, *arguments, **options)
        return method(f, *arguments, **options)

    def forward(
        self, f: Recursion, measurements: Measurements, prior: Gaussian, options: Options
    ) -> tuple[Estimate, Any, Any]:
        """Whole tracks from their prior: the estimate, and for a backward pass the last state and what is kept."""
        if not self.takes(measurements.z):
            return super().forward(f, measurements, prior, options)
        done = self._ready(f, measurements, prior, options)
        if done is None:
            begun, rank = start(f, measurements, prior)
            done = self.scan(f, begun, measurements, rank, options)
            self._get_ready(f, begun, measurements, prior, options)
        if isinstance(done, Estimate):
            return done, None, None
        state, kept = done
        return finish(f, state, kept), state, kept.past

    def _ready(self, f: Recursion, measurements: Measurements, prior: Gaussian, options: Options) -> Any:
        """The estimate, or what ``scan`` gives from a prior; None unless a call of this form is known.

        Raises:
            ValueError: the time steps or the noise have a bad value.
        """
        if not self._versions or not isinstance(prior, Gaussian) or has_tangents():
            return None
        now, form = self._now(f), form_of(measurements, options.past, _plain(options))
        return now.tracks(f, form, prior, measurements, now.read)

    def _get_ready(
        self, f: Recursion, state: HasBelief, measurements: Measurements, prior: Gaussian, options: Options
    ) -> None:
        """Makes later calls of ``forward`` like this one ready, if that is worth it; ``state`` is that of the prior."""
        plain, past = _plain(options), options.past
        form, z, now = form_of(measurements, past, plain), measurements.z, self._now(f)
        if is_long(z.shape[:-2], z.shape[-2]):
            return  # which runs in pieces
        inputs = [z, *prior, *(x for x in measurements[1:] if isinstance(x, Tensor)), *now.read()]
        shapes = z.dtype, z.shape, *(x.shape for x in prior)
        if not f.scans and now.tracks.due((form, shapes), z.shape[:-1].numel(), has_gradient(inputs)):
            now, task, data = self._task(f, state, measurements, past)
            now.get_tracks_ready(form, task, prior, state, data, past, plain)

    def scan(
        self, f: Recursion, state: HasBelief, measurements: Measurements, rank: int, options: Options
    ) -> tuple[Any, Any]:
        """The state after whole tracks that have been checked, and what is kept of each step."""
        if not self.takes(measurements.z):
            return super().scan(f, state, measurements, rank, options)
        past = options.past
        now, task, data = self._task(f, state, measurements, past)
        first = task.kernels.is_new and task.device.type == "cpu" and not f.scans and measurements.sensor is None
        if first and not has_gradient([*flatten((state, data)), *now.read()]):
            if past:
                task.kernels.meanwhile = Making(target=self._make_backward, args=(f, task, measurements))
            elif is_short(measurements.z.shape[:-1].numel()):
                task.kernels.meanwhile = Making(target=self._make_boundary, args=(task,))
        steps, rank = measurements.z.shape[-2 - f.scans], len(task.batch)
        state, kept = now.run(task, steps, state, data, options.checkpoint, options.truncate)
        # The batch is that of scenes: time comes behind the targets of each.
        return state, map_tensors(lambda x: x.movedim(rank, rank + 1), kept) if f.scans else kept

    def _task(
        self, f: Recursion, state: HasBelief, measurements: Measurements, past: bool
    ) -> tuple[Version, Task, Data]:
        """The kernels that hold for the filter, what this form of call comes to, and its data."""
        data, now = (measurements.z, seconds_of(measurements), *measurements[2:5]), self._now(f, measurements.sensor)
        advance = traced.Advance(traced.keep_past if past else traced.keep, _complete(f, measurements))
        with building():
            return now, now.task(advance, state, data, (True, measurements.varying_dt, True, True, True)), data

    def backward(
        self, f: Recursion, past: object, measurements: Measurements, rank: int, frames: Callable[[], Sequence[Frame]],
        lag: int | None, options: Options,
    ) -> Any:  # fmt: skip
        """The backward pass over a ``past``, time behind ``rank`` batch dimensions."""
        if not self.takes(measurements.z):
            return super().backward(f, past, measurements, rank, frames, lag, options)
        measurements = f.for_each_target(measurements) if f.scans else measurements  # type: ignore[operator]
        truncate = options.truncate
        source = cut(past, rank, truncate) if truncate and has_gradient(flatten(past)) else None
        if lag is None or lag >= flatten(past)[0].shape[rank] - 1:
            return self._back(f, backward_inputs(f, past, source, measurements, rank))
        every = windows(f, past, source, measurements, rank, lag)
        parts = [self._back(f, backward_inputs(f, *part, rank + 1)._replace(windows=True)) for part in every]
        return of_windows(parts, rank, lag)

    def _back(self, f: Recursion, back: BackwardInputs) -> Any:
        now, task, data = self._task_back(f, back)
        return now.run(task, back.steps, back.state, data, back=back)[1]

    def _task_back(self, f: Recursion, back: BackwardInputs) -> tuple[Version, Task, list[Tensor]]:
        """The same as ``_task`` of a backward pass."""
        now, data, timed = self._now(f), list(back.data.values()), list(back.timed.values())
        with building():
            return now, now.task(back.advance, back.state, data, timed, back), data

    def _make_backward(self, f: Recursion, task: Task, measurements: Measurements) -> None:
        """Makes the kernel of the backward pass, from zeros for what the filter will keep of two steps of a track.

        It is traced while LLVM compiles the filter.  An error comes again in the call that needs the kernel.
        """
        step, rank = task.kernels.step, len(task.batch)
        leaves = zip(flatten(step.record), late(step.record), strict=True)
        record = [torch.zeros(*(1,) * rank, 2 + more, *x.shape, dtype=x.dtype) for x, more in leaves]
        state = map_tensors(lambda x: torch.zeros((*(1,) * rank, *x.shape), dtype=step.dtype), step.state)
        with suppress(Exception), torch.no_grad():
            kept = unflatten(step.record, iter(record))
            estimate = finish(f, state, kept)
            past = f.past(Gaussian(estimate.mean, estimate.scale_tril), estimate.info, state, kept.past)
            back = self._task_back(f, backward_inputs(f, past, None, measurements, rank))[1]
            back.kernels.forwards(torch.Size([2]), task.device)

    @staticmethod
    def _make_boundary(task: Task) -> None:
        """Makes what ``_get_ready`` will need, while LLVM compiles the steps.  An error comes again there."""
        with suppress(Exception):
            task.kernels.around(learns=False)

    def once(
        self, f: Recursion, function: Callable[..., tuple[Any, Any]], state: HasBelief, measurements: Measurements
    ) -> tuple[Any, Any]:
        """What ``function(f, state, frame)`` gives for one measurement or scan that has been checked."""
        if not self.takes(measurements.z):
            return super().once(f, function, state, measurements)
        data, now = (measurements.z, seconds_of(measurements), *measurements[2:5]), self._now(f, measurements.sensor)
        with building():
            task = now.task(traced.Advance(function, _complete(f, measurements)), state, data, (False,) * 5)
        return now.run(task, 1, state, data)

    def step(self, f: Recursion, state: HasBelief, measurements: Measurements, apart: bool = False) -> tuple[Any, Any]:
        """The state after one measurement, and its innovation: see ``Engine``.

        Shapes are checked unless a call of the same shapes has passed before.
        """
        if not self.takes(measurements.z):
            return super().step(f, state, measurements, apart)
        z, dt, u, std, noise, sensor = measurements
        if not isinstance(dt, (Tensor, *NUMBERS)):
            check_step(f, state, measurements)
        now, belief = self._now(f, sensor), getattr(state, "belief", None)
        like = belief.mean if isinstance(belief, Gaussian) else z  # the state says the precision
        data = (z, dt if isinstance(dt, Tensor) else _seconds(dt, like.dtype, f.limits.zero_dt), u, std, noise)
        checked = not isinstance(dt, Tensor) and std is None and noise is None
        kind = _complete(f, measurements), apart
        done = now.ready[kind](state, data, now.read(), None if checked else f.limits.zero_dt)
        return self._prepare(f, now, state, measurements, data, kind) if done is None else done

    @staticmethod
    def _prepare(
        f: Recursion, now: Version, state: HasBelief, measurements: Measurements, data: Data, kind: tuple[bool, bool]
    ) -> tuple[Any, Any]:
        """The same where no step is ready, which then becomes ready if it can."""
        tensors = (*data, *flatten(state), *now.read())
        form = (type(state), kind, *((x.shape, x.dtype) if isinstance(x, Tensor) else type(x) for x in tensors))
        task = now.steps.get(form)
        if task is None:
            check_step(f, state, measurements)
            complete, apart = kind
            advance = traced.Advance(observe_apart if apart else observe, complete)
            with building():
                if len(now.steps) == _FORMS:
                    now.steps.clear()
                task = now.steps[form] = now.task(advance, state, data, (False,) * 5)
        else:
            check_changing(data, f.limits.zero_dt)
        now.get_ready(task, state, data, kind)
        return now.run(task, 1, state, data)


def _plain(options: Options) -> bool:
    """Whether gradients flow through all steps, and none is computed again."""
    return not (options.checkpoint or options.truncate or hooked())


def _complete(f: Recursion, measurements: Measurements) -> bool:
    return bool(f.scans and f.complete(measurements))  # type: ignore[operator]  # a ``JPDA`` has it


@lru_cache(maxsize=64)
def _seconds(dt: float, dtype: torch.dtype, zero_dt: bool) -> Tensor:
    """A time step that has been checked."""
    seconds = number(dt, dtype)
    if not is_ordinary(seconds, dtype):
        check_seconds(dt, dtype, zero_dt)
    return seconds


class InBackground(Engine):
    """Runs a call of a new form interpreted, while a thread makes its kernels; later calls of that form run compiled.

    The thread makes the same call, on copies of its arguments.  A call with gradients waits for its kernels.
    """

    def __init__(self) -> None:
        self._compiled = Compiled()
        self.calls = self._compiled.calls
        self._made: dict[Hashable, Future[Any]] = {}

    def __reduce__(self) -> tuple[type[InBackground], tuple[()]]:
        return InBackground, ()  # kernels are no part of a copy

    def call(self, method: Callable[..., Estimate], f: Recursion, *arguments: Any, **options: Any) -> Estimate:
        """As ``Compiled`` does."""
        return self._compiled.call(method, f, *arguments, **options)

    def _run(self, name: str, f: Recursion, *arguments: Any) -> Any:
        """The result of the method of this name; see ``steps.engine.Engine``.

        Raises:
            CompileError, NotImplementedError: kernels for an earlier call like this one could not be made.
        """
        others = [x.sensor for x in arguments if isinstance(x, Measurements) and x.sensor is not None]
        tensors = [x for part in (f, *others) for x in part.parameters()] + flatten(arguments)
        if has_gradient(tensors) or not all(Compiled.takes(x) for x in tensors if x.is_floating_point()):
            return getattr(self._compiled, name)(f, *arguments)
        form = name, torch.is_grad_enabled(), torch.is_inference_mode_enabled(), _kinds(arguments)
        made = self._made.get(form)
        if made is None:
            made = self._made[form] = self._start(name, f, map_tensors(Tensor.clone, arguments))
        if not made.done():
            return getattr(INTERPRETED, name)(f, *arguments)
        made.result()
        return getattr(self._compiled, name)(f, *arguments)

    step, once = partialmethod(_run, "step"), partialmethod(_run, "once")
    scan = partialmethod(_run, "scan")
    forward, backward = partialmethod(_run, "forward"), partialmethod(_run, "backward")

    def _start(self, name: str, f: Recursion, arguments: tuple[Any, ...]) -> Future[Any]:
        """Makes a call in a thread."""
        made: Future[Any] = Future()
        inference, grad = torch.is_inference_mode_enabled(), torch.is_grad_enabled()

        def work() -> None:
            try:
                with torch.inference_mode(inference), torch.set_grad_enabled(grad):  # which hold for each thread alone
                    getattr(self._compiled, name)(f, *arguments)
            except BaseException as error:
                made.set_exception(error)
            else:
                made.set_result(None)

        Making(target=work).start()
        return made


def _kinds(x: object) -> Hashable:
    """What kernels depend on; of numbers and tensors not the values."""
    if isinstance(x, Tensor):
        return x.dtype, x.device, x.dim(), x.dim() == 0 or x.shape[:-1].numel() == 1
    if isinstance(x, tuple):
        return type(x), tuple(map(_kinds, x))
    if x is None or isinstance(x, bool) or callable(x):
        itself: Hashable = x
        return itself
    return str(type(x))
