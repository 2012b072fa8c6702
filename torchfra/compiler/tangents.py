"""Derivatives of expressions along a direction, carried forwards with the expressions themselves."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

from torchfra.compiler.expressions import ZERO, Expressions
from torchfra.compiler.source import Port, Scan


def tangent(scan: Scan, moving: Sequence[int]) -> Scan:
    """The same loop, which carries derivatives along a direction of the state and of some inputs forwards with it.

    Args:
        scan: the loop.
        moving: numbers of the ports among its ``reads`` that have a direction.

    Returns:
        A loop whose ``carry``, ``reads``, ``after`` and ``writes`` have derivatives behind all they had: of reads where
        they are ``moving``, of writes where they are no truth values.

    Raises:
        NotImplementedError: an operation has no rule.
    """
    book = scan.book.copied()
    reads = [scan.reads[k] for k in moving]
    directions = [
        replace(port, ids=[ZERO if i == ZERO else book.input() for i in port.ids]) for port in (*scan.carry, *reads)
    ]
    seeds = {i: j for port, direction in zip((*scan.carry, *reads), directions, strict=True)
             for i, j in zip(port.ids, direction.ids, strict=True) if i != ZERO}  # fmt: skip
    found = tangents(book, scan.live(), seeds)

    def rates(ports: Sequence[Port]) -> list[Port]:
        return [replace(port, ids=[found.get(i, ZERO) for i in port.ids]) for port in ports]

    count, numbers = len(scan.carry), [port for port in scan.writes if not port.truth]
    return replace(
        scan,
        book=book,
        carry=scan.carry + directions[:count],
        after=scan.after + rates(scan.after),
        reads=scan.reads + directions[count:],
        writes=scan.writes + rates(numbers),
    )


def tangents(book: Expressions, numbers: Iterable[int], seeds: Mapping[int, int]) -> dict[int, int]:
    """The derivative of each expression, as an expression; 0 where it does not change, as for truth values.

    Args:
        book: where all are written.
        numbers: the expressions and all that they are made of, in an order in which they can be computed.
        seeds: derivatives of inputs; those that are not there do not change.

    Raises:
        NotImplementedError: an operation has no rule.
    """
    found = dict(seeds)
    for number in numbers:
        if number not in found:
            op, args = book.nodes[number]
            rates = [found.get(i, ZERO) for i in args]
            moves = any(rates) and op not in _CONSTANT
            book.here = f"derivative of {book.origin[number]}"
            found[number] = _rate(_Writer(book), op, number, args, rates) if moves else ZERO
    return found


_CONSTANT = {"lt", "le", "eq", "and", "or", "not", "round", "floor", "ceil", "trunc"}
"""Operations whose results do not change, except for jumps."""


class _Writer:
    """Writes operations on expressions: ``w.mul(a, b)``."""

    def __init__(self, book: Expressions) -> None:
        self.book = book

    def __getattr__(self, op: str) -> Callable[..., int]:
        return lambda *args: self.book.apply(op, *(i if type(i) is int else self.book.constant(i) for i in args))


def _rate(w: _Writer, op: str, y: int, args: tuple[int, ...], rates: list[int]) -> int:
    """The derivative of ``y = op(args)``, whose arguments have these."""
    if op in ("add", "sub", "neg"):
        return int(getattr(w, op)(*rates))
    if op == "select":
        return w.select(args[0], rates[1], rates[2])
    if op in ("max", "min"):
        a, b = args
        return w.select(w.lt(b, a) if op == "max" else w.lt(a, b), *rates)
    if op == "norm":
        total = w.book.sum(w.mul(a, d) for a, d in zip(args, rates, strict=True))
        zero = w.eq(y, 0.0)  # where all are 0 their norm has an edge: nothing, as in reverse
        return w.select(zero, ZERO, w.div(total, w.select(zero, 1.0, y)))
    slopes = _SLOPES.get(op)
    if slopes is None:
        raise NotImplementedError(f"compile: {op} has no forward-mode derivative: take the gradient instead")
    return w.book.sum(w.mul(d, slope(w, y, *args)) for d, slope in zip(rates, slopes, strict=True) if d != ZERO)


def _over(w: _Writer, a: int, b: int, c: int) -> int:
    """``a`` over the sum of the squares of the others."""
    return w.div(a, w.add(w.mul(b, b), w.mul(c, c)))


def _one_minus_square(w: _Writer, x: int) -> int:
    return w.sub(1.0, w.mul(x, x))


_SLOPES: dict[str, tuple[Callable[..., int], ...]] = {
    "mul": (lambda w, y, a, b: b, lambda w, y, a, b: a),
    "div": (lambda w, y, a, b: w.div(1.0, b), lambda w, y, a, b: w.neg(w.div(y, b))),
    "sqrt": (lambda w, y, x: w.div(0.5, y),),
    "abs": (lambda w, y, x: w.select(w.lt(x, 0.0), -1.0, w.select(w.lt(0.0, x), 1.0, 0.0)),),
    "exp": (lambda w, y, x: y,),
    "expm1": (lambda w, y, x: w.add(y, 1.0),),
    "log": (lambda w, y, x: w.div(1.0, x),),
    "log1p": (lambda w, y, x: w.div(1.0, w.add(x, 1.0)),),
    "erf": (lambda w, y, x: w.mul(2 / math.sqrt(math.pi), w.exp(w.neg(w.mul(x, x)))),),
    "erfc": (lambda w, y, x: w.mul(-2 / math.sqrt(math.pi), w.exp(w.neg(w.mul(x, x)))),),
    "sin": (lambda w, y, x: w.cos(x),),
    "cos": (lambda w, y, x: w.neg(w.sin(x)),),
    "tan": (lambda w, y, x: w.add(1.0, w.mul(y, y)),),
    "asin": (lambda w, y, x: w.div(1.0, w.sqrt(_one_minus_square(w, x))),),
    "acos": (lambda w, y, x: w.div(-1.0, w.sqrt(_one_minus_square(w, x))),),
    "atan": (lambda w, y, x: w.div(1.0, w.add(1.0, w.mul(x, x))),),
    "sinh": (lambda w, y, x: w.cosh(x),),
    "cosh": (lambda w, y, x: w.sinh(x),),
    "tanh": (lambda w, y, x: _one_minus_square(w, y),),
    "atan2": (lambda w, y, a, b: _over(w, b, a, b), lambda w, y, a, b: w.neg(_over(w, a, a, b))),
    "hypot": (lambda w, y, a, b: w.div(a, y), lambda w, y, a, b: w.div(b, y)),
    "pow": (lambda w, y, a, b: w.mul(b, w.pow(a, w.sub(b, 1.0))), lambda w, y, a, b: w.mul(y, w.log(a))),
}
"""Partial derivatives of an operation by each argument: functions of the writer, the result and the arguments."""
