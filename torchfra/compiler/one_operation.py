"""Whole tracks as one operation of torch, into which ``torch.compile`` does not look.

It would unroll the loop over time, which takes it minutes.  So in the graph of a network a compiled filter is one node,
that runs kernels, and its gradient is another, that runs the filter's kernels again and then those of the gradient.
"""

from __future__ import annotations

import copy
import hashlib
import itertools
from collections.abc import Callable, Sequence
from typing import Any
from weakref import WeakValueDictionary

import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.library import custom_op

from torchfra.gaussian.inputs import Measurements
from torchfra.hyper import hypers
from torchfra.linalg.tracing import elementary
from torchfra.steps.engine import INTERPRETED
from torchfra.steps.recursion import Recursion
from torchfra.tree import flatten, map_tensors
from torchfra.types import Estimate, Gaussian

IS_THERE = torch.__version__ >= "2.11"  # compared as versions
"""Whether ``torch.compile`` follows named tuples into a filter and out of it."""
_OPTIONAL = ("u", "std", "noise")
"""Tensors that a call need not have."""
_CALLS: WeakValueDictionary[str, Call] = WeakValueDictionary()
"""By name; the engine of their filter keeps them."""
_COUNT = itertools.count()


class Calls:
    """The calls of a filter that ``torch.compile`` has traced, by name: it has its guards on attributes."""


class Call(nn.Module):
    """Calls of a filter that have one form.

    Args:
        f: the filter.
        method: ``"forward"`` or ``"smooth"``.
        names: of the tensors that come after ``z``, ``mean``, ``scale_tril`` and ``dt``.
        options: of the method.
    """

    places: Any
    """An estimate, with a number in the place of each tensor."""
    leaves: list[tuple[torch.dtype, torch.Size]]
    """Of each tensor of an estimate the dtype and, behind the batch, the shape for one step; none of a whole track."""

    def __init__(self, f: Recursion, method: str, names: Sequence[str], options: dict[str, Any]) -> None:
        super().__init__()
        self.filter, self.method, self.names, self.options = f, method, names, options
        read = {name for name, _ in f.named_parameters()} | {f"{path}.raw" for path in hypers(f)}
        self.values = tuple(name for name in _values(f) if name in read)

    def of(self, values: Sequence[Tensor], work: Callable[[], Any]) -> Any:
        """What ``work`` gives where the filter has these values."""
        replaced = {f"filter.{name}": x for name, x in zip(self.values, values, strict=True)}
        return functional_call(self, replaced, (work,), tie_weights=False)  # or two that share one stay replaced

    def forward(self, work: Callable[[], Any]) -> Any:
        """The same with the filter's own values."""
        return work()

    def estimate(self, tensors: Sequence[Tensor]) -> Estimate:
        """What the method returns."""
        z, mean, root, dt, *rest = tensors
        named = dict(zip(self.names, rest, strict=True))
        made: Estimate = getattr(self.filter, self.method)(z, Gaussian(mean, root), dt=dt, **named, **self.options)
        return made

    def batch(self, tensors: Sequence[Tensor]) -> torch.Size:
        """The batch of tracks, of whose numbers none is read.

        Raises:
            ValueError: a shape that does not fit.
        """
        z, mean, root, dt, *rest = tensors
        measurements = Measurements(z, dt, **dict(zip(self.names, rest, strict=True)), sensor=None)
        with elementary():
            batch: torch.Size = self.filter._batch(measurements, Gaussian(mean, root))
        return batch

    def try_out(self, dtype: torch.dtype, device: torch.device, known: int) -> None:
        """Finds out what an estimate holds, by an interpreted track of one step.

        Args:
            dtype: of ``z``.
            device: of ``z``.
            known: size of ``u``.
        """
        alone: Any = copy.copy(self.filter)
        alone.engine = INTERPRETED
        n, m, one = alone.motion.size, alone.sensor.size, torch.ones(1, dtype=dtype, device=device)
        rest = {"u": one.expand(1, known), "std": one.expand(1, m), "noise": one.expand(1, m).diag_embed()}
        tensors = (one.expand(1, m), one.expand(n), one.expand(n).diag(), one, *(rest[name] for name in self.names))
        with torch.no_grad():
            made = Call(alone, self.method, self.names, self.options).estimate(tensors)
        rank, count = made.mean.dim() - 2, itertools.count()
        self.leaves = [(x.dtype, x.shape[rank:]) for x in flatten(made)]
        self.places = map_tensors(lambda x: next(count), made)


def known_call(
    f: Recursion, method: str, names: tuple[str, ...], options: tuple[Any, ...], dtype: torch.dtype,
    device: torch.device, known: int,
) -> str:  # fmt: skip
    """The name by which the operations know calls of a form; the last three go to ``Call.try_out``."""
    call = Call(f, method, names, dict(options))
    call.try_out(dtype, device, known)
    # In the name are shapes: torch keeps what it has compiled, and a later process must not take it for another's.
    digest = hashlib.sha256(repr((method, names, options, call.values, call.leaves)).encode()).hexdigest()[:16]
    name = f"call_{digest}_{next(_COUNT)}"
    _CALLS[name] = call
    setattr(f.engine.calls, name, call)  # type: ignore[union-attr]  # of a compiled engine
    return name


def in_transform() -> bool:
    """Whether a transform of ``torch.func`` is at work."""
    return torch._C._functorch.peek_interpreter_stack() is not None


# What torch.compiler.assume_constant_result does, which would import torch._dynamo.
known_call._dynamo_marked_constant = in_transform._dynamo_marked_constant = True  # type: ignore[attr-defined]


def takes(f: Recursion, options: dict[str, Any]) -> bool:
    """Whether ``torch.compile`` sees a call that can be one operation: tracks, one sensor, outside of transforms."""
    apart = any(options.get(name) is not None for name in ("sensors", "which", "estimate")) or options.get("past")
    traced = IS_THERE and torch.compiler.is_dynamo_compiling() and not torch.compiler.is_exporting()
    return traced and not (f.scans or apart or in_transform())


def call(method: str, f: Recursion, z: Tensor, prior: Gaussian, **options: Any) -> Estimate:
    """What the method of this name gives, for ``torch.compile`` to trace."""
    rest = {name: options[name] for name in _OPTIONAL if options.get(name) is not None}
    others = tuple((name, x) for name, x in options.items() if name not in (*_OPTIONAL, "dt"))
    dt = torch.as_tensor(options.get("dt", 1.0), dtype=torch.float64, device=z.device)
    known = len(range(rest["u"].shape[-1])) if "u" in rest else 0  # the range makes a constant of what may be a symbol
    name = known_call(f, method, tuple(rest), others, z.dtype, z.device, known)
    made, values = getattr(f.engine.calls, name), _values(f)  # type: ignore[union-attr]
    written = whole_tracks(name, [z, *prior, dt, *rest.values()], [values[path] for path in made.values])
    estimate: Estimate = _placed(made.places, written)
    return estimate


def _values(f: nn.Module) -> dict[str, Tensor]:
    return dict(f.named_parameters()) | dict(f.named_buffers())


def _placed(places: object, tensors: Sequence[Tensor]) -> Any:
    """A tree with tensors in the places of their numbers."""
    if isinstance(places, int):
        return tensors[places]
    if not isinstance(places, tuple):
        return places
    parts = [_placed(part, tensors) for part in places]
    return tuple(parts) if type(places) is tuple else type(places)(*parts)


def _own(x: Tensor) -> Tensor:
    """In memory of its own, as torch asks of what an operation returns."""
    return x.detach().clone(memory_format=torch.contiguous_format)


@custom_op(
    "torchfra::whole_tracks", mutates_args=(), schema="(str name, Tensor[] tensors, Tensor[] values) -> Tensor[]"
)
def whole_tracks(name: str, tensors: list[Tensor], values: list[Tensor]) -> list[Tensor]:
    """The tensors of an estimate."""
    call = _CALLS[name]
    estimate = call.of(values, lambda: call.estimate(tensors))
    return [_own(x) for x in flatten(estimate)]


@whole_tracks.register_fake
def _(name: str, tensors: list[Tensor], values: list[Tensor]) -> list[Tensor]:
    call, z = _CALLS[name], tensors[0]
    batch = call.of(values, lambda: call.batch(tensors))
    steps = z.shape[-2:-1]
    return [z.new_empty((*batch, *(steps if shape else ()), *shape[1:]), dtype=dtype) for dtype, shape in call.leaves]


@custom_op(
    "torchfra::whole_tracks_gradient",
    mutates_args=(),
    schema="(str name, Tensor[] tensors, Tensor[] values, Tensor[] grads, int[] places, int[] needed) -> Tensor[]",
)
def whole_tracks_gradient(
    name: str, tensors: list[Tensor], values: list[Tensor], grads: list[Tensor], places: list[int], needed: list[int]
) -> list[Tensor]:
    """Gradients of the tensors and values that are ``needed``, from those of the estimate in these ``places``."""
    call = _CALLS[name]
    with torch.inference_mode(False), torch.enable_grad():  # the former takes autograd back into an operation
        inputs = [x.detach() for x in (*tensors, *values)]
        wanted = [inputs[i].requires_grad_() for i in needed]
        written = flatten(call.of(inputs[len(tensors) :], lambda: call.estimate(inputs[: len(tensors)])))
        pulls = {i: grad for i, grad in zip(places, grads, strict=True) if written[i].requires_grad}
        if not pulls:
            return [torch.zeros_like(x, memory_format=torch.contiguous_format) for x in wanted]
        found = torch.autograd.grad([written[i] for i in pulls], wanted, [*pulls.values()], materialize_grads=True)
    return [_own(x) for x in found]


@whole_tracks_gradient.register_fake
def _(
    name: str, tensors: list[Tensor], values: list[Tensor], grads: list[Tensor], places: list[int], needed: list[int]
) -> list[Tensor]:
    inputs = [*tensors, *values]
    return [torch.empty_like(inputs[i], memory_format=torch.contiguous_format) for i in needed]


def _setup(ctx: Any, inputs: tuple[Any, ...], output: list[Tensor]) -> None:
    ctx.name, tensors, values = inputs
    ctx.count = len(tensors)
    ctx.save_for_backward(*tensors, *values)
    ctx.set_materialize_grads(False)


def _back(ctx: Any, grads: list[Tensor | None]) -> tuple[None, list[Tensor | None], list[Tensor | None]]:
    inputs = ctx.saved_tensors
    needed = [i for i, x in enumerate(itertools.chain(*ctx.needs_input_grad[1:])) if x]
    places = [i for i, grad in enumerate(grads) if grad is not None]
    tensors, values = inputs[: ctx.count], inputs[ctx.count :]
    found = whole_tracks_gradient(ctx.name, list(tensors), list(values), [grads[i] for i in places], places, needed)
    every = dict(zip(needed, found, strict=True))
    gradients = [every.get(i) for i in range(len(inputs))]
    return None, gradients[: ctx.count], gradients[ctx.count :]


whole_tracks.register_autograd(_back, setup_context=_setup)
