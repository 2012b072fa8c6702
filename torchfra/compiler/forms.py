"""Tensors and trees of one form: recognised, taken apart and put together by functions for that form."""

from __future__ import annotations

import importlib
import itertools
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from functools import wraps
from typing import Any

import torch
from torch import Tensor

from torchfra.linalg.autograd import Context
from torchfra.tree import Late

_HOOKS: Callable[[bool], object] | None = getattr(
    getattr(torch._C, "_autograd", None), "_top_saved_tensors_default_hooks", None
)
"""It is private: versions may differ."""


def guard(tensors: Sequence[Tensor]) -> Callable[..., bool]:
    """What says whether other tensors have the form of these: torch's own, in C++, or a slower one of ours."""
    sizes, strides = [list(x.shape) for x in tensors], [list(x.stride()) for x in tensors]
    try:
        guards = importlib.import_module("torch._C._dynamo.guards").TensorGuards
        check: Callable[..., bool] = guards(*tensors, dynamic_dims_sizes=sizes, dynamic_dims_strides=strides).check
    except (ImportError, AttributeError, TypeError):  # it is private: versions may differ
        forms = [_form(x) for x in tensors]
        return lambda *others: [_form(x) for x in others] == forms
    return check


def hooked() -> bool:
    """Whether what is saved for a gradient pass may come back otherwise: stored elsewhere, or computed anew.

    True also where torch does not tell.
    """
    return _HOOKS is None or _HOOKS(False) is not None


def _form(x: Tensor) -> Hashable:
    if not isinstance(x, Tensor):
        return type(x)
    return type(x), x.dtype, x.device, x.shape, x.stride(), x.requires_grad, x.is_neg(), x.is_conj(), x._is_zerotensor()


def savable(x: Tensor) -> Tensor:
    """The tensor, or a copy of one that was made in inference mode, which autograd saves for no gradient pass."""
    return x.clone() if x.is_inference() else x


def flattener(like: object) -> Callable[[Any], tuple[Tensor, ...] | None]:
    """``flatten`` for trees of this form alone, faster; None for one that has something where this one has None.

    It is written as Python, as ``collections.namedtuple`` does: compiled filters call it in every step.
    """
    places = list(_places(like, "tree"))
    leaves = "".join(f"{at}, " for at, x in places if isinstance(x, Tensor))
    empty = " is ".join([*(at for at, x in places if x is None), "None"])
    function: Callable[[Any], tuple[Tensor, ...] | None] = eval(f"lambda tree: ({leaves}) if {empty} is None else None")
    return function


def unflattener(like: object, places: Iterable[int] | None = None) -> Callable[[Sequence[Tensor]], Any]:
    """``unflatten`` for trees of this form alone, faster, as written code; tensors may be in other ``places``."""
    known: list[Any] = []
    place = itertools.count() if places is None else iter(places)

    def text(tree: object) -> str:
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


def _places(tree: object, at: str) -> Iterator[tuple[str, Any]]:
    """The leaves of a tree, whatever they are, and where they are."""
    if isinstance(tree, tuple):
        for i, part in enumerate(tree):
            yield from _places(part, f"{at}[{i}]")
    else:
        yield at, tree


def late(tree: object) -> list[bool]:
    """For each tensor of a tree whether it is part of something ``Late``."""
    if isinstance(tree, tuple):
        return [isinstance(tree, Late) or part for branch in tree for part in late(branch)]
    return [False] if isinstance(tree, Tensor) else []


def first_order(backward: Callable[..., tuple[Tensor | None, ...]]) -> Callable[..., tuple[Tensor | None, ...]]:
    """A ``backward`` of an autograd function whose gradients have no gradients: to ask for these says what to take.

    (``torch.autograd.function.once_differentiable`` says so only where the gradients of the results have gradients.)
    """

    @wraps(backward)
    def call(ctx: Context, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        with torch.no_grad():
            found = backward(ctx, *grads)
        if not torch.is_grad_enabled():
            return found
        places = [i for i, x in enumerate(found) if isinstance(x, Tensor)]
        moving = [x for x in (*ctx.saved_tensors, *grads) if isinstance(x, Tensor) and x.requires_grad]
        tied = _FirstOrder.apply(len(places), *(found[i] for i in places), *moving)  # type: ignore[no-untyped-call]
        by_place = dict(zip(places, tied, strict=True))
        return tuple(by_place.get(i) for i in range(len(found)))

    return call


class _FirstOrder(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Context, count: int, *tensors: Tensor) -> tuple[Tensor, ...]:
        return tuple(x.view_as(x) for x in tensors[:count])

    @staticmethod
    def backward(ctx: Context, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        second = "take torchfra.filters.hessian.hessian, or the filter before compile()"
        raise NotImplementedError(f"compiled filters have gradients of first order, and none of second: {second}")
