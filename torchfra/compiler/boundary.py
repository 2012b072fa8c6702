"""Around the steps of whole tracks: the first state, from a prior, and what the last step leaves open.

Behind it the gradients of both.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfra.compiler.entries import Entries, as_entries, entry_ids
from torchfra.compiler.expressions import Expressions
from torchfra.compiler.origin import refusals_of
from torchfra.compiler.source import Port, Scan
from torchfra.compiler.step import Step, carried, ports, pullback
from torchfra.linalg.tracing import elementary
from torchfra.linalg.triangular import tria
from torchfra.steps.loop import finish
from torchfra.tree import flatten, map_tensors, unflatten
from torchfra.types import Estimate, Gaussian

PRIOR = ("mean of the prior", "root of the prior")
LAST = "state after the last step"
"""Names that no input has, whose names are paths."""


class Traced(NamedTuple):
    """What comes before and after the steps of a track, on entries of one book."""

    book: Expressions
    inputs: dict[str, Entries]
    prior: list[Entries]
    begun: list[Entries]
    after: tuple[Entries, ...]
    steps: object
    """The records of two steps."""
    made: Estimate
    """What becomes of them."""


class Boundary:
    """What comes before the first step of a track and after its last, traced once like the step between them.

    Before it is the state of a prior with any root; after it an estimate, from what has been kept of each step.

    Args:
        step: one of many.

    Raises:
        NotImplementedError: an operation that kernels do not have; or an estimate that is more than the records and
            decisions that come one step late.
    """

    def __init__(self, step: Step) -> None:
        self.step = step
        at = self.traced()
        begun, self.made = [entry_ids(x) for x in at.begun], at.made
        self.book, self.values = at.book, [k for k, kind in enumerate(step.inputs.values(), len(begun)) if kind.value]
        self.sizes, self.same = list(map(len, begun)), list(map(begun.index, begun))
        self.begun = [ids if k == same else [] for k, (ids, same) in enumerate(zip(begun, self.same, strict=True))]
        steps = [entry_ids(as_entries(at.book, x)) for x in flatten(at.steps)]
        self._matched(steps, 2 * len(self.sizes) + len(at.inputs))
        values = [entry_ids(x) if step.inputs[name].value else [] for name, x in at.inputs.items()]
        nothing: list[list[int]] = [[]]
        states = [entry_ids(x) for x in at.after]
        self.reads = [*nothing * len(states), *values, *states, *nothing * len(steps)]
        self.prior = list(map(entry_ids, at.prior))

    def traced(self, *differentiable: str) -> Traced:
        """Both parts on entries of a new book, which have derivatives in what is named.

        That is inputs by name, those of the ``PRIOR``, and ``LAST``, the state after the last step.
        """
        book, step = Expressions(), self.step
        inputs = step.unknown(book)
        module: Any = step.copy_with(inputs)
        prior = [Entries.inputs(book, (module.motion.size,) * event, step.dtype) for event in (1, 2)]
        after = carried(book, step.zero, step.dtype)
        for name, tensors in [
            *((n, [x]) for n, x in inputs.items()),
            (PRIOR[0], prior[:1]),
            (PRIOR[1], prior[1:]),
            (LAST, after),
        ]:
            for x in tensors if name in differentiable else ():
                x.requires_grad_()
        steps = map_tensors(partial(self._two_steps, book), step.record)
        with refusals_of(type(module).__name__), elementary(), torch.set_grad_enabled(bool(differentiable)):
            begun = [as_entries(book, x) for x in flatten(module.begin(Gaussian(prior[0], tria(prior[1]))))]
            made = finish(module, unflatten(step.state, iter(after)), steps)
        return Traced(book, inputs, prior, begun, after, steps, made)

    def _two_steps(self, book: Expressions, like: Tensor) -> Tensor:
        """Unknown, of two steps."""
        unknown = Entries.inputs(book, (2, *like.shape), self.step.dtype)
        return unknown < 0 if like.dtype == torch.bool else unknown

    def _matched(self, steps: Sequence[list[int]], first: int) -> None:
        """Finds which leaf of the records each tensor is that is made, and what ends those that come a step late.

        Args:
            steps: entries of the leaves, of two steps.
            first: the number of the port of the first leaf.

        Raises:
            NotImplementedError: a tensor is none of the leaves.
        """
        halves = [_halves(ids) for ids in steps]
        self.places: list[int] = []
        self.late: dict[int, tuple[list[int], bool]] = {}
        for x in flatten(self.made):
            now, then = _halves(entry_ids(as_entries(self.book, x)))
            place = next((k for k, half in enumerate(halves) if now and now in half), None)
            if place is None or (now == halves[place][0]) != (then == halves[place][1]):
                raise NotImplementedError(
                    "compile: expected a finish that only appends decisions one step late, received another"
                )
            if now == halves[place][1]:
                self.late[first + place] = then, x.dtype == torch.bool
            self.places.append(place)


def _halves(ids: list[int]) -> tuple[list[int], list[int]]:
    """Entries of the first of two steps, and of the second."""
    return ids[: len(ids) // 2], ids[len(ids) // 2 :]


def after_back(boundary: Boundary, needed: Sequence[str], graded: Sequence[int]) -> Scan | None:
    """From the gradients of what ends the records ``graded`` to those of the last state and of ``needed`` inputs.

    Reads the values among the inputs, the last state and the gradients.  None where that is nothing.
    """
    if not graded:
        return None
    at = boundary.traced(LAST, *needed)
    made = dict(zip(boundary.places, flatten(at.made), strict=True))
    last = [as_entries(at.book, made[place][1]) for place in graded]
    grads = [Entries.inputs(at.book, x.shape, boundary.step.dtype) for x in last]
    sources = [*at.after, *(at.inputs[name] for name in needed)]
    if not any(x.requires_grad for x in last):
        return None
    with elementary():
        pulled = pullback(at.book, last, grads, sources)
    return _scan(boundary, at, [*at.after, *grads], pulled)


def begin_back(boundary: Boundary, needed: Sequence[str], prior: Sequence[str]) -> Scan | None:
    """From the gradients of the first state to those of ``prior`` (out of ``PRIOR``) and ``needed`` inputs.

    Reads the values among the inputs, the prior, the gradients of the state and what is known already of those of the
    inputs, to which it adds.  None where none of them matters to the first state.
    """
    at = boundary.traced(*prior, *needed)
    if not any(x.requires_grad for x in at.begun):
        return None
    grads = [Entries.inputs(at.book, x.shape, boundary.step.dtype) for x in at.begun]
    sums = [Entries.inputs(at.book, at.inputs[name].shape, boundary.step.dtype) for name in needed]
    chosen = [x for name, x in zip(PRIOR, at.prior, strict=True) if name in prior]
    count, sources = len(chosen), [*chosen, *(at.inputs[name] for name in needed)]
    with elementary():
        pulled = pullback(at.book, at.begun, grads, sources)
    totals = [as_entries(at.book, a + b) for a, b in zip(sums, pulled[count:], strict=True)]
    return _scan(boundary, at, [*at.prior, *grads, *sums], [*pulled[:count], *totals])


def _scan(boundary: Boundary, at: Traced, reads: Sequence[Entries], writes: Sequence[Entries]) -> Scan:
    """A loop of one step, which reads the values among the inputs first."""
    inputs = boundary.step.inputs.items()
    values = [Port(entry_ids(at.inputs[name]), x.shape, double=x.double) for name, x in inputs if x.value]
    return Scan(at.book, [], [], [*values, *ports(reads)], ports(writes), dtype=boundary.step.dtype)
