"""How a step is computed: in which pieces, with which values where, and what is written behind what."""

from __future__ import annotations

from collections import defaultdict

from torchfra.compiler.access import Access, Step
from torchfra.compiler.frame import frame
from torchfra.compiler.merges import with_merged
from torchfra.compiler.schedule import Piece, cut, guarded_share, pieces

_PACKS, _BYTES = 32, 3 << 17
"""Packs of a block at most, and bytes of their values: a part of the second cache."""


class Plan:
    """How a step is computed.

    Args:
        step: the step.
        narrow: whether for one track.
        length: expressions of a function, about; None for what suits a CPU.

    Attributes:
        step: the step.
        book: the expressions.
        before: pieces that are computed once.
        steps: those of each step.
        frame: where values lie.
        merged: results of regions, and the choices in whose places they are put.
        guarded: what of a step only some tracks need, as a share of its cost.
        many: whether packs of tracks share regions.
        packs: of a block of tracks at most.
        unread: places of values that are carried but that no step reads.
        next: state that a region completes at the end of a step: by its number, that of the old state of the next one,
            which writes it.
        behind: by the expression behind which it is done, what is written, and where.
    """

    def __init__(self, step: Step, narrow: bool, length: int | None = None) -> None:
        self.step, self.book = step, step.book
        live = [i for i in step.live if i not in self.book.values and i not in step.carried]
        self.before = [Piece(part, None) for part in cut(self.book, [i for i in live if i not in step.varying], length)]
        ends = [*step.carried.values(), *(i for i, _ in step.stores)]
        steps = pieces(self.book, [i for i in live if i in step.varying], ends, length)
        self.book, self.steps, self.merged = with_merged(self.book, steps)
        self.guarded = guarded_share(self.book, self.steps)
        self.many = bool(self.guarded) and not narrow
        self.frame = frame(self.book, self.before, self.steps, step.carried, ends, self.merged, self.many)
        self.unread = max(1, len({*self.frame.left.values()}))
        room = _BYTES // 64 - (self.frame.size - self.frame.own)
        self.packs = max(1, min(_PACKS, room // (self.frame.own + self.unread))) if self.many else 1
        always = (piece for piece in self.steps if piece.guard is None)
        self._longest = max(always, key=lambda piece: len(piece.numbers), default=None)
        self.next = {} if narrow else self._written_next()
        self.frame.late.update(self.next)
        self.behind = self._writes()

    def _written_next(self) -> dict[int, int]:
        places, steps = self.frame.places, self.steps[self.steps.index(self._longest) :] if self._longest else []
        waiting = {i for piece in steps for i in piece.numbers} & {*self.merged.values()}
        carried = self.step.carried.items()
        return {new: old for old, new in carried if new in waiting and places[old] == places[new]}

    def _writes(self) -> dict[int, list[tuple[int, Access]]]:
        """Constants, and state of the step before, are spread over the longest piece: memory is never idle."""
        behind: dict[int, list[tuple[int, Access]]] = defaultdict(list)
        spread: list[tuple[int, Access]] = []
        for number, access in self.step.stores:
            if number in self.next:
                spread.append((self.next[number], access._replace(step="before")))
            elif number in self.book.values and self._longest:
                spread.append((number, access))
            elif number not in self.merged.values():
                behind[number].append((number, access))
        numbers = self._longest.numbers if self._longest else []
        for k, store in enumerate(spread):
            behind[numbers[len(numbers) * k // len(spread)]].append(store)
        return behind
