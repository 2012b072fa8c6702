"""Choices without an instruction: a region overwrites the other value with its result."""

from __future__ import annotations

import copy
from collections import defaultdict
from collections.abc import Sequence
from itertools import groupby

from torchfra.compiler.expressions import Expressions
from torchfra.compiler.schedule import Piece


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
