"""Arithmetic on single numbers, written down instead of carried out."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import Any, NamedTuple

from torchfra.compiler.origin import Origins

ZERO = 0
"""The number of the constant 0, which is also False."""

_LONG = 64
"""Arguments at most of one operation in C++: some compilers take no more than 256."""
_BOOL = {"lt", "le", "eq", "and", "or", "not"}
_FOLD: dict[str, Callable[..., float]] = {
    "add": lambda a, b: a + b, "sub": lambda a, b: a - b, "mul": lambda a, b: a * b, "neg": lambda a: -a,
    "abs": abs, "norm": math.hypot, "max": max, "min": min,
    "lt": lambda a, b: float(a < b), "le": lambda a, b: float(a <= b), "eq": lambda a, b: float(a == b),
    "and": lambda a, b: float(bool(a and b)), "or": lambda a, b: float(bool(a or b)), "not": lambda a: float(not a),
}  # fmt: skip

_FUNCTIONS = {"sqrt", "exp", "log", "sin", "cos"}
"""Functions that are folded where the argument is a constant above 0."""
_EITHER_WAY = {"add", "mul", "and", "or", "eq", "max", "min"}
"""Whose two arguments may change places."""


class TooManyError(Exception):
    """More expressions than the limit of the book."""


class Routine(NamedTuple):
    """Expressions that are written once, and called with other arguments each time."""

    name: str
    book: Expressions
    inputs: list[int]
    outputs: list[int]
    live: list[int]
    """What is computed, in this order."""
    cost: int
    """In multiplications, roughly."""


class Expressions:
    """Expressions by number, each once: ``nodes[i]`` is an operation and the numbers of what it acts on.

    ``names`` has what some are called, ``origin[i]`` says where each was first written: what ``here`` was then.
    ``truths`` are those that are true or false.
    A ``"call"`` is one of ``calls[i]``; each of its results is a ``"result"``, the one at ``places[i]``.

    Operations on constants are folded, and so are additions of 0 and products with 0 and 1.  (So 0 times NaN is 0
    here.)

    Args:
        most: more of them raise ``TooManyError``; None for any number.
    """

    def __init__(self, most: int | None = None) -> None:
        self._most = most
        self.nodes: list[tuple[str, tuple[int, ...]]] = []
        self.values: dict[int, float] = {}
        self.truths: set[int] = set()
        self.names: dict[int, str] = {}
        self.origin: list[str] = []
        self.here = ""
        self.origins = Origins()
        self.calls: dict[int, Routine] = {}
        self.places: dict[int, int] = {}
        self.routines: dict[Hashable, Any] = {}
        self._known: dict[tuple[object, ...], int] = {}
        self.constant(0.0)

    def _new(self, op: str, args: tuple[int, ...], *more: object) -> int:
        new = len(self.nodes)
        number = self._known.setdefault((op, args, *more), new)
        if number == new:
            self._append(op, args)
        return number

    def constant(self, value: float) -> int:
        """A known number; True is 1 and False is 0."""
        value = float(value)
        number = self._new("constant", (), repr(value))  # which tells -0 from 0
        self.values[number] = value
        return number

    def input(self) -> int:
        """A number that is not known yet."""
        self._append("input", ())
        return len(self.nodes) - 1

    def call(self, routine: Routine, args: Sequence[int]) -> list[int]:
        """What a routine gives for these arguments."""
        call = self._new("call", tuple(args), routine.name)
        self.calls[call] = routine
        return [self._result(routine, call, k) for k in range(len(routine.outputs))]

    def _result(self, routine: Routine, call: int, place: int) -> int:
        output = routine.outputs[place]
        if output in routine.book.values:
            return self.constant(routine.book.values[output])
        if output in routine.inputs:
            return self.nodes[call][1][routine.inputs.index(output)]
        number = self._new("result", (call,), place)
        self.places[number] = place
        return number

    def nested(self) -> Expressions:
        """An empty book for the body of a routine; it shares this one's routines."""
        new = Expressions()
        new.routines = self.routines
        return new

    def _append(self, op: str, args: tuple[int, ...]) -> None:
        if len(self.nodes) == self._most:
            raise TooManyError
        if op in _BOOL or (op == "select" and self.truths.issuperset(args[1:])):
            self.truths.add(len(self.nodes))
        self.nodes.append((op, args))
        self.origin.append(self.here)

    def is_bool(self, number: int) -> bool:
        """Whether it is true or false."""
        return number in self.truths

    def apply(self, op: str, *args: int) -> int:
        """An operation on expressions."""
        if ZERO in args and op in ("mul", "add"):  # of most entries of a matrix with zeros
            other = args[args[0] == ZERO]
            if other not in self.values:
                return ZERO if op == "mul" else other
        known = [*map(self.values.get, args)]
        if None not in known:
            if op in _FOLD:
                return self.constant(_FOLD[op](*known))
            if op in _FUNCTIONS and known[0] > 0:  # type: ignore[operator]  # it is not None
                return self.constant(getattr(math, op)(known[0]))
        simple = _SIMPLE.get(op)
        simplified = None if simple is None else simple(self, args, known)
        if simplified is not None:
            return simplified
        if op in _EITHER_WAY and args[0] > args[1]:
            args = args[::-1]
        return self._new(op, args)

    def needed(self, outputs: Iterable[int]) -> list[int]:
        """The expressions that these need, themselves included, in an order in which they can be computed."""
        nodes, found = self.nodes, {*outputs}
        todo = [*found]
        while todo:
            for number in nodes[todo.pop()][1]:
                if number not in found:
                    found.add(number)
                    todo.append(number)
        return sorted(found)

    def copied(self) -> Expressions:
        """A copy that can grow and change by itself, beyond any limit."""
        new = copy.copy(self)
        new._most = None
        new.nodes, new.origin, new.truths = [*self.nodes], [*self.origin], {*self.truths}
        new.values, new._known = {**self.values}, {**self._known}
        return new

    def sum(self, terms: Iterable[int]) -> int:
        """All of them together, from the first on."""
        total = ZERO
        for term in terms:
            total = self.apply("add", total, term)
        return total

    def _argument(self, op: str, number: int) -> int | None:
        """What ``op`` acts on if that is what the number is."""
        other, args = self.nodes[number]
        return args[0] if other == op else None

    def _add(self, args: tuple[int, ...], known: list[float | None]) -> int | None:
        nodes, (first, second) = self.nodes, args
        for a, b, value in ((first, second, known[0]), (second, first, known[1])):
            if value == 0:
                return b
            op, parts = nodes[a]
            if op == "neg":
                return self.apply("sub", b, parts[0])
        return None

    def _sub(self, args: tuple[int, ...], known: list[float | None]) -> int | None:
        a, b = args
        if known[1] == 0:
            return a
        if known[0] == 0:
            return self.apply("neg", b)
        inner = self._argument("neg", b)
        return None if inner is None else self.apply("add", a, inner)

    def _mul(self, args: tuple[int, ...], known: list[float | None]) -> int | None:
        nodes, (first, second) = self.nodes, args
        for a, b, value in ((first, second, known[0]), (second, first, known[1])):
            if value is not None and value in (0, 1, -1):
                return ZERO if value == 0 else b if value == 1 else self.apply("neg", b)
            op, parts = nodes[a]
            if op == "neg":
                return self.apply("neg", self.apply("mul", parts[0], b))
        return None

    def _div(self, args: tuple[int, ...], known: list[float | None]) -> int | None:
        a, b = args
        if known[0] == 0:
            return ZERO
        if known[1]:
            return self.apply("mul", a, self.constant(1 / known[1]))
        return None if known[0] == 1 else self.apply("mul", a, self.apply("div", self.constant(1.0), b))

    def _neg(self, args: tuple[int, ...], known: list[float | None]) -> int | None:
        return self._argument("neg", args[0])

    def _norm(self, args: tuple[int, ...], known: list[float | None]) -> int | None:
        if ZERO in args:
            return self.apply("norm", *(a for a in args if a != ZERO))
        if len(args) > _LONG:
            return self.apply("norm", self.apply("norm", *args[:_LONG]), *args[_LONG:])
        return self.apply("abs", *args) if len(args) == 1 else None

    def _not(self, args: tuple[int, ...], known: list[float | None]) -> int | None:
        return self._argument("not", args[0])

    def _select(self, args: tuple[int, ...], known: list[float | None]) -> int | None:
        mask, yes, no = args
        if known[0] is not None:
            return yes if known[0] else no
        if yes == no:
            return yes
        inner = self._argument("not", mask)
        if inner is not None:
            return self.apply("select", inner, no, yes)
        if self.is_bool(yes) and self.is_bool(no):  # truth values are masks, which only logic combines
            return self.apply("or", self.apply("and", mask, yes), self.apply("and", self.apply("not", mask), no))
        return None

    def _and(self, args: tuple[int, ...], known: list[float | None]) -> int | None:
        for (_, b), value in zip((args, args[::-1]), known, strict=True):
            if value is not None:
                return b if value else ZERO
        return args[0] if args[0] == args[1] else None

    def _or(self, args: tuple[int, ...], known: list[float | None]) -> int | None:
        for (_, b), value in zip((args, args[::-1]), known, strict=True):
            if value is not None:
                return self.constant(1.0) if value else b
        return args[0] if args[0] == args[1] else None


_SIMPLE: dict[str, Callable[[Expressions, tuple[int, ...], list[float | None]], int | None]] = {
    "add": Expressions._add, "sub": Expressions._sub, "mul": Expressions._mul, "div": Expressions._div,
    "neg": Expressions._neg, "norm": Expressions._norm, "not": Expressions._not, "select": Expressions._select,
    "and": Expressions._and, "or": Expressions._or,
}  # fmt: skip
"""What simplifies an operation; None where it does not."""
