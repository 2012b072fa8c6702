"""Tuples of tensors: one map over all of them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from torch import Tensor


def flatten(tree: Any) -> list[Tensor]:
    """The tensors in tuples of tuples; None is none."""
    if isinstance(tree, tuple):
        return [x for part in tree for x in flatten(part)]
    return [] if tree is None else [tree]


def unflatten(like: Any, tensors: Iterator[Tensor]) -> Any:
    """Tuples of this form around other tensors."""
    if isinstance(like, tuple):
        parts: list[Any] = [None if part is None else unflatten(part, tensors) for part in like]
        return type(like)(*parts) if hasattr(like, "_fields") else tuple(parts)
    return next(tensors)
