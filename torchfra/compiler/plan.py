"""How a step is computed: in which pieces, with which values where, and what is written behind what."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import NamedTuple

from torchfra.compiler.expressions import ZERO, Expressions
from torchfra.compiler.rewrites import with_merged
from torchfra.compiler.schedule import Piece, cut, guarded_share, pieces


class Access(NamedTuple):
    """An entry of a tensor that is read or written."""

    port: str
    """``"in"`` or ``"out"``."""
    number: int
    """Of the tensor among those."""
    entry: int
    type: str = "Scalar"
    """Of its entries: ``"Scalar"``, what the arithmetic is in, ``"double"`` or ``"bool"``."""
    packed: bool = False
    """Whether the entries of neighbouring tracks lie side by side."""
    before: bool = False
    """Whether that of the step before."""


class Loop(NamedTuple):
    """What the step of a loop over time computes, reads and writes.

    Args:
        book: the expressions.
        live: those that are needed, arguments first.
        varying: those of them that change from step to step.
        carried: what goes from step to step, with what takes its place after a step.
        first: how the carried is read before the first step.
        loads: how inputs are read.
        stores: what is written at each step.
        end: what is carried out of the last step; 0 where nothing is carried.
    """

    book: Expressions
    live: list[int]
    varying: set[int]
    carried: dict[int, int]
    first: dict[int, Access]
    loads: dict[int, Access]
    stores: list[tuple[int, Access]]
    end: list[tuple[int, Access]]


class Frame(NamedTuple):
    """Places for values, numbered from 0."""

    size: int
    own: int
    """The first of them are each pack's own.  Others are shared by all packs: no pack needs their values while the next
    one is computed."""
    places: dict[int, int]
    """The place of each expression that has one."""
    moves: list[tuple[int, int]]
    """Expressions to be copied at the end of a step, all at once, and where to."""
    late: set[int]
    """Expressions that are stored at the end of their piece: until then their place holds what was carried."""
    left: dict[int, int]
    """Places apart, numbered from 0, of carried values that no step reads: old and new share one."""


def frame(
    book: Expressions,
    before: Sequence[Piece],
    steps: Sequence[Piece],
    carried: Mapping[int, int],
    outputs: Iterable[int],
    merged: Mapping[int, int],
    shared: bool = True,
    called: Collection[int] = (),
) -> Frame:
    """Places for all values that are needed beyond their piece, or that a call by a table takes or gives.

    Args:
        book: the expressions.
        before: pieces that are computed once, before the steps.
        steps: the pieces of a step.
        carried: what goes from step to step, with what takes its place after the step.
        outputs: what is written.
        merged: results of regions, and the choices in whose places they are put.
        shared: whether packs may have places together.
        called: what such calls take and give.
    """
    made = {number: k for k, piece in enumerate(steps) for number in piece.numbers}
    last = {number: made[number] for number in called if number in made}
    last.update((number, k) for k, piece in enumerate(steps) for number in needs(book, piece))
    behind = {i for i in outputs if i not in made or i in merged.values()}
    read = last.keys() | behind | {*merged.values()}
    alone = Counter(carried.values())
    unread = {old: new for old, new in carried.items() if new in made and alone[new] == 1 and not read & {old, new}}
    carried = {old: new for old, new in carried.items() if old not in unread}
    last.update(dict.fromkeys([*carried.values(), *behind], len(steps)))
    last = {number: k for number, k in last.items() if number not in merged}
    fixed = {number for piece in before for number in piece.numbers}
    wanted = last.keys() | {number for piece in before for number in needs(book, piece)}
    places = {number: place for place, number in enumerate([*carried, *sorted(fixed & wanted)])}
    size = len(places)
    late = _renewed(places, made, last, carried)
    passing = _passing(book, steps, made, last) if shared else set()
    own = max(_placed(places, size, steps, {i: k for i, k in last.items() if i not in passing}), 1)
    size = _placed(places, own, steps, {i: last[i] for i in passing - places.keys()})
    moves = [(new, places[old]) for old, new in carried.items() if places.get(new) != places[old]]
    places |= {i: places[choice] for i, choice in merged.items()}
    left = {i: place for place, pair in enumerate(unread.items()) for i in pair}
    return Frame(size, own, places, moves, late, left)


def needs(book: Expressions, piece: Piece) -> list[int]:
    """What a piece takes from elsewhere, and the truth value that guards it."""
    own = set(piece.numbers)
    args = [i for number in piece.numbers for i in book.nodes[number][1] if i not in own]
    guard = [] if piece.guard is None else [piece.guard[0]]
    return list(dict.fromkeys(i for i in [*args, *guard] if i not in book.values))


def _renewed(
    places: dict[int, int], made: Mapping[int, int], last: Mapping[int, int], carried: Mapping[int, int]
) -> set[int]:
    """Gives new values the places of the old ones, where those are not needed any more."""
    late = set()
    for old, new in carried.items():
        if new in made and new not in places and last.get(old, -1) <= made[new]:
            places[new] = places[old]
            if last.get(old) == made[new]:
                late.add(new)
    return late


def _passing(book: Expressions, steps: Sequence[Piece], made: Mapping[int, int], last: Mapping[int, int]) -> set[int]:
    """Values that none needs but their own group of pieces and, if that is for all tracks, the region behind it."""
    stages, stage = list[int](), 0
    for k, piece in enumerate(steps):
        before = steps[max(k - 1, 0)].guard
        stage += piece.guard != before and before is not None
        stages.append(stage)
    passing = {i for i in made.keys() & last.keys() if last[i] < len(steps)}
    for k, piece in enumerate(steps):
        passing -= {i for i in needs(book, piece) if i in made and stages[made[i]] != stages[k]}
        passing -= {piece.guard[0]} if piece.guard else set()
    return passing


def _placed(places: dict[int, int], size: int, steps: Sequence[Piece], last: Mapping[int, int]) -> int:
    """Gives places from number ``size`` on to values by the pieces that need them ``last``; how many there are then."""
    ending: dict[int, list[int]] = {}
    for number in last.keys() - places.keys():
        ending.setdefault(last[number], []).append(number)
    free: list[int] = []
    for k, piece in enumerate(steps):
        for number in piece.numbers:
            if number not in places and number in last:
                if not free:
                    free, size = [size], size + 1
                places[number] = free.pop()
        free += sorted(places[number] for number in ending.get(k, ()) if number in places)
    return size


def crossing(
    book: Expressions, parts: Sequence[Piece], others: Iterable[Sequence[int]], merged: Iterable[int]
) -> tuple[list[int], list[int]]:
    """What a region of some pieces takes from the others, which need ``others``, and what it gives to them."""
    own = {number for piece in parts for number in piece.numbers}
    taken = [i for piece in parts for i in needs(book, Piece(piece.numbers, None)) if i not in own]
    stored = [i for needed in others for i in needed if i in own]
    return list(dict.fromkeys(taken)), list(dict.fromkeys([*stored, *(i for i in merged if i in own)]))


_MANY, _REACH = 16, 1 << 16
"""Arguments at least of a call by a table, and places that its numbers reach."""
_PACKS, _BYTES = 32, 3 << 17
"""Packs of a block at most, and bytes of their values: a part of the second cache."""


class Order(NamedTuple):
    """One thing that a function of a step does with an expression."""

    what: str
    """``"take"`` it from its place, ``"compute"`` it, ``"read"`` it from a tensor, ``"keep"`` it in its place,
    ``"move"`` it to that of another, ``"write"`` it to a tensor, ``"call"`` it by a table of places."""
    number: int
    access: Access | None = None
    """The entry of the tensor."""
    place: int = -1
    """The other place."""


class Plan:
    """How a step is computed: its functions, as orders for who writes them in a language.

    Args:
        loop: the step.
        narrow: whether for one track.
        length: expressions of a function, about; None for what suits a CPU.
        tables: whether calls may take their arguments from places, and put results there.

    Attributes:
        loop: the step.
        book: the expressions.
        before: pieces that are computed once.
        steps: those of each step.
        frame: where values lie.
        merged: results of regions, and the choices in whose places they are put.
        guarded: what of a step only some tracks need, as a share of its cost.
        many: whether packs of tracks share regions.
        packs: of a block of tracks at most.
        unread: places of values that are carried but that no step reads.
        tabled: by call with a table, places of its arguments, and which results go to which places.
    """

    def __init__(self, loop: Loop, narrow: bool, length: int | None = None, tables: bool = False) -> None:
        self.loop, self.book = loop, loop.book
        live = [i for i in loop.live if i not in self.book.values and i not in loop.carried]
        self.before = [Piece(part, None) for part in cut(self.book, [i for i in live if i not in loop.varying], length)]
        ends = [*loop.carried.values(), *(i for i, _ in loop.stores)]
        steps = pieces(self.book, [i for i in live if i in loop.varying], ends, length)
        self.book, self.steps, self.merged = with_merged(self.book, steps)
        self.guarded = guarded_share(self.book, self.steps)
        self.many = bool(self.guarded) and not narrow
        calls = self._calls() if tables else {}
        called = {i for call, results in calls.items() for i in (*self.book.nodes[call][1], *results)}
        self.frame = frame(self.book, self.before, self.steps, loop.carried, ends, self.merged, self.many, called)
        self.unread = max(1, len({*self.frame.left.values()}))
        room = _BYTES // 64 - (self.frame.size - self.frame.own)
        self.packs = max(1, min(_PACKS, room // (self.frame.own + self.unread))) if self.many else 1
        always = (piece for piece in self.steps if piece.guard is None)
        self._longest = max(always, key=lambda piece: len(piece.numbers), default=None)
        self._next = {} if narrow else self._written_next()
        self.frame.late.update(self._next)
        self.tabled = self._tabled(calls)
        self._given = {i for call in self.tabled for i in calls[call]}
        self._behind = self._writes()

    def _calls(self) -> dict[int, list[int]]:
        """The calls of many arguments in a step, with those of their results that are needed."""
        numbers = [i for piece in self.steps for i in piece.numbers]
        found = {i: list[int]() for i in numbers if i in self.book.calls and len(self.book.nodes[i][1]) >= _MANY}
        for i in numbers:
            call = self.book.nodes[i][1][0] if i in self.book.places else None
            if call in found:
                found[call].append(i)
        return found

    def _tabled(self, calls: Mapping[int, Sequence[int]]) -> dict[int, tuple[list[int], list[tuple[int, int]]]]:
        """Those of the calls all of whose arguments and results are in places in time."""
        places = {i: place for i, place in self.frame.places.items() if place < _REACH and i not in self.frame.late}
        return {
            call: ([places[i] for i in args], [(self.book.places[i], places[i]) for i in results])
            for call, results in calls.items()
            if places.keys() >= {*(args := self.book.nodes[call][1]), *results}
        }

    def begin(self) -> list[Order]:
        """Reads what is carried."""
        read = self.loop.first.items()
        return [order for i, access in read for order in (Order("read", i, access), Order("keep", i))]

    def once(self, piece: Piece) -> list[Order]:
        """A piece of ``before``."""
        return self._piece(piece, {})

    def each(self, piece: Piece) -> list[Order]:
        """A piece of ``steps``."""
        return self._piece(piece, self._behind)

    def _piece(self, piece: Piece, behind: Mapping[int, Sequence[tuple[int, Access]]]) -> list[Order]:
        orders, late = list[Order](), list[Order]()
        known = {*piece.numbers, *self.book.values} - self._given

        def take(number: int) -> None:
            if number not in known:
                orders.append(Order("take", number))
                known.add(number)

        for number in piece.numbers:
            if number in self.tabled:
                orders.append(Order("call", number))
            elif number not in self._given:
                for arg in self.book.nodes[number][1]:
                    take(arg)
                access = self.loop.loads.get(number)
                orders.append(Order("read" if access else "compute", number, access))
                if number in self.frame.places or number in self.frame.left:
                    (late if number in self.frame.late else orders).append(Order("keep", number))
            for other, store in behind.get(number, ()):
                take(other)
                orders.append(Order("write", other, store))
        return orders + late

    def turn(self) -> list[Order]:
        """Ends a step: writes what no piece has computed, and moves what is carried on, all at once."""
        behind = {i for piece in self.steps for number in piece.numbers for i, _ in self._behind.get(number, ())}
        stores = [(i, access) for i, access in self.loop.stores if i not in behind and i not in self._next]
        numbers = dict.fromkeys([*(i for i, _ in stores), *(i for i, _ in self.frame.moves)])
        return [
            *(Order("take", i) for i in numbers if i not in self.book.values),
            *(Order("write", i, access) for i, access in stores),
            *(Order("move", i, place=place) for i, place in self.frame.moves),
        ]

    def last(self) -> list[Order]:
        """Writes of the last step what the next one would write."""
        stores = [(i, access) for i, access in self.loop.stores if i in self._next]
        return [order for i, access in stores for order in (Order("take", i), Order("write", i, access))]

    def end(self) -> list[Order]:
        """Writes what the last step has carried; 0 where nothing is."""
        ends = [(i if i in self.loop.carried else ZERO, access) for i, access in self.loop.end]
        takes = [Order("take", i) for i in dict.fromkeys(i for i, _ in ends if i != ZERO)]
        return [*takes, *(Order("write", i, access) for i, access in ends)]

    def _written_next(self) -> dict[int, int]:
        """State that a region completes at the end of a step: the old state of the next one, which writes it."""
        places, steps = self.frame.places, self.steps[self.steps.index(self._longest) :] if self._longest else []
        waiting = {i for piece in steps for i in piece.numbers} & {*self.merged.values()}
        carried = self.loop.carried.items()
        return {new: old for old, new in carried if new in waiting and places[old] == places[new]}

    def _writes(self) -> dict[int, list[tuple[int, Access]]]:
        """By the expression behind which it is done, what is written, and where.

        Constants, and state of the step before, are spread over the longest piece: memory is never idle.
        """
        behind: dict[int, list[tuple[int, Access]]] = defaultdict(list)
        spread: list[tuple[int, Access]] = []
        for number, access in self.loop.stores:
            if number in self._next:
                spread.append((self._next[number], access._replace(before=True)))
            elif number in self.book.values and self._longest:
                spread.append((number, access))
            elif number not in self.merged.values():
                behind[number].append((number, access))
        numbers = self._longest.numbers if self._longest else []
        for k, store in enumerate(spread):
            behind[numbers[len(numbers) * k // len(spread)]].append(store)
        return behind
