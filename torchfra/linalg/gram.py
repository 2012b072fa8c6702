"""Functions of Gram matrices ``H H^T`` with exact gradients, and downdates of roots."""

from __future__ import annotations

from itertools import combinations

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchfra.linalg.tracing import is_elementary
from torchfra.linalg.triangular import tria


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
