"""Operations that act on each entry by itself: how torch's functions of numbers are written as expressions."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import reduce
from typing import Any

import torch
from torch import Tensor
from torch._ops import OpOverload

from torchfra.compiler.entries import Entries, as_entries, from_numbers
from torchfra.compiler.expressions import Expressions

aten = torch.ops.aten
Function = Callable[..., int]
"""From expressions and the numbers of some of them to the number of another."""


def entrywise(book: Expressions, func: OpOverload, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Entries:
    """Applies a function of ``ENTRYWISE`` to each entry of what its arguments broadcast to."""
    like = func(*map(_sample, args), **kwargs)
    ids = torch.broadcast_tensors(*(as_entries(book, x).ids for x in args))
    function = ENTRYWISE[func]
    numbers = [function(book, *each, **kwargs) for each in zip(*(i.flatten().tolist() for i in ids), strict=True)]
    if like.dtype == torch.bool:
        numbers = [truth_value(book, i) for i in numbers]
    return from_numbers(book, numbers, like.shape, like.dtype)


def _sample(x: object) -> Any:
    """A tensor of this form, for the form of a result: not a meta tensor, for which torch may import its compiler."""
    return torch.ones(x.shape, dtype=x.dtype) if isinstance(x, Tensor) else x


def truth_value(book: Expressions, a: int) -> int:
    """True where a number is not 0."""
    return a if book.is_bool(a) or a in book.values else book.apply("not", book.apply("eq", a, book.constant(0.0)))


def number(book: Expressions, a: int) -> int:
    """1 for True and 0 for False; numbers stay."""
    return book.apply("select", a, book.constant(1.0), book.constant(0.0)) if book.is_bool(a) else a


def integer(book: Expressions, a: int) -> int:
    """A number rounded towards zero."""
    return number(book, a) if book.is_bool(a) else book.apply("trunc", a)


def _arithmetic(name: str) -> Function:
    def function(book: Expressions, *args: int) -> int:
        if book.truths.isdisjoint(args):
            return book.apply(name, *args)
        return book.apply(name, *(number(book, a) for a in args))

    return function


def _logic(name: str) -> Function:
    return lambda book, *args: book.apply(name, *(truth_value(book, a) for a in args))


def _swapped(function: Function) -> Function:
    return lambda book, a, b, **kwargs: function(book, b, a, **kwargs)


def _with_multiple(name: str) -> Function:
    """Addition or subtraction of ``alpha`` times the second argument."""
    plain = _arithmetic(name)

    def function(book: Expressions, a: int, b: int, alpha: float = 1) -> int:
        return plain(book, a, b if alpha == 1 else book.apply("mul", number(book, b), book.constant(alpha)))

    return function


def _where(book: Expressions, mask: int, yes: int, no: int) -> int:
    if not (book.is_bool(yes) and book.is_bool(no)):
        yes, no = number(book, yes), number(book, no)
    return book.apply("select", truth_value(book, mask), yes, no)


def _masked_fill(book: Expressions, a: int, mask: int, value: int) -> int:
    return _where(book, mask, value, a)


def _unequal(book: Expressions, a: int, b: int) -> int:
    return book.apply("not", book.apply("eq", a, b))


def _is_nan(book: Expressions, a: int) -> int:
    return _unequal(book, a, a)


def _reciprocal(book: Expressions, a: int) -> int:
    return book.apply("div", book.constant(1.0), a)


def _reciprocal_root(book: Expressions, a: int) -> int:
    return _reciprocal(book, book.apply("sqrt", a))


def _power(book: Expressions, base: int, exponent: int) -> int:
    power = book.values.get(exponent)
    if power is None or power * 2 != round(power * 2) or abs(power) > 8:
        return book.apply("pow", base, exponent)
    if power < 0:
        return _reciprocal(book, _power(book, base, book.constant(-power)))
    factors = [book.constant(1.0)] + [base] * int(power)
    if power % 1:
        factors.append(book.apply("sqrt", base))
    return reduce(lambda a, b: book.apply("mul", a, b), factors)


def _sign(book: Expressions, a: int) -> int:
    zero, one = book.constant(0.0), book.constant(1.0)
    negative = book.apply("select", book.apply("lt", a, zero), book.constant(-1.0), zero)
    return book.apply("select", book.apply("lt", zero, a), one, negative)


def _remainder(book: Expressions, a: int, b: int) -> int:
    multiple = book.apply("floor", book.apply("div", a, b))
    return book.apply("sub", a, book.apply("mul", multiple, b))


def _sinc(book: Expressions, a: int) -> int:
    angle, zero, one = book.apply("mul", a, book.constant(math.pi)), book.constant(0.0), book.constant(1.0)
    at_zero = book.apply("eq", angle, zero)
    return book.apply("select", at_zero, one, book.apply("div", book.apply("sin", angle), angle))


def _sigmoid(book: Expressions, a: int) -> int:
    return _reciprocal(book, book.apply("add", book.constant(1.0), book.apply("exp", book.apply("neg", a))))


ENTRYWISE: dict[Any, Function] = {
    **{getattr(aten, name).default: _arithmetic(name) for name in (
        "neg", "abs", "sqrt", "exp", "expm1", "log", "log1p", "erf", "erfc", "lgamma", "sin", "cos", "tan", "asin",
        "acos", "atan", "sinh", "cosh", "tanh", "atan2", "hypot", "round", "floor", "ceil", "trunc")},
    **{getattr(getattr(aten, name), kind): function for kind in ("Tensor", "Scalar") for name, function in (
        ("add", _with_multiple("add")), ("sub", _with_multiple("sub")), ("rsub", _swapped(_with_multiple("sub"))),
        ("mul", _arithmetic("mul")), ("div", _arithmetic("div")), ("remainder", _remainder),
        ("lt", _arithmetic("lt")), ("le", _arithmetic("le")), ("eq", _arithmetic("eq")), ("ne", _unequal),
        ("gt", _swapped(_arithmetic("lt"))), ("ge", _swapped(_arithmetic("le"))))},
    **{getattr(torch.ops.prims, name).default: _arithmetic(name) for name in ("add", "sub", "mul", "div")},
    aten.reciprocal.default: _reciprocal, aten.rsqrt.default: _reciprocal_root,
    aten.pow.Tensor_Scalar: _power, aten.pow.Tensor_Tensor: _power, aten.pow.Scalar: _power,
    aten.sigmoid.default: _sigmoid, aten.sinc.default: _sinc, aten.sign.default: _sign, aten.sgn.default: _sign,
    aten.maximum.default: _arithmetic("max"), aten.minimum.default: _arithmetic("min"),
    aten.clamp_min.default: _arithmetic("max"), aten.clamp_min.Tensor: _arithmetic("max"),
    aten.clamp_max.default: _arithmetic("min"), aten.clamp_max.Tensor: _arithmetic("min"),
    **dict.fromkeys((aten.where.self, aten.where.ScalarSelf, aten.where.ScalarOther, aten.where.Scalar), _where),
    aten.masked_fill.Scalar: _masked_fill, aten.masked_fill.Tensor: _masked_fill,
    aten.isnan.default: _is_nan,
    aten.logical_not.default: _logic("not"), aten.bitwise_not.default: _logic("not"),
    **{getattr(getattr(aten, f"{kind}_{name}"), form): _logic(name) for name in ("and", "or")
       for kind, form in (("logical", "default"), ("bitwise", "Tensor"), ("bitwise", "Scalar"))},
}  # fmt: skip
