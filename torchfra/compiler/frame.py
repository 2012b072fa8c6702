"""Where the values of a step lie that one piece of it computes and another one needs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from torchfra.compiler.expressions import Expressions
from torchfra.compiler.schedule import Piece


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
) -> Frame:
    """Places for all values that are needed beyond their piece.

    Args:
        book: the expressions.
        before: pieces that are computed once, before the steps.
        steps: the pieces of a step.
        carried: what goes from step to step, with what takes its place after the step.
        outputs: what is written.
        merged: results of regions, and the choices in whose places they are put.
        shared: whether packs may have places together.
    """
    made = {number: k for k, piece in enumerate(steps) for number in piece.numbers}
    last = {number: k for k, piece in enumerate(steps) for number in needs(book, piece)}
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
            if number not in places and last.get(number, k) > k:
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
