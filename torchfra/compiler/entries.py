"""A tensor whose entries are expressions: torch code that runs on it writes its own arithmetic down, entry by entry."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor
from torch._ops import OpOverload

from torchfra.compiler.expressions import Expressions
from torchfra.linalg.autograd import Context

Rule = Callable[[Expressions, Any, Any, Any], Any]
"""From the expressions, the operation of torch, its arguments and its keywords to what the operation returns."""

RULES: dict[Any, Rule] = {}
"""How each operation of torch acts on entries; ``operations`` fills it."""


class Entries(Tensor):
    """A tensor of expressions.

    Args:
        book: where the expressions are written.
        ids: int64, the numbers of the entries' expressions.  Views share them, so that a write in place reaches the
            tensor that is viewed, as in torch.
        dtype: of the tensor they stand for.
    """

    book: Expressions
    ids: Tensor

    @staticmethod
    def __new__(cls, book: Expressions, ids: Tensor, dtype: torch.dtype) -> Entries:  # noqa: D102
        made: Entries = Tensor._make_wrapper_subclass(
            cls, ids.shape, strides=ids.stride(), storage_offset=ids.storage_offset(), dtype=dtype
        )
        made.book, made.ids = book, ids
        return made

    def __init__(self, book: Expressions, ids: Tensor, dtype: torch.dtype) -> None:
        pass

    @classmethod
    def inputs(cls, book: Expressions, shape: Sequence[int], dtype: torch.dtype) -> Entries:
        """A tensor whose values are not known."""
        return from_numbers(book, [book.input() for _ in range(torch.Size(shape).numel())], shape, dtype)

    @classmethod
    def constants(cls, book: Expressions, tensor: Tensor) -> Entries:
        """A tensor whose values are known.

        Raises:
            NotImplementedError: it has a gradient.
        """
        if tensor.requires_grad:
            raise NotImplementedError(
                "compile: a tensor with a gradient is neither parameter nor buffer of the filter: register it as one"
            )
        zeros = tensor._is_zerotensor() or tensor.is_meta  # what forward-mode differentiation leaves out
        values = [0.0] * tensor.numel() if zeros else tensor.detach().cpu().flatten().tolist()
        return from_numbers(book, [book.constant(float(v)) for v in values], tensor.shape, tensor.dtype)

    def __repr__(self, *, tensor_contents: object = None) -> str:  # type: ignore[override]
        return f"Entries({self.ids.tolist()})"

    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @classmethod
    def __torch_dispatch__(  # type: ignore[override]  # torch types it as of an instance
        cls, func: OpOverload, types: Sequence[type], args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        book = next(x.book for x in leaves((*args, *kwargs.values())) if isinstance(x, Entries))
        rule = RULES.get(func)
        if rule is None:
            raise unsupported(func, "it is not among them")
        book.here = book.origins.here()
        return rule(book, func, args, kwargs)


def leaves(arguments: Iterable[Any]) -> Iterator[Any]:
    """The arguments of an operation, and in place of lists what is in them."""
    for x in arguments:
        if isinstance(x, list | tuple):
            yield from leaves(x)
        else:
            yield x


def each(function: Callable[[Any], Any], x: object) -> Any:
    """What a function gives for an argument or a result of an operation; a list for each in a list."""
    return [each(function, y) for y in x] if isinstance(x, list | tuple) else function(x)


def as_entries(book: Expressions, x: object) -> Entries:
    """A tensor or a number as entries; entries stay as they are."""
    if isinstance(x, Entries):
        return x
    return Entries.constants(book, x if isinstance(x, Tensor) else torch.tensor(x, dtype=torch.float64))


def entry_ids(x: Entries) -> list[int]:
    """The numbers of the entries' expressions, in order."""
    ids: list[int] = x.ids.flatten().tolist()
    return ids


def from_numbers(book: Expressions, numbers: Sequence[Any], shape: Sequence[int], dtype: torch.dtype) -> Entries:
    """Entries from the numbers of their expressions, in a (nested) list."""
    return Entries(book, torch.tensor(numbers, dtype=torch.int64).reshape(tuple(shape)), dtype)


def pulled_back(
    results: Sequence[Tensor], gradients: Sequence[Tensor], sources: Sequence[Tensor]
) -> tuple[Tensor | None, ...]:
    """Gradients of the sources, from those of the results; None for what no result depends on."""
    # Given the gradients themselves, ``torch.autograd.grad`` first loads sympy: half a second.
    with torch.enable_grad():
        graded = _Graded.apply(gradients, *results)  # type: ignore[no-untyped-call]  # untyped in torch
    return torch.autograd.grad(graded, sources, allow_unused=True)


class _Context(Context):
    gradients: Sequence[Tensor]


class _Graded(torch.autograd.Function):
    """A number, by which the gradients of these tensors are the given ones."""

    @staticmethod
    def forward(ctx: _Context, gradients: Sequence[Tensor], *tensors: Tensor) -> Tensor:
        ctx.gradients = gradients
        return tensors[0].new_zeros(())

    @staticmethod
    def backward(ctx: _Context, one: Tensor) -> tuple[Tensor | None, ...]:
        return None, *ctx.gradients


def unsupported(operation: object, reason: str) -> NotImplementedError:
    """The error for an operation that kernels do not have: which one, and what to do."""
    return NotImplementedError(
        f"compile: {operation} cannot become part of a kernel ({reason}): write the step with sums, products, "
        "elementary functions, reductions, triangular solutions and torch.where, or leave compile() out"
    )
