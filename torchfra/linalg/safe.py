"""Squares, square roots, logarithms and quotients whose gradient stays finite at the edge of their domain.

The gradient of ``torch.where(x > 0, x.sqrt(), 0.0)`` at 0 is NaN: the branch that is not taken contributes zero times
infinity.  Here the argument itself is replaced before the function sees it, so all derivatives are finite.
"""

from __future__ import annotations

import torch
from torch import Tensor


def in_range(x: Tensor) -> Tensor:
    """Bool, where the square of ``x`` does not overflow; False where ``x`` is NaN."""
    fits: Tensor = x.abs() < torch.finfo(x.dtype).max ** 0.5
    return fits


def safe_square(x: Tensor) -> Tensor:
    """Square, infinite where it overflows; NaN is NaN.

    The gradient is 0 where the cube overflows: there the next factor of the chain rule would be infinite.
    """
    large = x.abs() >= torch.finfo(x.dtype).max ** (1 / 3)
    return torch.where(large, x.detach().square(), torch.where(large, 0.0, x).square())


def safe_sqrt(x: Tensor) -> Tensor:
    """Square root where ``x > 0``; elsewhere, also where ``x`` is NaN, value and gradient are 0."""
    positive = x > 0
    return torch.where(positive, torch.where(positive, x, 1.0).sqrt(), 0.0)


def safe_log(x: Tensor, fill: float = -torch.inf) -> Tensor:
    """Logarithm where ``x`` is above 0 and a normal number; elsewhere the value is ``fill`` and the gradient 0.

    The derivative at a subnormal number overflows.
    """
    normal = x >= torch.finfo(x.dtype).tiny
    return torch.where(normal, torch.where(normal, x, 1.0).log(), fill)


def safe_log1p(x: Tensor) -> Tensor:
    """``log(1 + x)`` where ``x > -1``; elsewhere the value is minus infinity and the gradient 0."""
    inside = x > -1
    return torch.where(inside, torch.where(inside, x, 0.0).log1p(), -torch.inf)


def safe_divide(a: Tensor | float, b: Tensor, fill: float = 0.0) -> Tensor:
    """``a / b`` where ``b`` is not 0; where it is, the value is ``fill`` and the gradients of both are 0.

    Args:
        a: a number, or a tensor that broadcasts with ``b``.
        b: any shape; where it is NaN, so is the quotient.
        fill: the value where ``b`` is 0.

    Example:
        >>> torchfra.linalg.safe_divide(torch.tensor([1.0, 1.0]), torch.tensor([2.0, 0.0]))
        tensor([0.5000, 0.0000])
    """
    defined = b != 0
    return torch.where(defined, a / torch.where(defined, b, 1.0), fill)
