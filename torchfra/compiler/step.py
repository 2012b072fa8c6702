"""A filter's step as expressions: traced once for one track, forwards and backwards."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

import torchfra.compiler.operations  # noqa: F401  fills the table of operations that Entries look up
from torchfra.compiler.cpp import give
from torchfra.compiler.entries import Entries, as_entries, entry_ids, pulled_back
from torchfra.compiler.expressions import ZERO, Expressions, TooManyError
from torchfra.compiler.forms import late
from torchfra.compiler.origin import gradient_refusals_of, refusals_of
from torchfra.compiler.routines import called_for_each
from torchfra.compiler.source import Port, Scan
from torchfra.compiler.tangents import tangent
from torchfra.linalg.tracing import elementary
from torchfra.tree import flatten, paths, unflatten


def frozen(module: M, memo: dict[int, nn.Module] | None = None) -> M:
    """A copy that no later change of the module reaches.

    Tensors without a gradient, lists, dictionaries and sets are copied, tensors to the CPU, where traces are made;
    everything else is shared.
    """
    memo = {} if memo is None else memo
    if id(module) not in memo:
        new = memo[id(module)] = module.__new__(type(module))
        new.__dict__.update({key: _copied(x) for key, x in module.__dict__.items()})
        new.__dict__["_buffers"] = {key: _copied(x) for key, x in module._buffers.items()}
        new.__dict__["_modules"] = {key: x and frozen(x, memo) for key, x in module._modules.items()}
    return memo[id(module)]  # type: ignore[return-value]  # a copy of this module


def _copied(x: object) -> Any:
    if isinstance(x, Tensor):
        return x if x.requires_grad else x.detach().cpu().clone()
    return copy.copy(x) if isinstance(x, list | dict | set) else x


def put_in_place(module: nn.Module, path: str, x: Tensor) -> None:
    """Puts a tensor in the place of the parameter, buffer or number of this path."""
    owner, _, key = path.rpartition(".")
    part = module.get_submodule(owner)
    part._parameters.pop(key, None)
    (part.__dict__ if key in part.__dict__ else part._buffers)[key] = x


M = TypeVar("M", bound=nn.Module)
Run = Callable[[Callable[[Sequence[int]], Tensor], Sequence[Tensor]], Sequence[Tensor]]
"""A step: from what draws numbers of a shape and the leaves of a state to those of the next one."""


def staying(run: Run, zero: list[Tensor], dtype: torch.dtype) -> list[Tensor]:
    """Of the entries of a state that are 0 at first those that are 0 after every step: all of them, hardly any other.

    Whatever an expression makes 0 is 0 in numbers too, except for what is not finite: then all that are 0 at first are
    returned.  A trace, which knows for certain, takes tens of times as long.

    Args:
        run: a step in plain numbers.
        zero: which entries are 0 before the first step.
        dtype: of the numbers.
    """
    generator, first = torch.Generator().manual_seed(0), zero

    def draw(shape: Sequence[int]) -> Tensor:
        return 0.1 + 0.8 * torch.rand(torch.Size(shape), dtype=dtype, generator=generator)

    while True:
        leaves = [draw(z.shape).masked_fill(z, 0.0) for z in zero]
        with _BothSides():
            after = run(draw, leaves)
        if any(x.shape != z.shape or not x.isfinite().all() for x, z in zip(after, zero, strict=True)):
            return first
        still = [z & (x == 0) for z, x in zip(zero, after, strict=True)]
        if all(map(torch.equal, still, zero)):
            return zero
        zero = still


class _BothSides(TorchFunctionMode):
    """Inside, a choice is 0 only where both sides are: a step of other numbers may choose the other one."""

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Sequence[type],
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        chosen = func(*args, **(kwargs or {}))
        if func not in (torch.where, Tensor.where) or len(args) < 3:
            return chosen
        mask, yes, no = args if func is torch.where else (args[1], args[0], args[2])
        other = torch.where(mask, no, yes)
        if other.is_floating_point():  # what is infinite is not 0, but would make all that follows no number
            other = torch.where(other.abs() == torch.inf, 0.5, other)
        return torch.where((chosen == 0) & (other == other), other, chosen)


_MOST = 110_000
"""A step of more expressions calls routines: it compiles in half the time and runs 1.2 times as long."""
_ADJOINT = 2.5
"""How many times more expressions a step has with its adjoint, at least: 2.4 to 3.1 (measured, of seven presets)."""
T = TypeVar("T")
Caller = Callable[..., Any] | None
"""How functions marked ``batchwise`` are run; None: like any other."""
Advance = Callable[[Any, Any, dict[str, Any]], tuple[Any, Any]]
"""From a module, its state and its inputs by name to the next state and the record of the step."""


class Input(NamedTuple):
    """An input of a step, for one track."""

    shape: torch.Size
    timed: bool
    """Whether each step has its own value."""
    value: bool
    """Whether it is a parameter, a buffer or a number of the module (its name is then the path), and not data."""
    double: bool = False
    """Whether it is given in double precision to a step in single precision."""


class Trace(NamedTuple):
    """One step of one track, written down as expressions; nothing changes it."""

    book: Expressions
    """All expressions of the step."""
    before: tuple[Entries, ...]
    """Leaves of the state before the step."""
    inputs: dict[str, Entries]
    after: tuple[Entries, ...]
    """Leaves of the state after the step."""
    record: Any
    """What the step returned besides the state: tuples of tensors."""
    kept: tuple[Entries, ...]
    """Leaves of the record."""


class Step:
    """One step of a filter for one track.

    Every trace runs on a copy of the module of its own, so that several threads may trace the same step.

    Args:
        module: the filter; nobody may change it from here on (see ``frozen``).
        begin: the state before the first step, from a module whose values are entries of a book, and that book.
        advance: one step.
        inputs: what each step reads besides the state, by name.
        dtype: of all numbers.
        repeated: whether it is one of many steps, so that records have time in front; or the only one.
        last_first: whether it runs from the last step to the first.

    Raises:
        NotImplementedError: the step uses an operation that kernels do not have.
    """

    def __init__(
        self,
        module: nn.Module,
        begin: Callable[[nn.Module, Expressions], Any],
        advance: Advance,
        inputs: Mapping[str, Input],
        dtype: torch.dtype,
        repeated: bool = True,
        last_first: bool = False,
    ) -> None:
        self.module, self._advance, self.inputs = module, advance, inputs
        self.dtype, self.repeated, self.last_first, self._large = dtype, repeated, last_first, False
        with refusals_of(type(module).__name__), elementary(), torch.no_grad():
            book = Expressions()
            self.state = begin(self.copy_with(self.unknown(book)), book)
        leaves = flatten(self.state)
        if not all(x.is_floating_point() for x in leaves):
            raise NotImplementedError(f"state: kernels carry floating point numbers, received {self.state}")
        zero = [as_entries(Expressions(), x.detach()).ids == ZERO for x in leaves]
        self.zero, self.plain = self._always_zero(self._guessed(zero))
        self.record = self.plain.record

    def unknown(self, book: Expressions) -> dict[str, Entries]:
        """All inputs, of one track."""
        return {name: Entries.inputs(book, x.shape, self.dtype) for name, x in self.inputs.items()}

    def copy_with(self, inputs: Mapping[str, Tensor]) -> nn.Module:
        """A copy of the module that has these values: they may differ between tracks, and be set to others later."""
        module = frozen(self.module)
        for name in (name for name, kind in self.inputs.items() if kind.value):
            put_in_place(module, name, inputs[name])
        return module

    def _guessed(self, zero: list[Tensor]) -> list[Tensor]:
        """Those of the entries that are 0 before the first step that stay 0 in a step of random numbers."""

        def run(draw: Callable[[Sequence[int]], Tensor], leaves: Sequence[Tensor]) -> list[Tensor]:
            inputs = {name: draw(x.shape) for name, x in self.inputs.items()}
            return flatten(self._stepped(inputs, leaves)[0])

        with suppress(Exception), elementary(), torch.no_grad():  # random numbers may be none that the step takes
            return staying(run, zero, self.dtype)
        return zero

    def _stepped(self, inputs: Mapping[str, Tensor], leaves: Sequence[Tensor]) -> tuple[Any, Any]:
        """The next state and the record, from inputs by name and leaves of a state."""
        data = {name: inputs[name] for name, kind in self.inputs.items() if not kind.value}
        return self._advance(self.copy_with(inputs), unflatten(self.state, iter(leaves)), data)

    def _always_zero(self, zero: list[Tensor]) -> tuple[list[Tensor], Trace]:
        """The entries of the state that are 0 before the first step and stay 0, and a trace that knows it."""
        while True:
            trace = self._traced(partial(self._trace, zero))
            self._large = bool(trace.book.calls)
            still = [z & (after.ids == ZERO) for z, after in zip(zero, trace.after, strict=True)]
            if all(map(torch.equal, still, zero)):
                return zero, trace
            zero = still

    def _traced(self, make: Callable[[Expressions, Caller], T], least: float = 0) -> T:
        """``make`` with a new book: without routines if at most ``_MOST`` expressions result, else with them.

        ``least``: as many will result, or more.
        """
        if not self._large and least <= _MOST:
            with suppress(TooManyError):
                return make(Expressions(_MOST), None)
        return make(Expressions(), called_for_each)

    def _trace(
        self, zero: Sequence[Tensor], book: Expressions, caller: Caller = None, differentiable: bool = False
    ) -> Trace:
        before, inputs = carried(book, zero, self.dtype), self.unknown(book)
        if differentiable:
            for x in (*before, *inputs.values()):
                x.requires_grad_()
        name = type(self.module).__name__
        with refusals_of(name), elementary(caller), torch.set_grad_enabled(differentiable):
            state, record = self._stepped(inputs, before)
        after, kept = (tuple(as_entries(book, x) for x in flatten(tree)) for tree in (state, record))
        for kind, leaves in (("", before), ("next.", after)):
            give_all(book, [kind + path for path in _paths(self.state, "state")], leaves)
        give_all(book, list(inputs), list(inputs.values()))
        give_all(book, _paths(record, "record"), kept)
        if [x.shape for x in after] != [x.shape for x in zero]:
            raise ValueError(f"state: expected a step that keeps its form {self.state}, received {state}")
        return Trace(book, before, inputs, after, record, kept)

    def forwards(self, remembers: bool = False) -> Scan:
        """Filters: reads the inputs, writes the record of each step; with ``remembers`` the state before it as well."""
        kept = self._kept_ports(self.plain)
        return self._scan(self.plain, kept + (_nonzero_ports(self.plain.before) if remembers else []))

    def _kept_ports(self, trace: Trace) -> list[Port]:
        kept = ports(trace.kept, timed=self.repeated)
        for port, is_late in zip(kept, late(trace.record), strict=True):
            port.late = is_late and self.repeated
        return kept

    def trajectory(self) -> Scan:
        """Filters again: writes the state before each step."""
        return self._scan(self.plain, _nonzero_ports(self.plain.before))

    def tangent(self, along: Sequence[str]) -> Scan:
        """Filters, and carries derivatives along a direction of the state and of these inputs: see ``tangents``."""
        every = self._trace(self.zero, Expressions()) if self._large else self.plain
        return tangent(
            self._scan(every, self._kept_ports(every)), [k for k, name in enumerate(self.inputs) if name in along]
        )

    def _scan(self, trace: Trace, writes: list[Port]) -> Scan:
        before, after = ports(trace.before), ports(trace.after)
        return Scan(trace.book, before, after, self._reads(trace), writes, self.last_first, self.dtype)

    def _reads(self, trace: Trace) -> list[Port]:
        inputs = self.inputs.items()
        return [Port(entry_ids(trace.inputs[name]), x.shape, x.timed, double=x.double) for name, x in inputs]

    def backwards(self, graded: Sequence[bool], needed: Sequence[str]) -> Scan:
        """The adjoint, which runs the other way.

        Reads the inputs, the state before each step and the gradients of the record, where ``graded``.  Carries the
        gradients of the state and of the ``needed`` inputs without time, and writes those of the inputs with time.
        """
        of = f"{type(self.module).__name__}, gradient of {', '.join(['the state', *needed])}"
        least = _ADJOINT * len(self.plain.book.nodes)
        adjoint = partial(self._traced, partial(self._adjoint, graded, needed), least)
        with gradient_refusals_of(of, adjoint):
            return adjoint()

    def _adjoint(self, graded: Sequence[bool], needed: Sequence[str], book: Expressions, caller: Caller) -> Scan:
        trace = self._trace(self.zero, book, caller, differentiable=True)
        states = len(trace.before)
        rare = self._scan(trace, ports(trace.kept)).regions()
        after = carried(book, self.zero, self.dtype)
        kept = [x for x, wanted in zip(trace.kept, graded, strict=True) if wanted]
        grads = [Entries.inputs(book, x.shape, self.dtype) for x in kept]
        sources = [*trace.before, *(trace.inputs[name] for name in needed)]
        with elementary(caller):
            pulled = pullback(book, [*trace.after, *kept], [*after, *grads], sources)
        stays = [g for g, name in zip(pulled[states:], needed, strict=True) if not self.inputs[name].timed]
        timed = [g for g, name in zip(pulled[states:], needed, strict=True) if self.inputs[name].timed]
        sums = [Entries.inputs(book, g.shape, self.dtype) for g in stays]
        give_all(book, [f"gradient.{path}" for path in _paths(self.state, "state")], after)
        give_all(book, [f"gradient.{name}" for name in needed if not self.inputs[name].timed], sums)
        totals = [as_entries(book, a + b) for a, b in zip(sums, stays, strict=True)]
        return Scan(
            book,
            ports([*after, *sums]),
            ports(pulled[:states] + totals),
            self._reads(trace) + _nonzero_ports(trace.before) + ports(grads, timed=self.repeated),
            ports(timed, timed=True),
            backwards=not self.last_first,
            dtype=self.dtype,
            rare=rare,
        )


def carried(book: Expressions, zero: Sequence[Tensor], dtype: torch.dtype) -> tuple[Entries, ...]:
    """What goes from step to step: unknown, except for the entries that are always 0."""
    new = [Entries.inputs(book, z.shape, dtype).ids for z in zero]
    return tuple(Entries(book, torch.where(z, ZERO, ids), dtype) for z, ids in zip(zero, new, strict=True))


def pullback(
    book: Expressions, outputs: Sequence[Entries], gradients: Sequence[Entries], sources: Sequence[Entries]
) -> list[Entries]:
    """Gradients of the sources, from those of the outputs."""
    follows = [(x, g) for x, g in zip(outputs, gradients, strict=True) if x.requires_grad]
    results, pulls = zip(*follows, strict=True)
    pulled = pulled_back(results, pulls, sources)
    return [as_entries(book, torch.zeros(x.shape) if g is None else g) for x, g in zip(sources, pulled, strict=True)]


def _paths(tree: object, root: str) -> list[str]:
    """Where the tensors of a tree are, for their names."""
    return [f"{root}.{path}".rstrip(".") if path[:4] in ("", "part") else path for path, _ in paths(tree)]


def give_all(book: Expressions, names: Sequence[str], tensors: Sequence[Entries]) -> None:
    """Calls the entries of tensors by their names: see ``names.give``."""
    for name, x in zip(names, tensors, strict=True):
        give(book, name, entry_ids(x), x.dim() == 0)


def ports(tensors: Sequence[Entries], *, timed: bool = False) -> list[Port]:
    """Tensors as a loop reads or writes them; ``timed``: at each step."""
    return [Port(entry_ids(x), x.shape, timed, truth=x.dtype == torch.bool) for x in tensors]


def _nonzero_ports(tensors: Sequence[Entries]) -> list[Port]:
    """Ports without the entries that are always 0."""
    parts = [[i for i in entry_ids(x) if i != ZERO] for x in tensors]
    return [Port(part, torch.Size([len(part)]), timed=True, packed=True) for part in parts]
