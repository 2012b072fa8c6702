"""Trees of one form, taken apart and put together by functions written for that form."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from torch import Tensor

from torchfra.tree import Late


def flattener(like: Any) -> Callable[[Any], tuple[Tensor, ...] | None]:
    """``flatten`` for trees of this form alone, faster; None for one that has something where this one has None.

    It is written as Python, as ``collections.namedtuple`` does: compiled filters call it in every step.
    """
    places = list(_places(like, "tree"))
    leaves = "".join(f"{at}, " for at, x in places if isinstance(x, Tensor))
    empty = " is ".join([*(at for at, x in places if x is None), "None"])
    function: Callable[[Any], tuple[Tensor, ...] | None] = eval(f"lambda tree: ({leaves}) if {empty} is None else None")
    return function


def unflattener(like: Any, places: Iterable[int] | None = None) -> Callable[[Sequence[Tensor]], Any]:
    """``unflatten`` for trees of this form alone, faster, as written code; tensors may be in other ``places``."""
    known: list[Any] = []
    place = itertools.count() if places is None else iter(places)

    def text(tree: Any) -> str:
        if isinstance(tree, Tensor):
            return f"tensors[{next(place)}]"
        parts = "".join(f"{text(part)}, " for part in tree) if isinstance(tree, tuple) else None
        if parts is not None and not hasattr(tree, "_fields"):
            return f"({parts})"
        known.append(tree if parts is None else type(tree))
        return f"known[{len(known) - 1}]" if parts is None else f"new(known[{len(known) - 1}], ({parts}))"

    function: Callable[[Sequence[Tensor]], Any] = eval(
        f"lambda tensors: {text(like)}", {"new": tuple.__new__, "known": known}
    )
    return function


def _places(tree: Any, at: str) -> Iterator[tuple[str, Any]]:
    """The leaves of a tree, whatever they are, and where they are."""
    if isinstance(tree, tuple):
        for i, part in enumerate(tree):
            yield from _places(part, f"{at}[{i}]")
    else:
        yield at, tree


def late(tree: Any) -> list[bool]:
    """For each tensor of a tree whether it is part of something ``Late``."""
    if isinstance(tree, tuple):
        return [isinstance(tree, Late) or part for branch in tree for part in late(branch)]
    return [False] if isinstance(tree, Tensor) else []
