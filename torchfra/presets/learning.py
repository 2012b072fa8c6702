"""Makes hyperparameters of a filter learnable without changing the motion and sensor that it was made from."""

from __future__ import annotations

import copy
from collections.abc import Collection
from typing import TypeVar

from torchfra.filters.base import Filter
from torchfra.hyper import learnable, named, provide

F = TypeVar("F", bound=Filter)


def with_learning(f: F, names: Collection[str]) -> F:
    """The filter with these hyperparameters learnable; a motion or sensor that has some of them is copied first.

    Args:
        f: it is changed and returned.
        names: as in ``hyper.named``.

    Raises:
        ValueError: a name that the filter does not have, or a value on the edge of its range.
    """
    provide(f, names)
    inner: Filter = f
    while isinstance(around := getattr(inner, "inner", None), Filter):
        inner = around
    chosen = {id(hyper) for hyper in named(f, names).values() if not hyper.raw.requires_grad}
    for part in ("motion", "sensor"):
        model = getattr(inner, part)
        if any(id(hyper) in chosen for hyper in model.modules()):
            setattr(inner, part, copy.deepcopy(model))
    return learnable(f, names)
