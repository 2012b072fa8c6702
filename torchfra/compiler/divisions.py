"""Quotients whose inverse is of no other use: one division, which is finite where that inverse may not be."""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Collection, Sequence

from torchfra.compiler.expressions import Expressions


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
