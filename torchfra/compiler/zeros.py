"""Which zeros of a state stay: a step of random numbers says it sooner than a trace."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

Run = Callable[[Callable[[Sequence[int]], Tensor], Sequence[Tensor]], Sequence[Tensor]]
"""A step: from what draws numbers of a shape and the leaves of a state to those of the next one."""


def staying(run: Run, zero: list[Tensor], dtype: torch.dtype) -> list[Tensor]:
    """Of the entries of a state that are 0 at first those that are 0 after every step: all of them, hardly any other.

    Whatever an expression makes 0 is 0 in numbers too, but for what is not finite: then all that are 0 at first are
    returned.  A trace, which knows for certain, takes tens of times as long.

    Args:
        run: a step in plain numbers.
        zero: which entries are 0 before the first step.
        dtype: of the numbers.
    """
    generator, first = torch.Generator().manual_seed(0), zero

    def draw(shape: Sequence[int]) -> Tensor:
        return 0.1 + 0.8 * torch.rand(torch.Size(shape), dtype=dtype, generator=generator)

    while True:
        leaves = [draw(z.shape).masked_fill(z, 0.0) for z in zero]
        with _BothSides():
            after = run(draw, leaves)
        if any(x.shape != z.shape or not x.isfinite().all() for x, z in zip(after, zero, strict=True)):
            return first
        still = [z & (x == 0) for z, x in zip(zero, after, strict=True)]
        if all(map(torch.equal, still, zero)):
            return zero
        zero = still


class _BothSides(TorchFunctionMode):
    """Inside, a choice is 0 only where both sides are: a step of other numbers may choose the other one."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        chosen = func(*args, **(kwargs or {}))
        if func not in (torch.where, Tensor.where) or len(args) < 3:
            return chosen
        mask, yes, no = args if func is torch.where else (args[1], args[0], args[2])
        other = torch.where(mask, no, yes)
        return torch.where((chosen == 0) & (other == other), other, chosen)
