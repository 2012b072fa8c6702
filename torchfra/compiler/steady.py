"""A long track whose covariance has converged: from there on its steps compute the rest alone.

In a linear filter with one time step and one noise the root of the covariance follows from the root before it alone.
Once it comes back, bit for bit, to one that it has had, and differed by rounding alone between, with nothing missing,
it would stay within its own rounding for ever.  So it is a constant from there on, and so are gains, until something is
missing or changes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import chain
from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.compiler.entries import entry_ids
from torchfra.compiler.expressions import ZERO, Expressions
from torchfra.compiler.forms import late
from torchfra.compiler.schedule import cost
from torchfra.compiler.source import Port, Scan
from torchfra.compiler.step import Input, Step, Trace, ports

_SHARE = 0.5
"""Cost of what still changes, as a share of that of a whole step, up to which it has a kernel of its own."""
_FIRST = 64
"""Whole steps before the first look at whether something has converged; each further look is after twice as many."""
_MOST = 8
"""A track runs so only if at most one of so many steps is whole."""
_FLICKER = 16
"""Changes in units of rounding up to which what has converged may go round in circles."""
_BLOCK = 1 << 12
"""Steps of an input that are compared at once, so that it comes from memory once."""

Run = Callable[[str, int, int, Sequence[Tensor]], list[Tensor]]
"""Runs the steps ``"whole"`` or ``"steady"`` from one number to another, from leaves of a state to those after."""


class Steady(NamedTuple):
    """A step after a part of its state has converged, while nothing is missing."""

    scan: Scan
    """Carries what still changes; what has converged it reads as leaves of the state, before all else."""
    masks: list[Tensor]
    """Which entries of the state have converged."""
    seen: list[tuple[int, list[int]]]
    """Where these are in what a step writes: of some leaves the number, and entries."""
    constant: frozenset[str]
    """Inputs with a value for each step that must not change."""


def steady(step: Step) -> Steady | None:
    """The step after all has converged that depends on no measurement; None if that saves less than half of it."""
    trace = step.plain
    if trace.book.calls or any(late(trace.record)):
        return None
    constant = frozenset(name for name, x in step.inputs.items() if x.timed and _may_stay(name, x, step.last_first))
    moving = {i for name, x in step.inputs.items() if x.timed and name not in constant for i in _ids(trace, name)}
    known = {i: 1.0 for i, (op, args) in enumerate(trace.book.nodes) if op == "eq" and args[0] == args[1] in moving}
    if step.last_first:  # the step at which it begins is none of these
        known |= dict.fromkeys(_ids(trace, "last"), 0.0)
    book, new = _assuming(trace.book, known)
    trees = trace.before, trace.after, trace.kept
    before, after, kept = ([[new[i] for i in entry_ids(x)] for x in leaves] for leaves in trees)
    pairs = {i: j for olds, news in zip(before, after, strict=True) for i, j in zip(olds, news, strict=True) if i}
    changing = _changing(book, pairs, {new[i] for i in moving} - book.values.keys())
    rest = pairs.keys() - changing
    places = {i: (k, e) for k, ids in enumerate(kept) for e, i in enumerate(ids)}
    live = book.needed([*pairs.values(), *chain(*kept)])
    if (
        not rest
        or any(pairs[i] not in places for i in rest)
        or cost(book, changing.intersection(live)) > _SHARE * cost(trace.book, _live(trace))
    ):
        return None
    state = ports(trace.before)
    carry = [Port([i if i in changing else ZERO for i in ids], x.shape) for ids, x in zip(before, state, strict=True)]
    moved = [Port([pairs.get(i, ZERO) for i in x.ids], x.shape) for x in carry]
    stays = [Port([i if i in rest else ZERO for i in ids], x.shape) for ids, x in zip(before, state, strict=True)]
    reads = [
        Port([new[i] for i in _ids(trace, name)], x.shape, x.timed and name not in constant, double=x.double)
        for name, x in step.inputs.items()
    ]
    writes = ports(trace.kept, timed=True)
    for port, ids in zip(writes, kept, strict=True):
        port.ids = ids
    masks = [torch.tensor([i != ZERO for i in x.ids]).reshape(x.shape) for x in stays]
    seen = [places[pairs[i]] for i in rest]
    leaves = sorted({k for k, _ in seen})
    return Steady(
        Scan(book, carry, moved, stays + reads, writes, step.last_first, step.dtype),
        masks, [(k, [e for leaf, e in seen if leaf == k]) for k in leaves], constant,
    )  # fmt: skip


def _may_stay(name: str, x: Input, backwards: bool) -> bool:
    """Whether an input of each step may be the same for many: no measurement, and of a past the roots alone."""
    return len(x.shape) > 1 or name == "dt" if backwards else name in ("dt", "std", "noise")


def _ids(trace: Trace, name: str) -> list[int]:
    return entry_ids(trace.inputs[name])


def _live(trace: Trace) -> list[int]:
    return trace.book.needed(i for x in (*trace.after, *trace.kept) for i in entry_ids(x))


def _assuming(book: Expressions, known: Mapping[int, float]) -> tuple[Expressions, dict[int, int]]:
    """The expressions where the values of some are known, in a book of their own, and their numbers there."""
    made, new = Expressions(), dict[int, int]()
    for i, (op, args) in enumerate(book.nodes):
        value = known.get(i, book.values.get(i))
        if value is not None:
            new[i] = made.constant(value)
        else:
            new[i] = made.input() if op == "input" else made.apply(op, *(new[arg] for arg in args))
    return made, new


def _changing(book: Expressions, pairs: Mapping[int, int], moving: Collection[int]) -> set[int]:
    """All that depends on what is ``moving``; ``pairs``: of the state before a step, with what takes its place."""
    begun = {*moving}
    while True:
        changing = {*begun}
        for i, (_, args) in enumerate(book.nodes):
            if changing.intersection(args):
                changing.add(i)
        more = {i for i, j in pairs.items() if j in changing} - begun
        if not more:
            return changing
        begun |= more


class Track:
    """One long track, some of whose steps are whole and the others steady; they are counted in the order they run in.

    Args:
        step: of a filter, or of its backward pass.
        made: the same after it has converged.
        steps: how many.
        inputs: of the track, without a batch, in the order of the step's own.
        written: leaves of what is kept of all steps, time in front; ``run`` fills them.
        run: see there.
    """

    def __init__(
        self, step: Step, made: Steady, steps: int, inputs: Sequence[Tensor], written: Sequence[Tensor], run: Run
    ) -> None:
        self.made, self.steps, self.written, self.run, self.backwards = made, steps, written, run, step.last_first
        broken = torch.zeros(steps, dtype=torch.bool)
        for (name, kind), x in zip(step.inputs.items(), inputs, strict=True):
            if kind.timed and name in made.constant:
                _mark_changes(x, broken, self.backwards)
            elif kind.timed:
                broken |= x.isnan().flatten(1).any(-1) if x.dim() > 1 else x.isnan()
        self.breaks = (broken.flip(0) if self.backwards else broken).nonzero().flatten()

    def __call__(self, state: Sequence[Tensor]) -> list[Tensor] | None:
        """Leaves of the state after all steps; None if too many steps would have to be whole."""
        at = begun = whole = 0
        wait, now = _FIRST, [*state]
        while at < self.steps:
            if (whole + self._whole(at, wait)) * _MOST > self.steps:
                return None
            stop = min(at + max(_FIRST, at - begun), self.steps)
            now, whole, at = self.run("whole", at, stop, now), whole + stop - at, stop
            begun = max(begun, self._last_break(at))
            if not self._has_converged(begun, at):
                wait = max(wait, self._left(begun, at))
                continue
            wait, end = at - begun, self._next_break(at)
            if at < end:
                at, begun, now = end, end, self.run("steady", at, end, now)
        return now

    def _whole(self, at: int, wait: int) -> int:
        """How many steps are whole from step ``at`` on if it takes so many after each break to converge."""
        edges = torch.tensor([at]), self.breaks[self.breaks > at], torch.tensor([self.steps])
        return int(torch.cat(edges).diff().clamp(max=wait).sum())

    def _last_break(self, at: int) -> int:
        """The last step before this one at which something was missing or had changed; 0 if there is none."""
        k = int(torch.searchsorted(self.breaks, at))
        return int(self.breaks[k - 1]) if k else 0

    def _next_break(self, at: int) -> int:
        k = int(torch.searchsorted(self.breaks, at))
        return int(self.breaks[k]) if k < len(self.breaks) else self.steps

    def _has_converged(self, first: int, behind: int) -> bool:
        """Whether what converges is after step ``behind - 1`` as it was after another one, from ``first`` on.

        Between the two it may differ by rounding alone, in the last half of an entry's digits or beside the largest
        entry: a covariance may also go round and round.
        """
        rows = self._rows(first, behind)
        same = (rows[:-1] == rows[-1]).all(-1).nonzero()
        if not len(same):
            return False
        since, rounding = rows[int(same[-1]) :], torch.finfo(rows.dtype).eps
        size = rows.abs().amax(0)
        allowed = rounding**0.5 * size + _FLICKER * rounding * size.max()
        return bool((since.amax(0) - since.amin(0) <= allowed).all())

    def _left(self, first: int, behind: int) -> int:
        """How many more steps it will change, by how much less it does at the last step than in the middle."""
        count = behind - first
        if count < _FIRST // 2:
            return 0  # there is too little to tell
        rows = self._rows(first, behind)
        change = ((rows[1:] - rows[:-1]).abs() / rows.abs().amax(0)).nan_to_num(nan=0.0).amax(-1).double()
        middle, end = float(change[count // 2]), float(change[-1])
        rounding = torch.finfo(rows.dtype).eps
        if end <= _FLICKER * rounding:
            return 0
        if end >= middle:
            return self.steps
        return int((len(change) - 1 - count // 2) * math.log(end / rounding) / math.log(middle / end))

    def _rows(self, first: int, behind: int) -> Tensor:
        """``(steps, entries)`` what converges, after each of these steps, in the order in which they run."""
        start = self.steps - behind if self.backwards else first
        parts = [self.written[k].narrow(0, start, behind - first).flatten(1)[:, at] for k, at in self.made.seen]
        rows = torch.cat(parts, 1)
        return rows.flip(0) if self.backwards else rows


def _mark_changes(x: Tensor, broken: Tensor, backwards: bool) -> None:
    """Marks the steps at which an input is not as at the step that runs before."""
    for first in range(0, len(x) - 1, _BLOCK):
        part = x[first : first + _BLOCK + 1]
        if not torch.equal(part[1:], part[:-1]):
            differs = (part[1:] != part[:-1]).flatten(1).any(-1) if x.dim() > 1 else part[1:] != part[:-1]
            broken[first + 1 - backwards : first + len(part) - backwards] |= differs
