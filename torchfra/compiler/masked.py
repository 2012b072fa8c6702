"""Values that are 0 unless a condition holds, as gradients of a branch are: computed where it holds alone."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

from torchfra.compiler.expressions import ZERO, Expressions
from torchfra.compiler.schedule import Condition, implied


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
