"""Writes ``f(m ? a : b)`` as ``m ? f(a) : f(b)`` where a and b do not change over time: both are computed once."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

from torchfra.compiler.expressions import Expressions


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
