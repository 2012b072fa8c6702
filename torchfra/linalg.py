"""Square-root algebra: triangularisation with an exact, rank-safe gradient, downdates, functions of Gram matrices.

A covariance is never formed here.  Everything works on a square root ``A`` of it, ``P = A A^T``, and on the one
lower-triangular root with non-negative diagonal, ``L = tria(A)``.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from itertools import combinations
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad


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


def is_traced(*tensors: Tensor) -> bool:
    """Whether this runs under ``torch.compile``, ``torch.export``, a transform of ``torch.func`` or ``elementary``."""
    wrapped = torch._C._functorch.is_functorch_wrapped_tensor
    return bool(torch.compiler.is_compiling()) or is_elementary() or any(wrapped(t) for t in tensors)


_elementary: ContextVar[bool] = ContextVar("elementary", default=False)


@contextmanager
def elementary() -> Iterator[None]:
    """In here decompositions are loops of sums and products, for what turns them into code of its own."""
    token = _elementary.set(True)
    try:
        yield
    finally:
        _elementary.reset(token)


def is_elementary() -> bool:
    """Whether this runs under ``elementary``."""
    return not torch.compiler.is_compiling() and _elementary.get()


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


def gram_pinv(h: Tensor, rcond: float) -> Tensor:
    """``(H H^T)^+`` without the singular values of H that are below ``rcond`` times the largest.

    Args:
        h: ``(..., m, d)``; a matrix that is not finite counts as zero.
        rcond: relative cut, from 0 (all that is above rounding) to 1.

    Returns:
        ``(..., m, m)``.  The gradient is exact as long as no singular value crosses the cut, also where singular
        values coincide (that of a decomposition is not).
    """
    ok = h.isfinite().flatten(-2).all(-1)[..., None, None]
    h = torch.where(ok, h, 0.0)
    u, power = _left_singular(h.detach())
    cut = max(rcond, max(h.shape[-2:]) * torch.finfo(h.dtype).eps)
    kept = power > cut**2 * power.amax(-1, keepdim=True)
    inverse = torch.where(kept, 1 / torch.where(kept, power, 1.0), 0.0)
    return _of_gram(h, u, power, inverse, kept, -inverse.unsqueeze(-1) * inverse.unsqueeze(-2))


def gram_sqrt(h: Tensor) -> Tensor:
    """``(H H^T)^(1/2)``, symmetric, for ``h (..., m, d)`` of full row rank; its gradient is exact."""
    u, power = _left_singular(h.detach())
    sigma = power.sqrt()
    ok = power > 0
    together = sigma.unsqueeze(-1) + sigma.unsqueeze(-2)
    return _of_gram(h, u, power, sigma, ok, 1 / torch.where(together > 0, together, 1.0))


def downdate(root: Tensor, lost: Tensor, floor: float = 1e-12) -> tuple[Tensor, Tensor]:
    """Lower-triangular root of ``root root^T - lost lost^T``, and where that had to be repaired.

    In units of ``root`` the difference is the identity less a covariance.  Directions in which less than ``floor`` of
    the identity remains keep ``floor``: there the result is repaired, and passes no gradient.

    Args:
        root: ``(..., n, n)`` lower; a direction without uncertainty (a zero on the diagonal) loses nothing.
        lost: ``(..., n, r)``.
        floor: the share of a variance that remains at least.

    Returns:
        The root ``(..., n, n)``, and ``(...)`` bool: it was repaired.  The gradient is exact elsewhere.
    """
    certain = root.diagonal(dim1=-2, dim2=-1) == 0
    whole = root + torch.diag_embed(certain.to(root))
    h = torch.linalg.solve_triangular(whole, torch.where(certain.unsqueeze(-1), 0.0, lost), upper=False)
    u, power = _left_singular(torch.where(h.isfinite().flatten(-2).all(-1)[..., None, None], h, 0.0).detach())
    kept = 1 - power > floor
    left = torch.where(kept, 1 - power, floor).sqrt()
    slope = -kept.to(left).unsqueeze(-1) / (left.unsqueeze(-1) + left.unsqueeze(-2))
    return tria(root @ _of_gram(h, u, power, left, kept, slope)), ~kept.all(-1)


def _of_gram(h: Tensor, u: Tensor, power: Tensor, value: Tensor, kept: Tensor, slope: Tensor) -> Tensor:
    """A function of ``H H^T = u diag(power) u^T`` whose values are ``value (..., m)``, with its gradient.

    Args:
        h: ``(..., m, d)``, which carries the gradient.
        u: ``(..., m, m)`` eigenvectors, constant.
        power: ``(..., m)`` eigenvalues, constant.
        value: ``(..., m)`` of the function there.
        kept: ``(..., m)`` where the function is smooth; it is constant elsewhere.
        slope: ``(..., m, m)`` divided differences between values that are both kept (or both not): the derivative of a
            matrix function in its own eigenbasis.
    """
    gap = power.unsqueeze(-1) - power.unsqueeze(-2)
    mixed = kept.unsqueeze(-1) != kept.unsqueeze(-2)
    jump = (value.unsqueeze(-1) - value.unsqueeze(-2)) / torch.where(mixed & (gap != 0), gap, 1.0)
    gram = h @ h.mT
    change = u.mT @ (gram - gram.detach()) @ u  # zero, but carries the gradient
    result: Tensor = u @ (torch.diag_embed(value) + torch.where(mixed, jump, slope) * change) @ u.mT
    return result


def _left_singular(h: Tensor) -> tuple[Tensor, Tensor]:
    """Of ``h (..., m, d)``: left singular vectors ``(..., m, m)``, and singular values squared ``(..., m)``."""
    m = h.shape[-2]
    if not (is_elementary() or ((h.is_cuda or torch.compiler.is_compiling()) and m <= 3)):
        u, sigma, _ = torch.linalg.svd(h, full_matrices=True)
        return u, pad(sigma.square(), (0, max(m - sigma.shape[-1], 0)))[..., :m]
    # One-sided Jacobi: pairs of rows are turned into each other until all are orthogonal; the turns make up u.
    turns = torch.eye(m, dtype=h.dtype, device=h.device).expand((*h.shape[:-1], m))
    rows = list(torch.cat([h, turns], -1).unbind(-2))
    d = h.shape[-1]
    for _ in range(2 if m == 2 else 8):
        for p, q in combinations(range(m), 2):
            a, b = rows[p], rows[q]
            gap = b[..., :d].square().sum(-1, keepdim=True) - a[..., :d].square().sum(-1, keepdim=True)
            both = 2 * (a[..., :d] * b[..., :d]).sum(-1, keepdim=True)
            tangent = both / torch.where(both == 0, 1.0, gap.abs() + torch.hypot(gap, both))
            tangent = torch.where(gap < 0, -tangent, tangent)
            cosine = (1 + tangent.square()).rsqrt()
            rows[p], rows[q] = cosine * (a - tangent * b), cosine * (b + tangent * a)
    turned = torch.stack(rows, -2)
    return turned[..., d:].mT, turned[..., :d].square().sum(-1)
