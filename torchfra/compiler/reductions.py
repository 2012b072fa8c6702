"""Operations that combine many entries into one: sums, extremes, norms, matrix products, triangular solutions."""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import Any, TypeAlias

import torch
from torch import Tensor

from torchfra.compiler.entries import Entries, as_entries, from_numbers, unsupported
from torchfra.compiler.entrywise import number, truth_value
from torchfra.compiler.expressions import ZERO, Expressions
from torchfra.linalg.batches import broadcast_shapes

aten = torch.ops.aten

Dims: TypeAlias = int | list[int] | None
"""Dimensions of a tensor; None for all."""


def _reduction(op: str, start: float | None = None) -> Callable[..., Entries]:
    """A reduction over some dimensions, or all, by an operation of two numbers."""
    logical = op in ("and", "or")
    convert = truth_value if logical else number

    def reduction(book: Expressions, x: Entries, dim: Dims = None, keepdim: bool = False, **_: object) -> Entries:
        first = [] if start is None else [book.constant(start)]
        counts = torch.int64 if x.dtype == torch.bool and op in ("add", "mul") else x.dtype

        def combine(row: list[int]) -> int:
            return reduce(lambda a, b: book.apply(op, a, b), first + [convert(book, i) for i in row])

        return _reduced(x, dim, keepdim, combine, torch.bool if logical else counts)

    return reduction


def _reduced(x: Entries, dim: Dims, keepdim: bool, combine: Callable[[list[int]], int], dtype: torch.dtype) -> Entries:
    """What ``combine`` makes of the entries along some dimensions, or all."""
    every = list(range(x.dim()))
    dims = [dim] if isinstance(dim, int) else dim or every
    dims = sorted({d % x.dim() for d in dims})
    kept = [d for d in every if d not in dims]
    rows = x.ids.permute(kept + dims).flatten(len(kept)).flatten(0, -2) if kept else x.ids.reshape(1, -1)
    shape = [1 if d in dims else x.shape[d] for d in every if keepdim or d in kept]
    return from_numbers(x.book, [combine(row) for row in rows.tolist()], shape, dtype)


def _maximum_and_place(book: Expressions, x: Entries, dim: int, keepdim: bool = False) -> tuple[Entries, Entries]:
    """The largest entries along a dimension, and their indices."""
    rows = x.ids.movedim(dim, -1)
    values, places = [], []
    for row in rows.reshape(-1, rows.shape[-1]).tolist():
        best, at = row[0], ZERO
        for k, entry in enumerate(row[1:], 1):
            at = book.apply("select", book.apply("lt", best, entry), book.constant(k), at)
            best = book.apply("max", best, entry)
        values.append(best)
        places.append(at)
    shape = [1 if d == dim % x.dim() else x.shape[d] for d in range(x.dim()) if keepdim or d != dim % x.dim()]
    return from_numbers(book, values, shape, x.dtype), from_numbers(book, places, shape, torch.int64)


def _place(book: Expressions, x: Entries, dim: int | None = None, keepdim: bool = False) -> Entries:
    """The index of the largest entry along a dimension, or of all."""
    x = Entries(book, x.ids.flatten(), x.dtype) if dim is None else x
    return _maximum_and_place(book, x, 0 if dim is None else dim, keepdim)[1]


def _mean(book: Expressions, x: Tensor, dim: Dims = None, keepdim: bool = False, **_: object) -> Tensor:
    total = torch.sum(x, dim, keepdim)
    return total * (total.numel() / x.numel())


def _logsumexp(book: Expressions, x: Tensor, dim: list[int], keepdim: bool = False) -> Tensor:
    largest = torch.amax(x, dim, True)
    largest = torch.where(largest.abs() == torch.inf, 0.0, largest)
    total = torch.log(torch.sum(torch.exp(x - largest), dim, True)) + largest
    return total if keepdim else torch.squeeze(total, dim)


# These two as torch takes them apart, for whose way torch would first load distributed tensors and sympy: a second.
def _softmax(book: Expressions, x: Tensor, dim: int, half_to_float: bool) -> Tensor:
    weight = torch.exp(x - torch.amax(x, dim, True))
    return weight / torch.sum(weight, dim, True)


def _log_softmax(book: Expressions, x: Tensor, dim: int, half_to_float: bool) -> Tensor:
    shifted = x - torch.amax(x, dim, True)
    return shifted - torch.log(torch.sum(torch.exp(shifted), dim, True))


def _norm(
    book: Expressions,
    x: Entries,
    ord: float = 2,
    dim: Dims = None,
    keepdim: bool = False,
    **_: object,
) -> Entries:
    if ord != 2:
        raise unsupported(aten.linalg_vector_norm.default, f"with order {ord}; order 2 can")
    return _reduced(x, dim, keepdim, lambda row: book.apply("norm", *row), x.dtype)


def _matrix_product(book: Expressions, a: object, b: object) -> Entries:
    """Product of matrices ``(..., n, k)`` and ``(..., k, m)``."""
    a, b = as_entries(book, a), as_entries(book, b)
    rows, columns = torch.broadcast_tensors(a.ids.unsqueeze(-2), b.ids.mT.unsqueeze(-3))
    pairs = zip(rows.flatten(0, -2).tolist(), columns.flatten(0, -2).tolist(), strict=True)
    numbers = [  # the number of the constant 0 is false
        book.sum(book.apply("mul", p, q) for p, q in zip(*pair, strict=True) if p and q) for pair in pairs
    ]
    return from_numbers(book, numbers, rows.shape[:-1], a.dtype)


def _solve_triangular(
    book: Expressions, a: object, b: object, *, upper: bool, left: bool = True, unitriangular: bool = False
) -> Entries:
    """``X`` with ``A X = B``, or ``X A = B`` if not ``left``."""
    a, b = as_entries(book, a), as_entries(book, b)
    if not left:
        x = _solve_triangular(book, _transpose(a), _transpose(b), upper=not upper, unitriangular=unitriangular)
        return _transpose(x)
    batch = broadcast_shapes(a.shape[:-2], b.shape[:-2])
    n, columns = b.shape[-2:]
    matrices = a.ids.expand((*batch, n, n)).reshape(-1, n, n).tolist()
    sides = b.ids.expand((*batch, n, columns)).reshape(-1, n, columns).tolist()
    solutions = [_substitute(book, matrix, x, upper, unitriangular) for matrix, x in zip(matrices, sides, strict=True)]
    return from_numbers(book, solutions, (*batch, n, columns), b.dtype)


def _substitute(
    book: Expressions, matrix: list[list[int]], x: list[list[int]], upper: bool, unitriangular: bool
) -> list[list[int]]:
    """Forward or backward substitution; the right side becomes the solution, row by row."""
    done: list[int] = []
    for i in reversed(range(len(x))) if upper else range(len(x)):
        for j in done:
            x[i] = [book.apply("sub", p, book.apply("mul", matrix[i][j], q)) for p, q in zip(x[i], x[j], strict=True)]
        if not unitriangular:
            x[i] = [book.apply("div", p, matrix[i][i]) for p in x[i]]
        done.append(i)
    return x


def _transpose(x: Entries) -> Entries:
    return Entries(x.book, x.ids.mT, x.dtype)


_sum, _product, _maximum, _minimum = (
    _reduction("add", 0.0),
    _reduction("mul", 1.0),
    _reduction("max"),
    _reduction("min"),
)
_any, _all = _reduction("or", 0.0), _reduction("and", 1.0)

REDUCTIONS: dict[Any, Callable[..., Any]] = {
    aten.sum.default: _sum, aten.sum.dim_IntList: _sum, aten.prod.default: _product,
    aten.mean.default: _mean, aten.mean.dim: _mean,
    aten._softmax.default: _softmax, aten._log_softmax.default: _log_softmax,
    aten.logsumexp.default: _logsumexp, aten.linalg_vector_norm.default: _norm,
    aten.amax.default: _maximum, aten.max.default: _maximum, aten.max.dim: _maximum_and_place,
    aten.argmax.default: _place, aten.amin.default: _minimum, aten.min.default: _minimum,
    aten.any.default: _any, aten.any.dim: _any, aten.all.default: _all, aten.all.dim: _all,
    aten.mm.default: _matrix_product, aten.bmm.default: _matrix_product,
    aten.linalg_solve_triangular.default: _solve_triangular,
}  # fmt: skip
