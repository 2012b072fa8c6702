"""Operations that only move entries (views, slices, cat, ...), fill with known values, or change the dtype.

Torch itself moves the numbers of the expressions.  The constant 0 has the number 0, so that zeros that torch fills in
are right as well.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any

import torch
from torch import Tensor
from torch._ops import OpOverload, OpOverloadPacket

from torchfra.compiler.entries import Entries, as_entries, each, from_numbers, leaves, unsupported
from torchfra.compiler.entrywise import integer, number, truth_value
from torchfra.compiler.expressions import ZERO, Expressions

aten = torch.ops.aten


def _overloads(*packets: OpOverloadPacket) -> set[Any]:
    return {getattr(packet, name) for packet in packets for name in packet.overloads()}


MOVES = _overloads(
    aten.view, aten._unsafe_view, aten._reshape_alias, aten.permute, aten.transpose, aten.t, aten.expand,
    aten.slice, aten.select, aten.unsqueeze, aten.squeeze, aten.cat, aten.stack, aten.unbind, aten.split,
    aten.split_with_sizes, aten.flip, aten.roll, aten.repeat, aten.index, aten.index_select, aten.gather,
    aten.clone, aten.alias, aten.detach, aten.conj_physical, aten._conj, aten.real, aten.broadcast_tensors,
    aten.diagonal, aten.diag_embed, aten.tril, aten.triu, aten.slice_scatter, aten.select_scatter,
    aten.diagonal_scatter, aten.as_strided, aten.slice_backward, aten.select_backward, aten.diagonal_backward,
)  # fmt: skip
"""Operations that only move entries, or put zeros between them."""

INDEXED = _overloads(aten.index, aten.index_select, aten.gather)
"""Operations among these whose indices come from another tensor, which must be known."""

SHAPES = _overloads(
    aten.zeros_like, aten.ones_like, aten.full_like, aten.empty_like,
    aten.new_zeros, aten.new_ones, aten.new_full, aten.new_empty,
)  # fmt: skip
"""Operations that look at shapes and dtypes alone."""

_LAYOUT = ("dtype", "layout", "device", "pin_memory", "memory_format")


def move(book: Expressions, func: OpOverload, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Moves entries by moving the numbers of their expressions."""
    indexed = func in INDEXED
    if indexed and any(isinstance(x, Entries) for x in leaves(args[1:])):
        if func is aten.gather.default:
            return _gather(*args, **kwargs)
        raise unsupported(func, "the index depends on data; choose by torch.where")

    def is_moved(x: object) -> bool:
        return isinstance(x, Tensor) and (x is args[0] or not indexed)

    def ids(x: object) -> Any:
        return as_entries(book, x).ids if is_moved(x) else x

    func = aten.reshape.default if func in (aten.view.default, aten._unsafe_view.default) else func
    dtype = reduce(torch.promote_types, (x.dtype for x in leaves(args) if is_moved(x)))
    moved = func(*each(ids, args), **{k: v for k, v in kwargs.items() if k not in _LAYOUT})
    return each(lambda x: Entries(book, x, dtype), moved)


def shaped(book: Expressions, func: OpOverload, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Makes a tensor of known values that needs nothing but the shape of its argument."""
    return Entries.constants(book, func(*each(_zeros, args), **kwargs))


def _zeros(x: object) -> Any:
    return torch.zeros(x.shape, dtype=x.dtype) if isinstance(x, Entries) else x


def _gather(x: Tensor, dim: int, index: Tensor, **_: object) -> Tensor:
    """Takes entries from indices that are not known."""
    rows = [row.unsqueeze(dim) for row in _cut(x, dim, index).unbind(dim)]
    taken: Tensor = rows[0].expand(index.shape)
    for j, row in enumerate(rows[1:], 1):
        taken = torch.where(index == j, row, taken)
    return taken


def _cut(x: Tensor, dim: int, index: Tensor) -> Tensor:
    """The part of a tensor that lies beside an index, of all that are along ``dim``."""
    along = dim % x.dim()
    part: Tensor = x[tuple(slice(None if d == along else index.shape[d]) for d in range(x.dim()))]
    return part


def _scatter_add(book: Expressions, x: Tensor, dim: int, index: Tensor, source: Tensor) -> Tensor:
    """Adds entries to what is at indices that need not be known."""
    parts, beside = [], _cut(source, dim, index)
    for j, part in enumerate(x.unbind(dim)):
        added = torch.where(index == j, beside, 0.0).sum(dim)
        parts.append(part + added)
    return torch.stack(parts, dim)


def _scatter(book: Expressions, x: Tensor, dim: int, index: Tensor, source: Tensor) -> Tensor:
    """Puts entries to indices that need not be known."""
    parts = list(x.unbind(dim))
    for at, value in zip(index.unbind(dim), source.unbind(dim), strict=True):
        parts = [torch.where(at == j, value, part) for j, part in enumerate(parts)]
    return torch.stack(parts, dim)


def _index_put(
    book: Expressions, x: Tensor, indices: Sequence[Tensor | None], values: Tensor, accumulate: bool = False
) -> Entries:
    """Puts entries to known indices, or adds them to what is there."""
    if any(isinstance(i, Entries) for i in indices):
        raise unsupported("index_put", "the index depends on data; choose by torch.where")
    places = torch.arange(x.numel()).reshape(x.shape)[tuple(slice(None) if i is None else i for i in indices)]
    numbers, new = as_entries(book, x).ids.flatten().tolist(), as_entries(book, values).ids.expand(places.shape)
    for place, value in zip(places.flatten().tolist(), new.flatten().tolist(), strict=True):
        numbers[place] = book.apply("add", numbers[place], value) if accumulate else value
    return from_numbers(book, numbers, x.shape, x.dtype)


def cast(book: Expressions, x: Entries, *, dtype: torch.dtype | None = None, **_: object) -> Entries:
    """Entries in another dtype; all numbers of a kernel have one precision."""
    if dtype is None or dtype == x.dtype or (dtype.is_floating_point and x.dtype.is_floating_point):
        return Entries(book, x.ids.clone(), dtype or x.dtype)
    convert = truth_value if dtype == torch.bool else number if dtype.is_floating_point else integer
    return from_numbers(book, [convert(book, i) for i in x.ids.flatten().tolist()], x.shape, dtype)


def _cast_to(book: Expressions, x: Entries, dtype: torch.dtype, *_: object) -> Entries:
    return cast(book, x, dtype=dtype)


def _pad(book: Expressions, x: Entries, pad: Sequence[int], value: float = 0.0) -> Entries:
    return Entries(book, torch.constant_pad_nd(x.ids, pad, book.constant(value)), x.dtype)


def _clamp(book: Expressions, x: Tensor, low: float | None = None, high: float | None = None) -> Tensor:
    x = x if low is None else x.clamp_min(low)
    return x if high is None else x.clamp_max(high)


def _laid_out(book: Expressions, x: Tensor, shape: Sequence[int], strides: Sequence[int], **_: object) -> Entries:
    """A new tensor of this layout, all 0."""
    return Entries(book, torch.empty_strided(shape, strides, dtype=torch.int64).fill_(ZERO), x.dtype)


def _laid_out_like(book: Expressions, x: Tensor, other: Tensor, **_: object) -> Entries:
    """The same with the layout of another tensor."""
    return _laid_out(book, x, other.shape, other.stride())


def _copied(book: Expressions, x: Tensor, source: Tensor, *_: object) -> Entries:
    """What ``copy_`` writes into a tensor."""
    return as_entries(book, source)


def _same_shape(book: Expressions, a: Tensor, b: Tensor) -> bool:
    return a.shape == b.shape


def _same_size(book: Expressions, a: Tensor, b: Tensor) -> bool:
    return a.numel() == b.numel()


OTHERS: dict[Any, Callable[..., Any]] = {
    aten.scatter.src: _scatter, aten.scatter_add.default: _scatter_add, aten.index_put.default: _index_put,
    aten.copy.default: _copied,
    aten.constant_pad_nd.default: _pad, aten.clamp.default: _clamp,
    aten._to_copy.default: cast, aten.to.dtype_layout: cast, aten.to.dtype: _cast_to,
    aten.new_empty_strided.default: _laid_out, aten._new_zeros_with_same_feature_meta.default: _laid_out_like,
    aten.is_same_size.default: _same_shape, aten._has_same_storage_numel.default: _same_size,
}  # fmt: skip
"""Operations on entries with a function of their own."""
