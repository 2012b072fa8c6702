"""Second derivatives of any loss in a handful of values, with an estimate of their error.

They are for training loops of your own.  ``torchfra.fit`` needs second derivatives for each track and for many sets of
values at once: ``torchfra.fitting.newton`` has them from one call of the filter.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class Hessian(NamedTuple):
    """Second derivatives with respect to all numbers of the parameters, in their order."""

    matrix: Tensor
    """``(k, k)``, symmetric."""
    error: Tensor
    """``(k, k)``: conservative estimate of the error of each entry."""


def hessian(loss: Callable[[], Tensor], parameters: Sequence[Tensor]) -> Hessian:
    """The Hessian of a loss, from central differences of its gradients, extrapolated to a step of 0.

    It takes four gradients for each number and no second derivative, so it works with compiled filters.  Where the loss
    is not smooth, as at a hard decision, ``error`` is large.

    Args:
        loss: a function without arguments that returns a number which depends on the parameters, such as the negative
            log-likelihood of tracks.
        parameters: leaves with ``requires_grad``, of any shape; the call changes them and restores them.

    Returns:
        The matrix ``(k, k)`` for the ``k`` numbers of all parameters, and its error.

    Raises:
        ValueError: a parameter that is no such leaf, a loss that is not one number, or a gradient that is not finite.

    Source: Richardson (1911), "The approximate arithmetical solution by finite differences".
    """
    for x in parameters:
        if not (x.is_leaf and x.requires_grad and x.is_floating_point()):
            raise ValueError(f"parameters: expected leaves with requires_grad, received {x}")
    if not parameters:
        raise ValueError("parameters: expected at least one, received none")
    rows = [_row(loss, parameters, x.data.view(-1), i) for x in parameters for i in range(x.numel())]
    near, far = (torch.stack(parts) for parts in zip(*rows, strict=True))
    best = (4 * near - far) / 3
    return Hessian((best + best.mT) / 2, torch.maximum((near - far).abs() / 3, (best - best.mT).abs() / 2))


def _row(loss: Callable[[], Tensor], parameters: Sequence[Tensor], numbers: Tensor, i: int) -> tuple[Tensor, Tensor]:
    """Derivatives ``(k,)`` of the gradient in one number, by differences over a small step and over twice the step."""
    value = numbers[i].item()
    step = torch.finfo(numbers.dtype).eps ** 0.2 * max(abs(value), 1.0)  # an error of step^4 and one of eps / step
    differences = []
    try:
        for size in (step, 2 * step):
            sides = []
            for side in (value + size, value - size):
                numbers[i] = side
                sides.append((_gradient(loss, parameters), numbers[i].item()))
            (above, high), (below, low) = sides
            differences.append((above - below) / (high - low))
    finally:
        numbers[i] = value
    return differences[0], differences[1]


def _gradient(loss: Callable[[], Tensor], parameters: Sequence[Tensor]) -> Tensor:
    with torch.enable_grad():
        value = loss()
        if value.numel() != 1:
            raise ValueError(f"loss: expected one number, received {tuple(value.shape)}")
        parts = torch.autograd.grad(value, parameters, allow_unused=True)
    gradient = torch.cat(
        [(torch.zeros_like(x) if g is None else g).reshape(-1) for x, g in zip(parameters, parts, strict=True)]
    )
    if not bool(gradient.isfinite().all()):
        raise ValueError(f"loss: expected a finite gradient near the parameters, received {gradient.tolist()}")
    return gradient
