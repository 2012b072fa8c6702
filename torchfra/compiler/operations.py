"""The table of all operations of torch that kernels can do: importing this module fills ``entries.RULES``.

What is in no table of ``entrywise``, ``reductions`` and ``moves`` is taken apart by torch's own decompositions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch._decomp import decomposition_table
from torch._ops import OpOverload

from torchfra.compiler.entries import RULES, Entries, Rule, as_entries, unsupported
from torchfra.compiler.entrywise import ENTRYWISE, entrywise
from torchfra.compiler.expressions import Expressions
from torchfra.compiler.moves import MOVES, OTHERS, SHAPES, cast, move, shaped
from torchfra.compiler.reductions import REDUCTIONS

aten = torch.ops.aten


def _plain(function: Callable[..., Any]) -> Rule:
    """A rule that calls a function with the arguments of the operation."""
    return lambda book, func, args, kwargs: function(book, *args, **kwargs)


def _decompose(book: Expressions, func: OpOverload, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    return decomposition_table[func](*args, **kwargs)


def _value(book: Expressions, func: OpOverload, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    raise unsupported(func, "the value of an entry is not known while tracing: choose by torch.where, not by if")


def _in_place(functional: object) -> Rule:
    """The rule of an operation that writes into its first argument, from that of the one that returns the result."""

    def rule(book: Expressions, func: OpOverload, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Entries:
        target = args[0]
        if not isinstance(target, Entries):
            raise unsupported(func, "it changes a tensor of known values in place; make a new one")
        result = as_entries(book, RULES[functional](book, functional, args, kwargs))
        target.ids.copy_(cast(book, result, dtype=target.dtype).ids)
        return target

    return rule


def _view_in_place(book: Expressions, func: OpOverload, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Entries:
    """An operation that changes the shape of a tensor: ``squeeze_`` ends torch's product of a vector and a matrix."""
    target: Entries = args[0]
    func(target.ids, *args[1:], **kwargs)
    with torch._C._DisableTorchDispatch():  # of the tensor itself, which holds no numbers
        func(*args, **kwargs)
    return target


def _in_place_rules() -> dict[Any, Rule]:
    """Rules for ``mul_`` and the like of all operations that have a rule."""
    rules = {}
    for functional in [func for func in RULES if isinstance(func, torch._ops.OpOverload)]:
        packet = getattr(aten, functional._schema.name.split("::")[-1] + "_", None)
        in_place = getattr(packet, functional._overloadname, None)
        if in_place is not None:
            rules[in_place] = _view_in_place if torch.Tag.inplace_view in in_place.tags else _in_place(functional)
    return rules


RULES.update(
    {
        **dict.fromkeys(decomposition_table, _decompose),
        **dict.fromkeys(SHAPES, shaped),
        **dict.fromkeys(MOVES, move),
        **dict.fromkeys(ENTRYWISE, entrywise),
        **{func: _plain(function) for func, function in (REDUCTIONS | OTHERS).items()},
        aten._local_scalar_dense.default: _value,
    }
)
RULES.update(_in_place_rules())


def _of_entries(
    cls: object, func: OpOverload, types: Sequence[type], args: tuple[Any, ...], kwargs: dict[str, Any] | None = None
) -> Any:
    return Entries.__torch_dispatch__(func, types, args, kwargs)


if hasattr(torch.library, "register_torch_dispatch"):  # torch 2.4 does without
    # For an operation without such a rule, torch first loads distributed tensors and sympy: half a second.
    for _func, _rule in RULES.items():
        if isinstance(_func, torch._ops.OpOverload) and _rule is not _decompose:
            torch.library.register_torch_dispatch(_func, Entries, _of_entries)
