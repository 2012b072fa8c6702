"""Square-root algebra: triangularisation with an exact, rank-safe gradient, downdates, functions of Gram matrices.

A covariance is never formed here.  Everything works on a square root ``A`` of it, ``P = A A^T``, and on the one
lower-triangular root with non-negative diagonal, ``L = tria(A)``.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchfra.linalg.tracing import is_elementary, is_traced


def tria(a: Tensor, *, led: bool = False) -> Tensor:
    """Lower-triangular root of ``a a^T`` with a non-negative diagonal, by orthogonal transformations.

    Args:
        a: ``(..., n, p)``, any ``n`` and ``p``: wide, square or tall.
        led: whether the first ``n`` columns of ``a`` are zero already, which saves putting them there.

    Returns:
        ``L (..., n, n)`` with ``L L^T = a a^T``.  Where a row of ``a`` is zero, so are that row of ``L`` and the
        column below its diagonal.

    The gradient is that of ``L`` itself and is exact wherever ``L`` is differentiable, to any order.  Where ``a`` has
    lost rank (a zero row, or no initial uncertainty and noise of low rank) ``L`` is differentiable only in the
    directions that keep the lost pivots at zero: in those the gradient is exact too, and it is always finite.

    Source: Arasaratnam & Haykin (2009), "Cubature Kalman Filters", Tria(.); Bjoerck & Paige (1992) for the equivalence
    of Householder QR on ``[0; A]`` with Gram-Schmidt.
    """
    # The leading zeros settle two conventions of Householder QR at once.  Every reflection starts from a zero, so the
    # diagonal of R is never positive; and a row without anything new leaves its own zero coordinate untouched, so that
    # no arbitrary direction enters the column of L that belongs to it.
    a = a if led else pad(a, (a.shape[-2], 0))
    if not (a.requires_grad or is_traced(a)):
        return _reflect(a)  # the same numbers, without the bookkeeping of a gradient
    result: Tensor = _Tria.apply(a)  # type: ignore[no-untyped-call]  # torch gives it no type
    return result


def _triangularise(a: Tensor) -> Tensor:
    if a.is_cuda or is_elementary() or (torch.compiler.is_compiling() and a.shape[-2] <= _SMALL):
        return _orthogonalise(a)
    if not is_traced(a):
        return _reflect(a)
    upper: Tensor = torch.linalg.qr(a.mT, mode="r").R
    return -upper.mT


_SMALL = 16
"""Rows up to which a loop over rows, which a compiler sees through, beats a call of LAPACK from compiled code."""


def _orthogonalise(a: Tensor) -> Tensor:
    """Modified Gram-Schmidt: the same numbers as the reflections make behind their leading zeros."""
    columns, rest = [], a[..., a.shape[-2] :]
    for j in range(a.shape[-2]):
        row, rest = rest[..., :1, :], rest[..., 1:, :]
        norm = row.square().sum(-1, keepdim=True).sqrt()
        unit = torch.where(norm > 0, row / torch.where(norm > 0, norm, 1.0), 0.0)
        below = (rest * unit).sum(-1, keepdim=True)
        rest = rest - below * unit
        columns.append(pad(torch.cat([norm, below], -2), (0, 0, j, 0)))
    return torch.cat(columns, -1)


def _reflect(a: Tensor) -> Tensor:
    """What ``torch.linalg.qr`` does, less a copy and a pass that starts threads even for one small matrix."""
    n = a.shape[-2]
    reflected = torch.geqrf(a.mT)[0][..., :n, :].mT
    lower: Tensor = reflected * _minus_lower(n, a.dtype, a.device)
    return lower


@lru_cache(maxsize=64)
def _minus_lower(n: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    return -torch.ones(n, n, dtype=dtype, device=device).tril()


class _Tria(torch.autograd.Function):
    """``dL = B - L K`` with ``B = dA Q``, ``Q = A^T L^-T`` and K skew, its upper part that of ``L^-1 B``.

    K turns the rows of Q into each other so that L stays triangular.  A pivot that has lost its information turns
    nothing: there Q has a zero column and K a zero row.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(a: Tensor) -> Tensor:
        return _triangularise(a)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs, output)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        a, lower = ctx.saved_tensors
        rounding = 4 * sum(a.shape[-2:]) * torch.finfo(a.dtype).eps
        live = lower.diagonal(dim1=-2, dim2=-1) > rounding * torch.linalg.vector_norm(a, dim=-1)
        root = lower + torch.diag_embed((~live).to(a.dtype))
        q = torch.linalg.solve_triangular(root, a, upper=False)
        grad = grad.tril() * live.unsqueeze(-2)
        turn = lower.mT @ grad
        turn = (turn.mT - turn).triu(1) * live.unsqueeze(-1)
        pulled: Tensor = (grad + torch.linalg.solve_triangular(root.mT, turn, upper=True)) @ q
        return pulled


def apply(matrix: Tensor, vector: Tensor) -> Tensor:
    """``matrix (..., m, n)`` times ``vector (..., n)``."""
    product: Tensor = (matrix @ vector.unsqueeze(-1)).squeeze(-1)
    return product


def whiten(root: Tensor, vector: Tensor) -> Tensor:
    """``root^-1 vector`` for a lower-triangular ``root (..., m, m)`` and ``vector (..., m)``."""
    if torch.compiler.is_compiling() and root.shape[-1] <= _SMALL:
        done: list[Tensor] = []
        for i in range(root.shape[-1]):
            known = [root[..., i, j] * x for j, x in enumerate(done)]
            done.append((vector[..., i] - sum(known)) / root[..., i, i])
        return torch.stack(done, -1)
    solved: Tensor = torch.linalg.solve_triangular(root, vector.unsqueeze(-1), upper=False)
    return solved.squeeze(-1)


def hstack(*blocks: Tensor) -> Tensor:
    """Matrices ``(..., n, p_i)`` side by side, their batches broadcast."""
    if len({b.shape[:-2] for b in blocks}) > 1:
        batch = torch.broadcast_shapes(*(b.shape[:-2] for b in blocks))
        blocks = tuple(b.expand(batch + b.shape[-2:]) for b in blocks)
    return torch.cat(blocks, -1)
