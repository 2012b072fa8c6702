"""Which expressions of a step are computed together, and where: always, or only where a choice needs them."""

from __future__ import annotations

from bisect import bisect_right
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from torchfra.compiler.expressions import Expressions

COSTS = {"constant": 0, "input": 0, "div": 8, "sqrt": 12, "norm": 20, "atan2": 40, "hypot": 20, "exp": 20, "log": 20,
         "log1p": 25, "expm1": 25, "sin": 30, "cos": 30, "tan": 40, "asin": 30, "acos": 30, "atan": 30, "sinh": 30,
         "cosh": 30, "tanh": 30, "erf": 40, "pow": 60, "result": 0}  # fmt: skip
"""Of operations in those of a multiplication, roughly; 1 for what is not here."""
_WORTH, _SHARE = 300, 0.02
"""What a region costs at least, in multiplications and of the whole step: a smaller one is computed always."""
_PIECE = 6000
"""Expressions of a piece, about: compilers take time that grows faster than the length of a function, which keeps more
values in registers."""

Condition = tuple[int, bool]
"""A truth value, and the value of it for which something is needed."""


class Piece(NamedTuple):
    """Expressions that are computed one after the other."""

    numbers: list[int]
    guard: Condition | None
    """The tracks that need them; None for all."""


def cost(book: Expressions, numbers: Iterable[int]) -> int:
    """Of expressions, in multiplications."""
    nodes, calls = book.nodes, book.calls
    return sum(calls[i].cost if i in calls else COSTS.get(nodes[i][0], 1) for i in numbers)


def pieces(book: Expressions, live: Sequence[int], ends: Sequence[int], length: int | None = None) -> list[Piece]:
    """A step in an order in which it can be computed, with what only some tracks need apart.

    Args:
        book: the expressions.
        live: those to be computed, arguments first.
        ends: those that all tracks need.
        length: expressions of a piece, about; None for what suits a CPU.
    """
    guards = regions(book, live, conditions(book, live, ends))
    call = {i: book.nodes[i][1][0] if i in book.places else i for i in live}  # results come with their call
    results = defaultdict(list)
    for i in live:
        results[call[i]].append(i)
    before = {
        i: [call[a] for a in (*book.nodes[i][1], *(guards[i] or ())[:1]) if a in guards] for i in live if call[i] == i
    }
    order = ordered([*before], before, [call.get(i, i) for i in ends])
    groups = _groups(order, before, guards, {i for i in before if book.nodes[i][0] == "input"})
    return [
        Piece(part, guard)
        for (_, guard), group in sorted(groups.items(), key=lambda item: item[0][0])
        for part in cut(book, [i for number in group for i in results[number]], length)
    ]


def guarded_share(book: Expressions, steps: Sequence[Piece]) -> float:
    """What of a step only some tracks need: its cost over that of the whole."""
    costs = [(cost(book, piece.numbers), piece.guard is not None) for piece in steps]
    return sum(c for c, guarded in costs if guarded) / max(sum(c for c, _ in costs), 1)


def conditions(book: Expressions, live: Sequence[int], ends: Iterable[int]) -> dict[int, frozenset[Condition]]:
    """For each expression conditions that hold for every track that needs it.

    What only one side of a choice uses is needed where the choice takes that side; so is what is combined with a truth
    value that settles the result.
    """
    nothing = frozenset[Condition]()
    found = dict.fromkeys(ends, nothing)

    def needed(number: int, where: frozenset[Condition]) -> None:
        known = found.get(number)
        found[number] = where if known is None else known & where

    for number in reversed(live):
        (op, args), where = book.nodes[number], found.get(number, nothing)
        if op == "select":
            mask, yes, no = args
            needed(mask, where)
            needed(yes, where | implied(book, mask, True))
            needed(no, where | implied(book, mask, False))
        elif op in ("and", "or"):
            first, second = sorted(args)
            needed(first, where)
            needed(second, where | implied(book, first, op == "and"))
        elif where:
            for arg in args:
                needed(arg, where)
        else:
            for arg in args:
                found[arg] = nothing
    return found


def implied(book: Expressions, number: int, value: bool) -> frozenset[Condition]:
    """What follows from the value of a truth value, itself included."""
    op, args = book.nodes[number]
    if op == "not":
        return implied(book, args[0], not value)
    parts = args if op == ("and" if value else "or") else ()
    return frozenset({(number, value)}).union(*(implied(book, i, value) for i in parts))


def regions(
    book: Expressions, live: Sequence[int], where: Mapping[int, frozenset[Condition]]
) -> dict[int, Condition | None]:
    """The condition under which each expression is computed: of those it has, the one that saves most."""
    least = max(_WORTH, _SHARE * cost(book, live))
    guards: dict[int, Condition | None] = dict.fromkeys(live)
    saved: dict[Condition, int] = defaultdict(int)
    under: dict[Condition, list[int]] = defaultdict(list)
    costs = {number: cost(book, [number]) for number in live if where[number]}
    for number in costs:
        if book.nodes[number][0] not in ("constant", "input"):
            for condition in where[number]:
                saved[condition] += costs[number]
                under[condition].append(number)
    while saved:
        best = max(saved, key=lambda condition: (saved[condition], condition))
        if saved[best] < least:
            break
        for number in under[best]:
            if guards[number] is None:
                guards[number] = best
                for condition in where[number]:
                    saved[condition] -= costs[number]
    return guards


def ordered(live: Sequence[int], before: Mapping[int, Sequence[int]], ends: Sequence[int]) -> list[int]:
    """Expressions behind all that must come before them, and soon after: few values wait at any time.

    From the last end to the first; of several arguments the one that was written down earliest comes first.  (In the
    order in which a step is traced all hypotheses of a filter go through each operation together: too many values to
    stay in the caches.)
    """
    done: dict[int, None] = {}
    for number in [*reversed(ends), *live]:
        todo = [number] if number in before else []
        while todo:
            if todo[-1] in done:
                todo.pop()
                continue
            missing = [i for i in before[todo[-1]] if i not in done]
            if missing:
                todo += sorted(missing, reverse=True)
            else:
                done[todo.pop()] = None
    return list(done)


def _groups(
    live: Sequence[int], before: Mapping[int, Sequence[int]], guards: Mapping[int, Condition | None], inputs: set[int]
) -> dict[tuple[int, Condition | None], list[int]]:
    """Expressions by when they are computed, and where: a group needs nothing but earlier groups and itself."""
    kinds = {guard: kind for kind, guard in enumerate(dict.fromkeys(guards.values()))}
    kind = {number: kinds[guards[number]] for number in live}
    when: dict[int, int] = {}
    stages: list[set[int]] = [set() for _ in kinds]
    for number in live:
        own, earliest = kind[number], 0
        for i in before[number]:
            stage = when[i] + (kind[i] != own)
            if stage > earliest:
                earliest = stage
        when[number] = earliest
        stages[own].add(earliest)
    order = [*map(sorted, stages)]
    always, limits = kinds.get(None), dict[int, int]()
    for number in reversed(live):  # what can wait for a later group does: fewer groups, and fewer values to keep
        own, latest = kind[number], when[number]
        if own != always or number in inputs:
            of = order[own]
            when[number] = latest = of[bisect_right(of, limits.get(number, latest)) - 1]
        for i in before[number]:
            stage = latest - (kind[i] != own)
            if stage < limits.get(i, stage + 1):
                limits[i] = stage
    groups = defaultdict(list)
    for number in live:
        groups[when[number], guards[number]].append(number)
    return groups


def cut(book: Expressions, numbers: Sequence[int], length: int | None = None) -> list[list[int]]:
    """Expressions in pieces of about equal length, cut where few values go across."""
    length = length or _PIECE
    last = {arg: k for k, number in enumerate(numbers) for arg in book.nodes[number][1]}
    ends = [0] * (len(numbers) + 1)
    for k, number in enumerate(numbers):
        ends[k] += 1
        ends[max(last.get(number, k), k)] -= 1
    across, alive = [], 0
    for change in ends:
        alive += change
        across.append(alive)

    def whole(k: int) -> bool:
        """Whether no call is parted from its results behind this one."""
        return numbers[k + 1] not in book.places

    cuts, end = [0], len(numbers) - 1
    while len(numbers) - cuts[-1] > length * 3 // 2:
        start, stop = cuts[-1] + length // 2, cuts[-1] + length
        window = list(filter(whole, range(start, stop))) or [next(filter(whole, range(stop, end)), end)]
        cuts.append(min(window, key=lambda k: across[k]) + 1)
    return [list(numbers[a:b]) for a, b in zip(cuts, [*cuts[1:], len(numbers)], strict=True) if a < b]
