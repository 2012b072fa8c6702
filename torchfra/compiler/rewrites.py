"""Four passes over the expressions of a step, which give the same results in less time.

Each takes a book and leaves it as it is.  ``with_masked``, ``with_quotients`` and ``with_choices_last`` come before the
plan, in this order; ``with_merged`` is a part of it, as it needs to know which regions there are.
"""

from __future__ import annotations

import copy
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Sequence
from itertools import groupby

from torchfra.compiler.expressions import ZERO, Expressions
from torchfra.compiler.schedule import Condition, Piece, implied


def with_quotients(
    book: Expressions, live: Sequence[int], varying: Collection[int], outputs: Collection[int]
) -> tuple[Expressions, list[int]]:
    """The same step, with ``a / b`` for ``a (1 / b)`` unless something else shares ``1 / b``, and what of it is live.

    The inverse of a number below the least normal one is infinite, and 0 times it is NaN, where 0 over it is 0.

    Args:
        book: the expressions, which stay as they are.
        live: those that are needed, arguments first.
        varying: those of them that change from step to step; an inverse that does not is computed once for all steps.
        outputs: those that are written or carried on.
    """
    uses = Counter([*outputs, *(arg for number in live for arg in book.nodes[number][1])])
    new, gone = copy.copy(book), set()
    new.nodes = list(book.nodes)
    for number in live:
        op, args = book.nodes[number]
        for inverse, other in (args, args[::-1]) if op == "mul" else ():
            kind, parts = book.nodes[inverse]
            if kind == "div" and uses[inverse] == 1 and (inverse in varying) == (number in varying):
                new.nodes[number] = "div", (other, parts[1])
                gone.add(inverse)
                break
    return new, [number for number in live if number not in gone]


def with_choices_last(
    book: Expressions, live: Sequence[int], varying: Collection[int], outputs: Iterable[int]
) -> tuple[Expressions, list[int]]:
    """The same step, with ``m ? f(a) : f(b)`` for ``f(m ? a : b)`` where a and b stay, and what of it is live.

    Args:
        book: the expressions, which stay as they are.
        live: those that are needed, arguments first.
        varying: those of them that change from step to step.
        outputs: those that are written or carried on.
    """
    new = book.copied()
    new.here = ""
    order: dict[int, None] = {}
    for number in live:
        sides = _sides(new, number, varying) if number in varying else None
        if sides is not None:
            mask, *parts = sides
            chosen = [new.apply(new.nodes[number][0], *args) for args in parts]
            new.nodes[number] = "select", (mask, *chosen)
            order.update(dict.fromkeys(i for side in chosen for i in _needed(new, [side], order)))
        order.setdefault(number)
    needed = set(new.needed(outputs))
    return new, [number for number in order if number in needed]


def _sides(book: Expressions, number: int, varying: Collection[int]) -> tuple[int, list[int], list[int]] | None:
    """The truth value on which alone an expression depends, and its arguments where that is true, and else."""
    op, args = book.nodes[number]
    if op in ("select", "call", "result") or book.is_bool(number):
        return None
    masks, yes, no = set(), [], []
    for arg in args:
        kind, parts = book.nodes[arg]
        if arg in varying and (kind != "select" or any(i in varying for i in parts[1:]) or book.is_bool(arg)):
            return None
        masks |= {parts[0]} if arg in varying else set()
        yes.append(parts[1] if arg in varying else arg)
        no.append(parts[2] if arg in varying else arg)
    return (masks.pop(), yes, no) if len(masks) == 1 else None


def _needed(book: Expressions, outputs: Iterable[int], known: Collection[int]) -> list[int]:
    """Expressions that others need and that are not known yet, arguments first."""
    found: dict[int, None] = {}
    todo = [(output, False) for output in outputs]
    while todo:
        number, ready = todo.pop()
        if ready:
            found.setdefault(number)
        elif number not in known and number not in found:
            todo.append((number, True))
            todo += [(arg, False) for arg in book.nodes[number][1]]
    return list(found)


def with_masked(
    book: Expressions, live: Sequence[int], rare: Collection[Condition], ends: Iterable[int]
) -> tuple[Expressions, list[int]]:
    """The same step, where what is 0 unless a rare condition holds is ``m ? x : 0`` to all that is not, and its order.

    So ``x``, and what is of no other use, is part of the region of that condition.

    Args:
        book: the expressions, which stay as they are.
        live: those that are needed, arguments first.
        rare: the conditions.
        ends: the expressions that are written or carried on.
    """
    if not rare:
        return book, [*live]
    new, ends = book.copied(), {*ends}
    where: dict[int, frozenset[Condition]] = {}
    for number in live:
        where[number] = _zero_unless(book, number, where).intersection(rare)
    outside = {i for number in live for i in book.nodes[number][1] if where[number] != where.get(i)} | ends
    inner, order = dict[int, int](), list[int]()
    for number in live:
        op, args = book.nodes[number]
        args = tuple(inner.get(i, i) if where[number] == where.get(i) else i for i in args)
        new.nodes[number] = op, args
        if where[number] and number in outside:
            mask, value = min(where[number])
            inner[number] = new.input()
            new.nodes[inner[number]] = op, args
            new.origin[inner[number]] = book.origin[number]
            new.nodes[number] = "select", (mask, inner[number], ZERO) if value else (mask, ZERO, inner[number])
            order.append(inner[number])
        order.append(number)
    return new, order


def _zero_unless(book: Expressions, number: int, where: dict[int, frozenset[Condition]]) -> frozenset[Condition]:
    """The conditions each of which holds, or the number is 0."""
    op, args = book.nodes[number]
    if book.is_bool(number):
        return frozenset()
    parts = [where.get(i, frozenset[Condition]()) for i in args]
    if op == "select":
        mask, *sides = args
        if ZERO in sides:
            return implied(book, mask, sides[1] == ZERO) | parts[2 - sides.index(ZERO)]
        return parts[1] & parts[2]
    if op in ("add", "sub"):
        return parts[0] & parts[1]
    if op == "mul":
        return parts[0] | parts[1]
    return parts[0] if op in ("neg", "div") else frozenset()


def with_merged(book: Expressions, steps: Sequence[Piece]) -> tuple[Expressions, list[Piece], dict[int, int]]:
    """The same step, where a choice between the result of a region and another value is that value and then the result.

    If all tracks compute the other value before the region, the choice is made there, as the ``same``.  The region puts
    its result in the place of the choice, for the tracks that need it.

    Returns:
        The expressions, the pieces, and for each such result the choice.
    """
    groups = [list(group) for _, group in groupby(steps, key=lambda piece: piece.guard)]
    made = {number: k for k, group in enumerate(groups) for piece in group for number in piece.numbers}
    users: dict[int, set[int]] = defaultdict(set)
    for number, k in made.items():
        for arg in book.nodes[number][1]:
            if made.get(arg) != k:
                users[arg].add(number)
    guards = {number: groups[k][0].guard for number, k in made.items()}
    new, merged, gone, behind = copy.copy(book), dict[int, int](), set[int](), defaultdict[int, list[int]](list)
    new.nodes = [*book.nodes]
    for number in made:
        op, args = book.nodes[number]
        if op != "select" or guards[number] is not None or book.is_bool(number):
            continue
        mask, yes, no = args
        for value, result, other in ((True, yes, no), (False, no, yes)):
            alone = guards.get(result) == (mask, value) and users[result] == {number}
            if alone and guards.get(other, 0) is None and made[other] < made[result] and other not in gone:
                new.nodes[number] = "same", (other,)
                merged[result] = number
                gone.add(number)
                behind[other].append(number)
    parts = [
        Piece(
            [i for number in piece.numbers if number not in gone for i in (number, *behind.get(number, ()))],
            piece.guard,
        )
        for piece in steps
    ]
    return new, [piece for piece in parts if piece.numbers], merged
