"""A filter's step as expressions: traced once for one track, forwards and backwards."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.func import functional_call

from torchfra.kernel.entries import Entries, entries
from torchfra.kernel.expressions import ZERO, Expressions
from torchfra.kernel.source import Port, Scan
from torchfra.linalg import elementary
from torchfra.types import flatten, unflatten

Advance = Callable[[nn.Module, Any, dict[str, Tensor]], tuple[Any, Any]]
"""From a module, its state and what else it is given to the next state and what is kept of the step."""


class Input(NamedTuple):
    """What a step is given, for one track."""

    shape: torch.Size
    timed: bool
    """Whether each step has its own."""
    value: bool
    """Whether it is a parameter or buffer of the module, by its path."""


class _Whole(nn.Module):
    """So that ``functional_call`` can run any function of a module."""

    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        self.module = module

    def forward(self, function: Callable[[nn.Module], Any]) -> Any:
        return function(self.module)


class Step:
    """One step of a filter for one track.

    Args:
        module: the filter.
        begin: the state before the first step, of a module.
        advance: one step.
        inputs: what each step is given, by name.
        dtype: of all numbers.
        repeated: whether it is one of many, and what is kept has time in front; or the only one.
    """

    def __init__(
        self,
        module: nn.Module,
        begin: Callable[[nn.Module], Any],
        advance: Advance,
        inputs: Mapping[str, Input],
        dtype: torch.dtype,
        repeated: bool = True,
    ) -> None:
        self.whole, self.advance, self.inputs = _Whole(module), advance, inputs
        self.dtype, self.repeated = dtype, repeated
        with elementary():
            self.state = begin(module)
        zero = [entries(Expressions(), x).ids == ZERO for x in flatten(self.state)]
        while True:
            self.zero = zero
            self._trace(False)
            zero = [z & (after.ids == ZERO) for z, after in zip(self.zero, self.after, strict=True)]
            if all(map(torch.equal, zero, self.zero)):
                break

    def _call(self, function: Callable[..., Any], given: Mapping[str, Tensor], *args: Any) -> Any:
        values = {f"module.{name}": x for name, x in given.items() if self.inputs[name].value}
        others = {name: x for name, x in given.items() if not self.inputs[name].value}
        with elementary():
            return functional_call(self.whole, values, (lambda module: function(module, *args, others),))

    def _trace(self, differentiable: bool) -> None:
        book = Expressions()
        self.book = book
        self.before = self._carried(book)
        self.given = {name: Entries.inputs(book, x.shape, self.dtype) for name, x in self.inputs.items()}
        if differentiable:
            for x in (*self.before, *self.given.values()):
                x.requires_grad_()
        with torch.set_grad_enabled(differentiable):
            after, kept = self._call(self.advance, self.given, unflatten(self.state, iter(self.before)))
        self.after, self.kept = ([entries(book, x) for x in flatten(tree)] for tree in (after, kept))
        self.form = kept
        if [x.shape for x in self.after] != [zero.shape for zero in self.zero]:
            raise ValueError(f"state: expected a step to keep its form {self.state}, received {after}")

    def _carried(self, book: Expressions) -> list[Entries]:
        """What goes from step to step, nothing known but its zeros."""
        new = [Entries.inputs(book, zero.shape, self.dtype).ids for zero in self.zero]
        return [
            Entries(book, torch.where(zero, ZERO, ids), self.dtype) for zero, ids in zip(self.zero, new, strict=True)
        ]

    def forwards(self) -> Scan:
        """Filters: reads the inputs, writes what is kept of each step."""
        self._trace(False)
        return self._scan(_ports(self.kept, timed=self.repeated))

    def trajectory(self) -> Scan:
        """Filters again: writes the state before each step."""
        self._trace(False)
        return self._scan(_varying(self.before))

    def _scan(self, writes: list[Port]) -> Scan:
        return Scan(self.book, _ports(self.before), _ports(self.after), self._reads(), writes, dtype=self.dtype)

    def _reads(self) -> list[Port]:
        return [Port(_ids(self.given[name]), x.shape, x.timed) for name, x in self.inputs.items()]

    def backwards(self, graded: Sequence[bool], needed: Sequence[str]) -> Scan:
        """The adjoint, from the last step to the first.

        Reads the inputs, the state before each step and the gradients of what was kept, where ``graded``.  Carries the
        gradients of the state and of the ``needed`` inputs that stay, and writes those of the inputs with time.
        """
        self._trace(True)
        book, states = self.book, len(self.before)
        after = self._carried(book)
        kept = [x for x, wanted in zip(self.kept, graded, strict=True) if wanted]
        grads = [Entries.inputs(book, x.shape, self.dtype) for x in kept]
        follows = [(x, g) for x, g in zip(self.after + kept, after + grads, strict=True) if x.requires_grad]
        ends, pulls = zip(*follows, strict=True)
        sources = self.before + [self.given[name] for name in needed]
        with elementary():
            pulled = torch.autograd.grad(ends, sources, pulls, allow_unused=True)
        found = [entries(book, torch.zeros(x.shape) if g is None else g) for x, g in zip(sources, pulled, strict=True)]
        stays = [g for g, name in zip(found[states:], needed, strict=True) if not self.inputs[name].timed]
        timed = [g for g, name in zip(found[states:], needed, strict=True) if self.inputs[name].timed]
        sums = [Entries.inputs(book, g.shape, self.dtype) for g in stays]
        totals = [entries(book, a + b) for a, b in zip(sums, stays, strict=True)]
        return Scan(
            book,
            _ports(after + sums),
            _ports(found[:states] + totals),
            self._reads() + _varying(self.before) + _ports(grads, timed=self.repeated),
            _ports(timed, timed=True),
            backwards=True,
            dtype=self.dtype,
        )


def _ids(x: Entries) -> list[int]:
    ids: list[int] = x.ids.flatten().tolist()
    return ids


def _ports(tensors: Sequence[Entries], *, timed: bool = False) -> list[Port]:
    return [Port(_ids(x), x.shape, timed, truth=x.dtype == torch.bool) for x in tensors]


def _varying(tensors: Sequence[Entries]) -> list[Port]:
    """Without the entries that are 0 always."""
    parts = [[i for i in _ids(x) if i != ZERO] for x in tensors]
    return [Port(part, torch.Size([len(part)]), timed=True, packed=True) for part in parts]
