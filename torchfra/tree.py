"""Trees of tensors: maps over them, stacking, flattening and choices.

A tree is a tensor, None, or a tuple of trees; other values in a tuple (a number of columns, say) stay as they are.
Tensors begin with the dimensions of the batch and end with those of one track's entry, the event.  A tuple whose
fields differ in that says so with ``event_ranks``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from operator import attrgetter, is_
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

C = TypeVar("C", bound=type)
T = TypeVar("T")  # a tree
_RANKS: dict[type, dict[str, int]] = {}


def event_ranks(**ranks: int) -> Callable[[C], C]:
    """Decorates a ``NamedTuple``: how many dimensions one track's entry has in each field that is a tensor."""

    def register(cls: C) -> C:
        _RANKS[cls] = ranks
        return cls

    return register


def ranks(cls: type) -> dict[str, int]:
    """By field, the dimensions of one track's entry in a tuple of this class."""
    return _RANKS[cls]


def map_tensors(function: Callable[..., Any], tree: T, *others: T) -> T:
    """``function(x, ...)`` of the tensors of one tree, or of those at the same place in several."""
    if isinstance(tree, Tensor):
        return function(tree, *others)  # type: ignore[no-any-return]  # a tensor
    if not isinstance(tree, tuple):
        return tree
    make: Callable[..., Any] = getattr(type(tree), "_make", tuple)
    return make([map_tensors(function, *each) for each in zip(tree, *others, strict=True)])  # type: ignore[no-any-return]


def map_parts(function: Callable[[Any], Any], tree: T, *kinds: type) -> T:
    """``function(x)`` of all parts of a tree of these classes; the very same tree where that changes nothing."""
    if isinstance(tree, kinds):
        return function(tree)  # type: ignore[no-any-return]  # of the same class
    if not isinstance(tree, tuple):
        return tree
    parts = [map_parts(function, part, *kinds) for part in tree]
    make: Callable[..., Any] = getattr(type(tree), "_make", tuple)
    return tree if all(map(is_, parts, tree)) else make(parts)


def map_ranked(
    function: Callable[..., Any], tree: T, *others: T, rank: int | None = None, only: Collection[str] | None = None
) -> T:
    """``function(rank, x, ...)`` of all tensors, with the dimensions of one track's entry; a bare tensor has ``rank``.

    With ``only``, the other fields of the tuple stay as they are.

    Raises:
        TypeError: a tuple that has not said the ranks of its fields.
    """
    if only is None:
        return _mapped(function, rank, tree, *others)
    known = ranks(type(tree))
    return tree._replace(**{  # type: ignore[attr-defined,no-any-return]  # a tuple with such fields
        name: _mapped(function, known.get(name, type(tree)), *map(attrgetter(name), (tree, *others))) for name in only
    })  # fmt: skip


def _mapped(function: Callable[..., Any], rank: int | type | None, tree: T, *others: T) -> T:
    """``map_ranked``; instead of a rank it is given the class that does not say it."""
    if isinstance(tree, Tensor):
        if not isinstance(rank, int):
            raise TypeError(f"tree: expected tuples with event_ranks, received {getattr(rank, '__name__', 'a tensor')}")
        return function(rank, tree, *others)  # type: ignore[no-any-return]  # a tensor
    if not isinstance(tree, tuple):
        return tree
    cls = type(tree)
    each, fields = zip(tree, *others, strict=True), getattr(tree, "_fields", None)
    if fields is None:
        return tuple([_mapped(function, rank, *parts) for parts in each])  # type: ignore[return-value]  # a plain one
    ranks = _RANKS.get(cls, {})
    parts = zip(fields, each, strict=True)
    return cls(*[_mapped(function, ranks.get(name, cls), *part) for name, part in parts])


def flatten(tree: object) -> list[Tensor]:
    """The tensors of a tree, in order."""
    if isinstance(tree, tuple):
        return [x for part in tree for x in flatten(part)]
    return [tree] if isinstance(tree, Tensor) else []


def paths(tree: object, path: str = "") -> Iterator[tuple[str, Tensor]]:
    """The tensors of a tree with their paths: fields joined by dots, ``belief.mean``; ``part0`` in a plain tuple."""
    if isinstance(tree, Tensor):
        yield path, tree
    elif isinstance(tree, tuple):
        names = getattr(tree, "_fields", [f"part{i}" for i in range(len(tree))])
        for name, part in zip(names, tree, strict=True):
            yield from paths(part, f"{path}.{name}".lstrip("."))


def unflatten(like: T, tensors: Iterator[Tensor]) -> T:
    """A tree of the same form around other tensors."""
    # Not by the map: it is called in every step, of which that would take a tenth.
    if isinstance(like, tuple):
        make: Callable[..., Any] = getattr(type(like), "_make", tuple)
        return make([unflatten(part, tensors) for part in like])  # type: ignore[no-any-return]
    return next(tensors) if isinstance(like, Tensor) else like  # type: ignore[return-value]  # a tensor is a tree


class Late(NamedTuple):
    """Results that a step has of the step before it, such as a decision: they come one step late.

    ``one_earlier`` moves those of all steps to where they belong.
    """

    value: Any


def one_earlier(late: Late, end: T, dim: int, steps: int) -> T:
    """The results ``late`` of all steps, each moved to the step before, and ``end`` for the last of the ``steps``.

    Where there is room for one more step along ``dim``, the end is written there and nothing is copied.
    """

    def moved(value: Tensor, last: Tensor) -> Tensor:
        if value.shape[dim] == steps:
            return torch.cat([value.narrow(dim, 1, steps - 1), last.unsqueeze(dim)], dim)
        value.select(dim, steps).copy_(last)
        return value.narrow(dim, 1, steps)

    value: T = late.value
    return map_tensors(moved, value, end)


def detach(tree: T) -> T:
    """The tree with all tensors detached."""
    return map_tensors(Tensor.detach, tree)


def stack(trees: Sequence[T], dim: int) -> T:
    """Trees of one form stacked, their tensors broadcast to each other."""

    def stacked(*xs: Tensor) -> Tensor:
        shapes = [x.shape for x in xs]
        return torch.stack(xs if shapes.count(shapes[0]) == len(shapes) else torch.broadcast_tensors(*xs), dim)

    return map_tensors(stacked, *trees)


def unbind(tree: T, count: int) -> list[T]:
    """The ``count`` trees along the first dimension of all tensors."""
    if isinstance(tree, Tensor):
        return list(tree.unbind(0))  # type: ignore[arg-type]  # tensors
    if not isinstance(tree, tuple) or not tree:
        return [tree] * count
    make = getattr(type(tree), "_make", tuple)
    return list(map(make, zip(*(unbind(part, count) for part in tree), strict=True)))


def where(mask: Tensor, yes: T, no: T) -> T:
    """``yes`` where ``mask (...)``, else ``no``: trees of tensors that begin with the batch."""

    def choose(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(mask.reshape(mask.shape + (1,) * (max(a.dim(), b.dim()) - mask.dim())), a, b)

    return map_tensors(choose, yes, no)


def insert_batch_dimension(tree: T, only: Collection[str] | None = None) -> T:
    """One more dimension of size 1 at the end of the batch; what has no batch is shared and stays."""
    return map_ranked(lambda rank, x: x.unsqueeze(-1 - rank) if x.dim() > rank else x, tree, only=only)


def remove_batch_dimension(tree: T) -> T:
    """The reverse of ``insert_batch_dimension``."""
    return map_ranked(lambda rank, x: x.squeeze(-1 - rank) if x.dim() > rank else x, tree)


def where_needed(mask: Tensor, function: Callable[..., T], arguments: tuple[object, ...], default: T) -> T:
    """``function(*arguments)`` for the tracks in ``mask (...)`` alone, ``default`` for the others.

    Tracks are gathered, so this is for code that runs eagerly.

    Args:
        mask: which tracks.
        function: from arguments to what ``default`` is: a tree of tensors that begin with the batch.
        arguments: trees with ``event_ranks``, or vectors ``(..., m)``.
        default: for all tracks.
    """
    rows = mask.flatten().nonzero().squeeze(-1)
    if len(rows) == 0:
        return default

    def gather(rank: int, x: Tensor) -> Tensor:
        if x.dim() == rank:
            return x  # shared by all tracks
        event = x.shape[x.dim() - rank :]
        return x.expand(mask.shape + event).reshape((-1, *event))[rows]

    def scatter(values: Tensor, default: Tensor) -> Tensor:
        event = default.shape[mask.dim() :]
        return default.reshape((-1, *event)).index_put((rows,), values).reshape(default.shape)

    return map_tensors(scatter, function(*map_ranked(gather, arguments, rank=1)), default)
