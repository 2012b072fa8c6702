"""A tensor whose entries are expressions: torch code that runs on it writes its own arithmetic down, entry by entry.

What only moves entries (views, slices, cat, pad, ...) torch itself does on their numbers; the constant 0 has the number
0, so that what torch fills with zeros is right as well.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any

import torch
from torch import Tensor
from torch._decomp import decomposition_table
from torch.utils._pytree import tree_flatten, tree_map

from torchfra.kernel.expressions import ZERO, Expressions

aten = torch.ops.aten


class Entries(Tensor):
    """A tensor of expressions.

    Args:
        book: where the expressions are written.
        ids: int64, their numbers.
        dtype: of the tensor they stand for.
    """

    book: Expressions
    ids: Tensor

    @staticmethod
    def __new__(cls, book: Expressions, ids: Tensor, dtype: torch.dtype) -> Entries:  # noqa: D102
        made: Entries = Tensor._make_wrapper_subclass(cls, ids.shape, dtype=dtype)
        made.book, made.ids = book, ids.contiguous()
        return made

    def __init__(self, book: Expressions, ids: Tensor, dtype: torch.dtype) -> None:
        pass

    @classmethod
    def inputs(cls, book: Expressions, shape: Sequence[int], dtype: torch.dtype) -> Entries:
        """A tensor nothing is known of."""
        return _tensor(book, [book.input() for _ in range(torch.Size(shape).numel())], shape, dtype)

    @classmethod
    def constants(cls, book: Expressions, tensor: Tensor) -> Entries:
        """A tensor that is known."""
        if tensor.requires_grad:
            raise NotImplementedError("a tensor with a gradient that is no parameter or buffer: make it one")
        zeros = tensor._is_zerotensor() or tensor.is_meta  # what forward-mode differentiation leaves out
        values = [0.0] * tensor.numel() if zeros else tensor.detach().cpu().flatten().tolist()
        return _tensor(book, [book.constant(float(v)) for v in values], tensor.shape, tensor.dtype)

    def __repr__(self, *, tensor_contents: Any = None) -> str:  # type: ignore[override]
        return f"Entries({self.ids.tolist()})"

    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:  # type: ignore[override]
        kwargs = kwargs or {}
        book = next(x.book for x in tree_flatten((args, kwargs))[0] if isinstance(x, Entries))
        if func is aten._local_scalar_dense.default:
            raise NotImplementedError("the value of an entry is not known yet: choose by torch.where, not by if")
        if func in _SPECIAL:
            return _SPECIAL[func](book, *args, **kwargs)
        if func in _ENTRYWISE:
            return _entrywise(book, func, args, kwargs)
        if func in _MOVES:
            return _moved(book, func, args, kwargs)
        if func in _SHAPED:
            return func(*tree_map(_zeros, args), **kwargs)
        if func in _INPLACE and not args[0]._is_view():
            args[0].ids = cls.__torch_dispatch__(_INPLACE[func], types, args, kwargs).ids
            return args[0]
        if func in _DECOMPOSED and func not in _INPLACE:
            return _DECOMPOSED[func](*args, **kwargs)
        raise NotImplementedError(f"{func} has no form for single entries")


def entries(book: Expressions, x: Any) -> Entries:
    """The same as entries, if it is not yet."""
    return (
        x
        if isinstance(x, Entries)
        else Entries.constants(book, x if isinstance(x, Tensor) else torch.tensor(x, dtype=torch.float64))
    )


def _tensor(book: Expressions, numbers: Sequence[Any], shape: Sequence[int], dtype: torch.dtype) -> Entries:
    return Entries(book, torch.tensor(numbers, dtype=torch.int64).reshape(tuple(shape)), dtype)


def _meta(x: Any) -> Any:
    return torch.empty(x.shape, dtype=x.dtype, device="meta") if isinstance(x, Tensor) else x


def _zeros(x: Any) -> Any:
    return torch.zeros(x.shape, dtype=x.dtype) if isinstance(x, Entries) else x


def _moved(book: Expressions, func: Any, args: Any, kwargs: Any) -> Any:
    picks = func in _PICKS
    if picks and any(isinstance(x, Entries) for x in tree_flatten(args[1:])[0]):
        raise NotImplementedError(f"{func} by what is not known yet: choose by torch.where")
    whole = args[0] if picks else None

    def moves(x: Any) -> bool:  # what is known says where from
        return isinstance(x, Tensor) and (x is whole or not picks)

    def numbers(x: Any) -> Any:
        return entries(book, x).ids if moves(x) else x

    given = [x for x in tree_flatten(args)[0] if moves(x)]
    dtype = reduce(torch.promote_types, (x.dtype for x in given))
    moved = func(*tree_map(numbers, args), **{k: v for k, v in kwargs.items() if k not in _LAYOUT})
    return tree_map(lambda ids: Entries(book, ids, dtype), moved)


def _entrywise(book: Expressions, func: Any, args: Any, kwargs: Any) -> Entries:
    like = func(*map(_meta, args), **kwargs)
    ids = torch.broadcast_tensors(*(entries(book, x).ids for x in args))
    function = _ENTRYWISE[func]
    numbers = [function(book, *each, **kwargs) for each in zip(*(i.flatten().tolist() for i in ids), strict=True)]
    if like.dtype == torch.bool:
        numbers = [_truth(book, i) for i in numbers]
    return _tensor(book, numbers, like.shape, like.dtype)


def _folded(op: str, start: float | None = None) -> Callable[..., Entries]:
    """A reduction over some dimensions, or all."""
    convert = _truth if op in ("and", "or") else _value

    def reduction(book: Expressions, x: Entries, dim: Any = None, keepdim: bool = False, **_: Any) -> Entries:
        every = list(range(x.dim()))
        dims = [dim] if isinstance(dim, int) else dim or every
        dims = sorted({d % x.dim() for d in dims})
        kept = [d for d in every if d not in dims]
        first = [] if start is None else [book.constant(start)]
        rows = x.ids.permute(kept + dims).flatten(len(kept)).flatten(0, -2) if kept else x.ids.reshape(1, -1)
        numbers = [
            reduce(lambda a, b: book.apply(op, a, b), first + [convert(book, i) for i in row]) for row in rows.tolist()
        ]
        shape = [1 if d in dims else x.shape[d] for d in every if keepdim or d in kept]
        counts = torch.int64 if x.dtype == torch.bool and op in ("add", "mul") else x.dtype
        return _tensor(book, numbers, shape, torch.bool if op in ("and", "or") else counts)

    return reduction


def _largest(book: Expressions, x: Entries, dim: int, keepdim: bool = False) -> tuple[Entries, Entries]:
    """The largest along a dimension, and where it is."""
    rows = x.ids.movedim(dim, -1)
    found = []
    for row in rows.reshape(-1, rows.shape[-1]).tolist():
        best, at = row[0], ZERO
        for k, entry in enumerate(row[1:], 1):
            at = book.apply("select", book.apply("lt", best, entry), book.constant(k), at)
            best = book.apply("max", best, entry)
        found.append((best, at))
    shape = [1 if d == dim % x.dim() else x.shape[d] for d in range(x.dim()) if keepdim or d != dim % x.dim()]
    values, places = zip(*found, strict=True)
    return _tensor(book, values, shape, x.dtype), _tensor(book, places, shape, torch.int64)


def _scattered(book: Expressions, x: Tensor, dim: int, index: Tensor, source: Tensor) -> Tensor:
    """Entries put where an index says that need not be known."""
    parts = list(x.unbind(dim))
    for at, value in zip(index.unbind(dim), source.unbind(dim), strict=True):
        parts = [torch.where(at == j, value, part) for j, part in enumerate(parts)]
    return torch.stack(parts, dim)


def _product(book: Expressions, a: Any, b: Any) -> Entries:
    """Matrices ``(..., n, k)`` and ``(..., k, m)``."""
    a, b = entries(book, a), entries(book, b)
    rows, columns = torch.broadcast_tensors(a.ids.unsqueeze(-2), b.ids.mT.unsqueeze(-3))
    pairs = zip(rows.flatten(0, -2).tolist(), columns.flatten(0, -2).tolist(), strict=True)
    numbers = [book.sum(book.apply("mul", p, q) for p, q in zip(*pair, strict=True)) for pair in pairs]
    return _tensor(book, numbers, rows.shape[:-1], a.dtype)


def _solved(
    book: Expressions, a: Any, b: Any, *, upper: bool, left: bool = True, unitriangular: bool = False
) -> Entries:
    """``X`` with ``A X = B``, or ``X A = B`` if not ``left``."""
    a, b = entries(book, a), entries(book, b)
    if not left:
        x = _solved(book, _turned(a), _turned(b), upper=not upper, unitriangular=unitriangular)
        return _turned(x)
    batch = torch.broadcast_shapes(a.shape[:-2], b.shape[:-2])
    n, columns = b.shape[-2:]
    matrices = a.ids.expand((*batch, n, n)).reshape(-1, n, n).tolist()
    sides = b.ids.expand((*batch, n, columns)).reshape(-1, n, columns).tolist()
    solved = []
    for matrix, x in zip(matrices, sides, strict=True):
        done: list[int] = []
        for i in range(n - 1, -1, -1) if upper else range(n):
            for j in done:
                x[i] = [
                    book.apply("sub", p, book.apply("mul", matrix[i][j], q)) for p, q in zip(x[i], x[j], strict=True)
                ]
            if not unitriangular:
                x[i] = [book.apply("div", p, matrix[i][i]) for p in x[i]]
            done.append(i)
        solved.append(x)
    return _tensor(book, solved, (*batch, n, columns), b.dtype)


def _turned(x: Entries) -> Entries:
    return Entries(x.book, x.ids.mT, x.dtype)


def _cast(book: Expressions, x: Entries, *, dtype: torch.dtype | None = None, **_: Any) -> Entries:
    if dtype is None or dtype == x.dtype or (dtype.is_floating_point and x.dtype.is_floating_point):
        return Entries(book, x.ids, dtype or x.dtype)
    convert = _truth if dtype == torch.bool else _value if dtype.is_floating_point else _whole
    return _tensor(book, [convert(book, i) for i in x.ids.flatten().tolist()], x.shape, dtype)


def _padded(book: Expressions, x: Entries, pad: Sequence[int], value: float = 0.0) -> Entries:
    return Entries(book, torch.constant_pad_nd(x.ids, pad, book.constant(value)), x.dtype)


def _clamped(book: Expressions, x: Tensor, low: Any = None, high: Any = None) -> Tensor:
    x = x if low is None else x.clamp_min(low)
    return x if high is None else x.clamp_max(high)


def _norm(book: Expressions, x: Tensor, ord: float = 2, dim: Any = None, keepdim: bool = False, **_: Any) -> Tensor:
    if ord != 2:
        raise NotImplementedError(f"a norm of order {ord} has no form for single entries")
    return torch.sum(x * x, dim, keepdim).sqrt()


def _op(name: str) -> Callable[..., int]:
    return lambda book, *args: book.apply(name, *(_value(book, a) for a in args))


def _logic(name: str) -> Callable[..., int]:
    return lambda book, *args: book.apply(name, *(_truth(book, a) for a in args))


def _turn_round(function: Callable[..., int]) -> Callable[..., int]:
    return lambda book, a, b, **kwargs: function(book, b, a, **kwargs)


def _scaled(name: str) -> Callable[..., int]:
    """Addition or subtraction of a multiple."""
    return lambda book, a, b, alpha=1: _op(name)(book, a, book.apply("mul", _value(book, b), book.constant(alpha)))


def _truth(book: Expressions, a: int) -> int:
    """A mask."""
    return a if book.is_bool(a) or a in book.values else book.apply("not", book.apply("eq", a, book.constant(0.0)))


def _value(book: Expressions, a: int) -> int:
    """A number."""
    return book.apply("select", a, book.constant(1.0), book.constant(0.0)) if book.is_bool(a) else a


def _whole(book: Expressions, a: int) -> int:
    """A whole number, towards zero."""
    return _value(book, a) if book.is_bool(a) else book.apply("trunc", a)


def _choose(book: Expressions, mask: int, yes: int, no: int) -> int:
    if not (book.is_bool(yes) and book.is_bool(no)):
        yes, no = _value(book, yes), _value(book, no)
    return book.apply("select", _truth(book, mask), yes, no)


def _unequal(book: Expressions, a: int, b: int) -> int:
    return book.apply("not", book.apply("eq", a, b))


def _inverse(book: Expressions, a: int) -> int:
    return book.apply("div", book.constant(1.0), a)


def _power(book: Expressions, base: int, exponent: int) -> int:
    power = book.values.get(exponent)
    if power is None or power * 2 != round(power * 2) or abs(power) > 8:
        return book.apply("pow", base, exponent)
    if power < 0:
        return _inverse(book, _power(book, base, book.constant(-power)))
    factors = [book.constant(1.0)] + [base] * int(power)
    if power % 1:
        factors.append(book.apply("sqrt", base))
    return reduce(lambda a, b: book.apply("mul", a, b), factors)


def _sign(book: Expressions, a: int) -> int:
    zero, one = book.constant(0.0), book.constant(1.0)
    below = book.apply("select", book.apply("lt", a, zero), book.constant(-1.0), zero)
    return book.apply("select", book.apply("lt", zero, a), one, below)


def _remainder(book: Expressions, a: int, b: int) -> int:
    whole = book.apply("floor", book.apply("div", a, b))
    return book.apply("sub", a, book.apply("mul", whole, b))


def _mean(book: Expressions, x: Tensor, dim: Any = None, keepdim: bool = False, **_: Any) -> Tensor:
    total = torch.sum(x, dim, keepdim)
    return total * (total.numel() / x.numel())


def _sigmoid(book: Expressions, a: int) -> int:
    return _inverse(book, book.apply("add", book.constant(1.0), book.apply("exp", book.apply("neg", a))))


_LAYOUT = ("dtype", "layout", "device", "pin_memory", "memory_format")
_ENTRYWISE: dict[Any, Callable[..., int]] = {
    **{getattr(aten, name).default: _op(name) for name in (
        "neg", "abs", "sqrt", "exp", "expm1", "log", "log1p", "erf", "sin", "cos", "tan", "asin", "acos", "atan",
        "sinh", "cosh", "tanh", "atan2", "hypot", "round", "floor", "ceil", "trunc")},
    **{getattr(getattr(aten, name), kind): function for kind in ("Tensor", "Scalar") for name, function in (
        ("add", _scaled("add")), ("sub", _scaled("sub")), ("rsub", _turn_round(_scaled("sub"))), ("mul", _op("mul")),
        ("div", _op("div")), ("lt", _op("lt")), ("le", _op("le")), ("eq", _op("eq")), ("ne", _unequal),
        ("gt", _turn_round(_op("lt"))), ("ge", _turn_round(_op("le"))), ("remainder", _remainder))},
    **{getattr(torch.ops.prims, name).default: _op(name) for name in ("add", "sub", "mul", "div")},
    aten.reciprocal.default: _inverse,
    aten.rsqrt.default: lambda book, a: _inverse(book, book.apply("sqrt", a)),
    aten.pow.Tensor_Scalar: _power, aten.pow.Tensor_Tensor: _power,
    aten.sigmoid.default: _sigmoid, aten.sign.default: _sign, aten.sgn.default: _sign,
    aten.maximum.default: _op("max"), aten.minimum.default: _op("min"),
    aten.clamp_min.default: _op("max"), aten.clamp_min.Tensor: _op("max"),
    aten.clamp_max.default: _op("min"), aten.clamp_max.Tensor: _op("min"),
    **dict.fromkeys((aten.where.self, aten.where.ScalarSelf, aten.where.ScalarOther, aten.where.Scalar), _choose),
    **{op: lambda book, a, mask, value: _choose(book, mask, value, a)
       for op in (aten.masked_fill.Scalar, aten.masked_fill.Tensor)},
    aten.isnan.default: lambda book, a: _unequal(book, a, a),
    aten.logical_not.default: _logic("not"), aten.bitwise_not.default: _logic("not"),
    aten.logical_and.default: _logic("and"), aten.bitwise_and.Tensor: _logic("and"),
    aten.logical_or.default: _logic("or"), aten.bitwise_or.Tensor: _logic("or"),
}  # fmt: skip
"""What acts on each entry by itself."""

_SPECIAL: dict[Any, Callable[..., Any]] = {
    aten.mm.default: _product, aten.bmm.default: _product, aten.linalg_solve_triangular.default: _solved,
    aten.sum.dim_IntList: _folded("add", 0.0), aten.sum.default: _folded("add", 0.0),
    aten.amax.default: _folded("max"), aten.amin.default: _folded("min"), aten.max.dim: _largest,
    aten.scatter.src: _scattered,
    aten.max.default: _folded("max"), aten.min.default: _folded("min"), aten.prod.default: _folded("mul", 1.0),
    aten.mean.default: _mean, aten.mean.dim: _mean,
    aten.any.dim: _folded("or", 0.0), aten.any.default: _folded("or", 0.0),
    aten.all.dim: _folded("and", 1.0), aten.all.default: _folded("and", 1.0),
    aten.linalg_vector_norm.default: _norm, aten.constant_pad_nd.default: _padded, aten.clamp.default: _clamped,
    aten._to_copy.default: _cast, aten.to.dtype_layout: _cast,
    aten.to.dtype: lambda book, x, dtype, *_: _cast(book, x, dtype=dtype),
    aten.is_same_size.default: lambda book, a, b: a.shape == b.shape,
    aten._has_same_storage_numel.default: lambda book, a, b: a.numel() == b.numel(),
}  # fmt: skip
"""What needs more than that."""

_MOVES = {
    getattr(packet, name)
    for packet in (
        aten.view, aten._unsafe_view, aten._reshape_alias, aten.permute, aten.transpose, aten.t, aten.expand,
        aten.slice, aten.select, aten.unsqueeze, aten.squeeze, aten.cat, aten.stack, aten.unbind, aten.split,
        aten.split_with_sizes, aten.flip, aten.roll, aten.repeat, aten.index, aten.index_select, aten.gather,
        aten.clone, aten.alias, aten.detach, aten.conj_physical, aten._conj, aten.real,
        aten.broadcast_tensors, aten.diagonal, aten.diag_embed, aten.tril,
        aten.triu, aten.slice_scatter, aten.select_scatter, aten.diagonal_scatter, aten.slice_backward,
        aten.select_backward, aten.diagonal_backward,
    )
    for name in packet.overloads()
}  # fmt: skip
"""What only moves entries, or puts zeros between them."""

_PICKS = {getattr(op, name) for op in (aten.index, aten.index_select, aten.gather) for name in op.overloads()}
"""What moves entries as other tensors say."""

_SHAPED = {
    getattr(packet, name)
    for packet in (aten.zeros_like, aten.ones_like, aten.full_like, aten.empty_like, aten.new_zeros, aten.new_ones,
                   aten.new_full, aten.new_empty)
    for name in packet.overloads()
}  # fmt: skip
"""What looks at shapes and dtypes alone."""

_INPLACE = {
    aten.masked_fill_.Scalar: aten.masked_fill.Scalar, aten.masked_fill_.Tensor: aten.masked_fill.Tensor,
    aten.logical_and_.default: aten.logical_and.default,
}  # fmt: skip
"""What torch's own gradients do in place; never on a view, whose base would not see it."""

_DECOMPOSED = decomposition_table
