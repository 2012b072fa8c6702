"""A filter's step as expressions: traced once for one track, forwards and backwards."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.utils._pytree import tree_flatten, tree_unflatten

from torchfra.kernel.entries import Entries, entries
from torchfra.kernel.expressions import ZERO, Expressions
from torchfra.kernel.source import Port, Scan
from torchfra.linalg import elementary

Advance = Callable[[nn.Module, Any, dict[str, Tensor]], tuple[Any, Any]]
"""From a module, its state and what else it is given to the next state and what is kept of the step."""


def flatten(tree: Any) -> tuple[list[Tensor], Any]:
    """The tensors in a tree, and its form without them; None stays in the form."""
    leaves, spec = tree_flatten(tree)
    return [x for x in leaves if x is not None], (spec, tuple(x is None for x in leaves))


def unflatten(tensors: Sequence[Tensor], form: Any) -> Any:
    """The tree of this form."""
    spec, nothing = form
    rest = iter(tensors)
    return tree_unflatten([None if x else next(rest) for x in nothing], spec)


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
    """

    def __init__(
        self,
        module: nn.Module,
        begin: Callable[[nn.Module], Any],
        advance: Advance,
        inputs: Mapping[str, Input],
        dtype: torch.dtype,
    ) -> None:
        self.whole, self.begin, self.advance, self.inputs, self.dtype = _Whole(module), begin, advance, inputs, dtype
        with elementary():
            leaves, self.state = flatten(begin(module))
        zero = [entries(Expressions(), x).ids == ZERO for x in leaves]
        while True:
            self.zero = zero
            self._trace(False)
            zero = [z & (after.ids == ZERO) for z, after in zip(self.zero, self.after, strict=True)]
            if all(map(torch.equal, zero, self.zero)):
                break
        self.state_shapes = [z.shape for z in self.zero]
        self.kept_like = [(x.shape, x.dtype) for x in self.kept]
        self.state_dtypes = [x.dtype for x in self.after]

    def _call(self, function: Callable[..., Any], book: Expressions, given: dict[str, Tensor], *args: Any) -> Any:
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
            after, kept = self._call(self.advance, book, self.given, unflatten(self.before, self.state))
        leaves, spec = flatten(after)
        if spec != self.state:
            raise ValueError(f"state: expected a step to keep its form {self.state}, it became {spec}")
        self.after = [entries(book, x) for x in leaves]
        leaves, self.kept_form = flatten(kept)
        self.kept = [entries(book, x) for x in leaves]

    def _carried(self, book: Expressions) -> list[Entries]:
        """What goes from step to step, nothing known but its zeros."""
        new = [Entries.inputs(book, zero.shape, self.dtype).ids for zero in self.zero]
        return [Entries(book, torch.where(zero, ZERO, ids), self.dtype) for zero, ids in zip(self.zero, new, strict=True)]

    def forwards(self) -> Scan:
        """Filters: reads the inputs, writes what is kept of each step."""
        self._trace(False)
        return Scan(self.book, _ports(self.before), _ports(self.after), self._reads(), _written(self.kept), dtype=self.dtype)

    def trajectory(self) -> Scan:
        """Filters again: writes the state before each step."""
        self._trace(False)
        written = [Port(_varying(x)) for x in self.before]
        return Scan(self.book, _ports(self.before), _ports(self.after), self._reads(), written, dtype=self.dtype)

    def backwards(self, graded: Sequence[bool], needed: Sequence[str]) -> Scan:
        """The adjoint.

        Reads the inputs, the state before each step and the gradients of what was kept, where ``graded``; carries the
        gradient of the state and of the ``needed`` inputs without time; writes that of those with time.
        """
        self._trace(True)
        book = self.book
        after = self._carried(book)
        kept = [Entries.inputs(book, x.shape, self.dtype) for x, g in zip(self.kept, graded, strict=True) if g]
        outputs = self.after + [x for x, g in zip(self.kept, graded, strict=True) if g]
        pairs = [(x, g) for x, g in zip(outputs, after + kept, strict=True) if x.requires_grad]
        sources = self.before + [self.given[name] for name in needed]
        with elementary():
            found = torch.autograd.grad([x for x, _ in pairs], sources, [g for _, g in pairs], allow_unused=True)
        grads = [entries(book, torch.zeros(x.shape) if g is None else g) for x, g in zip(sources, found, strict=True)]
        states = len(self.before)
        fixed = [g for g, name in zip(grads[states:], needed, strict=True) if not self.inputs[name].timed]
        sums = [Entries.inputs(book, g.shape, self.dtype) for g in fixed]
        timed = [g for g, name in zip(grads[states:], needed, strict=True) if self.inputs[name].timed]
        return Scan(
            book,
            _ports(after + sums),
            _ports(grads[:states]) + [Port([book.apply("add", a, b) for a, b in zip(_ids(s), _ids(g), strict=True)])
                                      for s, g in zip(sums, fixed, strict=True)],
            [*self._reads(), *(Port(_varying(x), timed=True, packed=True) for x in self.before),
             *(Port(_ids(x), timed=True) for x in kept)],
            _written(timed),
            backwards=True,
            dtype=self.dtype,
        )  # fmt: skip

    def _reads(self) -> list[Port]:
        return [Port(_ids(self.given[name]), timed=x.timed) for name, x in self.inputs.items()]


def _ids(x: Entries) -> list[int]:
    ids: list[int] = x.ids.flatten().tolist()
    return ids


def _varying(x: Entries) -> list[int]:
    return [i for i in _ids(x) if i != ZERO]


def _ports(tensors: Sequence[Entries]) -> list[Port]:
    return [Port(_ids(x)) for x in tensors]


def _written(tensors: Sequence[Entries]) -> list[Port]:
    return [Port(_ids(x), truth=x.dtype == torch.bool) for x in tensors]
