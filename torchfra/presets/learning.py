"""Makes hyperparameters of a filter learnable without changing the motion and sensor of the caller."""

from __future__ import annotations

import copy
from collections.abc import Collection
from typing import TypeVar

from torchfra.filters.base import Filter
from torchfra.hyper import learnable, named, provide

F = TypeVar("F", bound=Filter)


def with_learning(f: F, names: Collection[str]) -> F:
    """Makes hyperparameters of a filter learnable; a motion or sensor that has some of them is copied first.

    Args:
        f: the filter, which is changed.
        names: see ``hyper.named``.

    Returns:
        The same filter.

    Raises:
        ValueError: a name that the filter does not have, or a value on the boundary of its range.
    """
    provide(f, names)
    inner: Filter = f
    while isinstance(further := getattr(inner, "inner", None), Filter):
        inner = further
    chosen = {id(hyper) for hyper in named(f, names).values() if not hyper.raw.requires_grad}
    for part in ("motion", "sensor"):
        model = getattr(inner, part)
        if any(id(hyper) in chosen for hyper in model.modules()):
            setattr(inner, part, copy.deepcopy(model))
    return learnable(f, names)
