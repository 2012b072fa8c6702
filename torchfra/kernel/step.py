"""A filter's step as expressions: traced once for one track, forwards and backwards."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torchfra.kernel.entries import Entries, entries
from torchfra.kernel.expressions import ZERO, Expressions
from torchfra.kernel.source import Port, Scan
from torchfra.linalg.tracing import elementary
from torchfra.tree import flatten, unflatten

Advance = Callable[[Any, Any, dict[str, Any]], tuple[Any, Any]]
"""From a module, its state and what else it is given to the next state and what is kept of the step."""


class Input(NamedTuple):
    """What a step is given, for one track."""

    shape: torch.Size
    timed: bool
    """Whether each step has its own."""
    value: bool
    """Whether it is a parameter, a buffer or a number of the module, by its path."""


def frozen(module: nn.Module, memo: dict[int, nn.Module] | None = None) -> nn.Module:
    """A copy that nobody else changes; what is neither a tensor nor a list, dictionary or set is shared."""
    memo = {} if memo is None else memo
    if id(module) not in memo:
        new = memo[id(module)] = module.__new__(type(module))
        new.__dict__.update({key: _held(x) for key, x in module.__dict__.items()})
        new.__dict__["_buffers"] = {key: _held(x) for key, x in module._buffers.items()}
        new.__dict__["_modules"] = {key: x and frozen(x, memo) for key, x in module._modules.items()}
    return memo[id(module)]


def _held(x: Any) -> Any:
    if isinstance(x, Tensor):
        return x if x.requires_grad else x.detach().clone()
    return copy.copy(x) if isinstance(x, list | dict | set) else x


def _put(module: nn.Module, path: str, x: Tensor) -> None:
    """In the place of the parameter, buffer or number of this path."""
    owner, _, key = path.rpartition(".")
    part = module.get_submodule(owner)
    part._parameters.pop(key, None)
    (part.__dict__ if key in part.__dict__ else part._buffers)[key] = x


class Step:
    """One step of a filter for one track.

    Args:
        module: the filter, of this step alone (see ``frozen``).
        begin: the state before the first step, of a module.
        advance: one step.
        inputs: what each step is given, by name.
        dtype: of all numbers.
        repeated: whether it is one of many, and what is kept has time in front; or the only one.

    Raises:
        NotImplementedError: it does what has no form for single entries.
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
        self.module, self.advance, self.inputs = module, advance, inputs
        self.dtype, self.repeated = dtype, repeated
        with elementary(), torch.no_grad():
            self.state = begin(module)
        leaves = flatten(self.state)
        if not all(x.is_floating_point() for x in leaves):
            raise NotImplementedError(f"state: kernels carry floating point numbers, received {self.state}")
        zero = [entries(Expressions(), x.detach()).ids == ZERO for x in leaves]
        while True:
            self.zero = zero
            self._trace(False)
            zero = [z & (after.ids == ZERO) for z, after in zip(self.zero, self.after, strict=True)]
            if all(map(torch.equal, zero, self.zero)):
                break

    def _trace(self, differentiable: bool) -> None:
        book = self.book = Expressions()
        self.before = self._carried(book)
        self.given = {name: Entries.inputs(book, x.shape, self.dtype) for name, x in self.inputs.items()}
        if differentiable:
            for x in (*self.before, *self.given.values()):
                x.requires_grad_()
        for name, given in self.inputs.items():
            if given.value:
                _put(self.module, name, self.given[name])
        data = {name: self.given[name] for name, given in self.inputs.items() if not given.value}
        with elementary(), torch.set_grad_enabled(differentiable):
            after, kept = self.advance(self.module, unflatten(self.state, iter(self.before)), data)
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
