"""Around the steps of whole tracks: the first state, from a prior, and what the last step leaves open."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from torchfra.kernel.entries import Entries, as_entries, entry_ids
from torchfra.kernel.expressions import Expressions
from torchfra.kernel.refusals import refusals_of
from torchfra.kernel.source import Port, Scan
from torchfra.kernel.statements import threaded
from torchfra.kernel.step import Step, carried
from torchfra.linalg.tracing import elementary
from torchfra.tree import flatten, map_tensors, unflatten


class Ends:
    """The two ends of a track, traced once like the step between them.

    Args:
        step: one of many.
        begin: the state before the first, from the module and the mean and any root of a prior.
        finish: what becomes of the records of all steps, from the module, the state after the last and the records.
        size: of a state.
        each: whole numbers that every track is given besides.

    Raises:
        NotImplementedError: an operation that kernels do not have; or ``finish`` does more than to end what is late.
    """

    def __init__(
        self, step: Step, begin: Callable[..., Any], finish: Callable[[Any, Any, Any], Any], size: int,
        each: Sequence[int] = (),
    ) -> None:  # fmt: skip
        self._step, self._book, self.each = step, Expressions(), each
        inputs = step.unknown(self._book)
        module = step.copy_with(inputs)
        prior = [Entries.inputs(self._book, shape, step.dtype) for shape in ((size,), (size, size))]
        after = carried(self._book, step.zero, step.dtype)
        steps = map_tensors(self._two_steps, step.record)
        with refusals_of(type(module).__name__), elementary(), torch.no_grad():
            begun = [entry_ids(as_entries(self._book, x)) for x in flatten(begin(module, *prior))]
            self.made = finish(module, unflatten(step.state, iter(after)), steps)
        self.values = [k for k, kind in enumerate(step.inputs.values(), len(begun)) if kind.value]
        self.sizes, self.same = list(map(len, begun)), list(map(begun.index, begun))
        self._begun = [ids if k == same else [] for k, (ids, same) in enumerate(zip(begun, self.same, strict=True))]
        self._matched([entry_ids(as_entries(self._book, x)) for x in flatten(steps)], 2 * len(self.sizes) + len(inputs))
        values = [entry_ids(x) if step.inputs[name].value else [] for name, x in inputs.items()]
        nothing: list[list[int]] = [[]]
        states = [entry_ids(x) for x in after]
        self._reads = [*nothing * len(states), *values, *states, *nothing * len(flatten(steps)), *map(entry_ids, prior)]

    def _two_steps(self, like: Tensor) -> Tensor:
        """Unknown, of two steps."""
        unknown = Entries.inputs(self._book, (2, *like.shape), self._step.dtype)
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
        self.settled: dict[int, tuple[list[int], bool]] = {}
        for x in flatten(self.made):
            now, then = _halves(entry_ids(as_entries(self._book, x)))
            place = next((k for k, half in enumerate(halves) if now and now in half), None)
            if place is None or (now == halves[place][0]) != (then == halves[place][1]):
                raise NotImplementedError("compile: finish does more than to end what comes late")
            if now == halves[place][1]:
                self.settled[first + place] = then, x.dtype == torch.bool
            self.places.append(place)

    def source(self, narrow: bool, looks: Sequence[int] = (3, 0, 1)) -> str:
        """The translation unit, whose function is ``whole``.

        Args:
            narrow: as of ``Scan.source``.
            looks: numbers of the tensors that say whether all is finite: the scores of all steps, others of the last.
        """
        step, states = self._step, len(self.sizes)
        double = [*[False] * states, *(x.double for x in step.inputs.values())]
        reads = [_port(ids, double=any(double[k : k + 1])) for k, ids in enumerate(self._reads)]
        after = states + len(step.inputs)
        first = after + states
        last = [_port(ids, truth=truth) for ids, truth in self.settled.values()]
        begin = Scan(self._book, [], [], reads, list(map(_port, self._begun)), dtype=step.dtype)
        finish = Scan(self._book, [], [], reads, [*[_port([])] * len(reads), *last], dtype=step.dtype)
        (head, started), (_, finished) = begin.parts(narrow, "begin"), finish.parts(narrow, "finish")
        looked = [first + self.places[k] for k in looks]
        made, prior, end = flatten(self.made), len(reads) - 2, len(reads) + len(last)
        given = [range(prior, len(reads)), range(states, after), range(first, prior), range(end, end + len(self.each))]
        words: dict[str, Iterable[Any]] = {
            "STATES": [*range(states), *range(after, first)],
            "GIVEN": itertools.chain(*given),
            "SETTLED": [*self.settled, -1],
            "SIZES": [*(1 if port.truth else "sizeof(Scalar)" for port in last), 0],
            "LOOKS": (2 * port + (port in self.settled) for port in looked),
            "NUMBERS": (made[k].numel() // 2 for k in looks),
            "EACH": [*self.each, 0],
            "AFTER": [after],
            "LAST": [len(reads)],
            "PORTS": [end + len(self.each)],
        }
        text = threaded("ends.cpp")
        for word, numbers in words.items():
            text = text.replace(word, ", ".join(map(str, numbers)))
        return f"{head}{started}{finished}{text}"


def _halves(ids: list[int]) -> tuple[list[int], list[int]]:
    """Entries of the first of two steps, and of the second."""
    return ids[: len(ids) // 2], ids[len(ids) // 2 :]


def _port(ids: list[int], truth: bool = False, double: bool = False) -> Port:
    return Port(ids, torch.Size([len(ids)]), truth=truth, double=double)
