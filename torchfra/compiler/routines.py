"""Functions of a large step that do the same for many hypotheses: their code is written once, and called for each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from torchfra import tree
from torchfra.compiler.entries import Entries, as_entries, entry_ids, pulled_back
from torchfra.compiler.expressions import Expressions, Routine
from torchfra.compiler.rewrites import with_quotients
from torchfra.compiler.schedule import cost, ordered
from torchfra.linalg.autograd import Context
from torchfra.linalg.batches import broadcast_shapes

_SHORT, _LONG = 60, 16_000
"""Expressions of a routine at least, and at most: a call of a short one saves little, long ones compile slowly."""

Function = Callable[..., Any]
"""From tensors to a tensor, or a tuple of them."""


def called_for_each(function: Function, ranks: Sequence[int], tensors: Sequence[Tensor]) -> Any:
    """``function(*tensors)`` of one track, by calls of routines: one for each entry of the batch.

    Entries of the batch use the same routine if the same arguments are the same constants, and the same arguments are
    equal.  So zeros are left out inside routines too.  Arguments and results of a call go through memory.

    Args:
        function: does the same for each entry; every result has the whole batch.
        ranks: of the tensors' events; what is in front of them is the batch.
        tensors: any.
    """
    book = next((x.book for x in tensors if isinstance(x, Entries)), None)
    if book is None or any(x.dtype == torch.bool for x in tensors):
        return function(*tensors)
    if torch.is_grad_enabled() and any(x.requires_grad for x in tensors):
        form: list[Any] = []
        leaves = _Differentiable.apply(function, ranks, form, *tensors)  # type: ignore[no-untyped-call]  # untyped in torch
        return tree.unflatten(form[0], iter(leaves))
    args = [as_entries(book, x) for x in tensors]
    batch = _batch(ranks, args)
    if not batch.numel():
        return function(*tensors)
    events = tuple(x.shape[x.dim() - rank :] for x, rank in zip(args, ranks, strict=True))
    rows = [x.ids.expand(batch + event).reshape(batch.numel(), -1) for x, event in zip(args, events, strict=True)]
    every = torch.cat(rows, -1).tolist()
    made = [_routine(book, function, events, args[0].dtype, _form(book, numbers)) for numbers in every]
    results = next((routine[1] for routine in made if routine is not None), None)
    if results is None:
        return function(*tensors)
    book.here = book.origins.here()
    found = {
        k: book.call(routine[0], _unknown(book, every[k])) for k, routine in enumerate(made) if routine is not None
    }
    others = [k for k, routine in enumerate(made) if routine is None]
    if others:  # written out
        parts = (Entries(book, row[others].reshape(len(others), *event), x.dtype)
                 for x, row, event in zip(args, rows, events, strict=True))  # fmt: skip
        leaves = [as_entries(book, x) for x in tree.flatten(function(*parts))]
        flat = torch.cat([x.ids.reshape(len(others), -1) for x in leaves], -1)
        found |= dict(zip(others, flat.tolist(), strict=True))
    outputs = tree.flatten(results)
    numbers = torch.tensor([found[k] for k in range(len(every))], dtype=torch.int64)
    pairs = zip(outputs, numbers.split([x.numel() for x in outputs], -1), strict=True)
    return tree.unflatten(results, (Entries(book, ids.reshape(batch + x.shape), x.dtype) for x, ids in pairs))


class _Context(Context):
    function: Function
    ranks: Sequence[int]


class _Differentiable(torch.autograd.Function):
    """The same, whose gradient is a call of a routine too."""

    @staticmethod
    def forward(ctx: _Context, function: Function, ranks: Sequence[int], form: list[Any], *tensors: Tensor) -> Any:
        form.append(called_for_each(function, ranks, tensors))
        ctx.save_for_backward(*tensors)
        ctx.function, ctx.ranks = function, ranks
        return tuple(tree.flatten(form[0]))

    @staticmethod
    def backward(ctx: _Context, *grads: Tensor) -> tuple[Tensor | None, ...]:
        tensors, wanted = ctx.saved_tensors, ctx.needs_input_grad[3:]
        before = len(_batch(ctx.ranks, tensors))
        ranks = (*ctx.ranks, *(x.dim() - before for x in grads))
        pulled = iter(called_for_each(_pullback(ctx.function, wanted), ranks, (*tensors, *grads)))
        sums = (next(pulled).sum_to_size(x.shape) if wants else None for x, wants in zip(tensors, wanted, strict=True))
        return None, None, None, *sums


@lru_cache(maxsize=64)
def _pullback(function: Function, wanted: tuple[bool, ...]) -> Function:
    """From the tensors of a function and the gradients of its results to those of the tensors that are wanted."""

    def back(*tensors: Tensor) -> tuple[Tensor, ...]:
        inputs = [x.detach().requires_grad_(wants) for x, wants in zip(tensors, wanted, strict=False)]
        with torch.enable_grad():
            results = tree.flatten(function(*inputs))
        follows = [(x, g) for x, g in zip(results, tensors[len(wanted) :], strict=True) if x.requires_grad]
        sources = [x for x in inputs if x.requires_grad]
        grads = pulled_back([x for x, _ in follows], [g for _, g in follows], sources)
        return tuple(torch.zeros_like(x) if g is None else g for x, g in zip(sources, grads, strict=True))

    back.__name__ = f"gradient_of_{_name(function)}"
    return back


def _name(function: Function) -> str:
    return function.__name__.strip("_")


def _batch(ranks: Sequence[int], tensors: Sequence[Tensor]) -> torch.Size:
    return broadcast_shapes(*(x.shape[: x.dim() - rank] for x, rank in zip(tensors, ranks, strict=True)))


def _unknown(book: Expressions, numbers: Iterable[int]) -> list[int]:
    """The numbers that are no constants, each once."""
    return list(dict.fromkeys(i for i in numbers if i not in book.values))


def _form(book: Expressions, numbers: Sequence[int]) -> tuple[int | str, ...]:
    """Which of the numbers are which constants, and which of the others are the same."""
    places = {number: place for place, number in enumerate(_unknown(book, numbers))}
    return tuple(places[i] if i in places else repr(book.values[i]) for i in numbers)


def _routine(
    book: Expressions,
    function: Function,
    events: tuple[torch.Size, ...],
    dtype: torch.dtype,
    form: tuple[int | str, ...],
) -> tuple[Routine, Any] | None:
    """The routine for such arguments, and results in the form of its own; None if it is too short or too long."""
    key = function, events, dtype, form
    if key not in book.routines:
        book.routines[key] = None  # no recursion: the same form inside it is written out
        name = f"{_name(function)}_r{len(book.routines)}"
        inner = book.nested()
        inputs = [inner.input() for _ in range(1 + max((x for x in form if isinstance(x, int)), default=-1))]
        numbers = torch.tensor([inputs[x] if isinstance(x, int) else inner.constant(float(x)) for x in form])
        parts = zip(numbers.split([event.numel() for event in events]), events, strict=True)
        results = function(*(Entries(inner, part.reshape(event), dtype) for part, event in parts))
        leaves = tree.flatten(results)
        outputs = [i for x in leaves for i in entry_ids(as_entries(inner, x))]
        live = inner.needed(outputs)
        if _SHORT <= len(live) <= _LONG and not any(x.dtype == torch.bool for x in leaves):
            inner, live = with_quotients(inner, live, set(live), outputs)
            before = {i: [a for a in inner.nodes[i][1] if a not in inner.values] for i in live if i not in inner.values}
            live = [i for i in ordered([*before], before, outputs) if inner.nodes[i][0] != "input"]
            book.routines[key] = Routine(name, inner, inputs, outputs, live, cost(inner, live)), results
    made: tuple[Routine, Any] | None = book.routines[key]
    return made


def called_by(book: Expressions, live: Iterable[int]) -> list[Routine]:
    """All routines that these expressions call; each before those that call it."""
    found: dict[str, Routine] = {}
    for routine in {book.calls[i].name: book.calls[i] for i in live if i in book.calls}.values():
        found |= {inner.name: inner for inner in called_by(routine.book, routine.live)}
        found[routine.name] = routine
    return list(found.values())
