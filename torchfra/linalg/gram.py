"""Functions of Gram matrices ``H H^T`` and downdates of roots, both with exact gradients."""

from __future__ import annotations

from itertools import combinations

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchfra.linalg.safe import safe_divide
from torchfra.linalg.tracing import batchwise, is_elementary, is_plain
from torchfra.linalg.triangular import tria


def gram_pinv(h: Tensor, rcond: float) -> Tensor:
    """Pseudo-inverse of ``H H^T``; singular values of H below ``rcond`` times the largest count as zero.

    Args:
        h: ``(..., m, d)``; a matrix that is not finite counts as zero.
        rcond: relative threshold, from 0 (only those at the level of rounding errors are dropped) to 1.

    Returns:
        ``(..., m, m)``.  The gradient is exact as long as no singular value crosses the threshold, also where singular
        values coincide (where the gradient of an SVD is infinite).
    """
    h = _finite(h)
    u, eigenvalues = _left_singular(h.detach())
    threshold = max(rcond, max(h.shape[-2:]) * torch.finfo(h.dtype).eps)
    kept = eigenvalues > threshold**2 * eigenvalues.amax(-1, keepdim=True)
    inverse = safe_divide(1.0, torch.where(kept, eigenvalues, 0.0))
    return _of_gram(h, u, eigenvalues, inverse, kept, -inverse.unsqueeze(-1) * inverse.unsqueeze(-2))


@batchwise(2)
def gram_information(h: Tensor) -> tuple[Tensor, Tensor]:
    """The measurement that turns ``N(0, I)`` into ``N(w, H H^T)``: ``root x + N(0, I)``, of value ``weight w``.

    Args:
        h: ``(..., n, d)``; a matrix that is not finite counts as zero.

    Returns:
        ``root (..., n, n)``, symmetric, with ``root^2 = (H H^T)^-1 - I``, and ``weight = root^-1 (H H^T)^-1``.  Both
        are 0 along eigenvectors of ``H H^T`` whose eigenvalue is 0 up to rounding errors of double precision, or so
        small that no number holds the derivative, or not below 1 by more than the rounding error to the power of 3/4.
        (What is left out there moves a mean by its root, 0.0025 of a standard deviation in single precision; of what
        is kept, the power of 1/4 at most is a rounding error.)  The gradient is exact as long as none crosses that.
    """
    h = _finite(h)
    rows = h.detach()  # of any scale, and LAPACK keeps the digits of the largest alone
    u, eigenvalues = (x.to(h) for x in _left_singular(rows if is_elementary() else rows.double()))
    limits = torch.finfo(h.dtype)
    least = (max(h.shape[-2:]) * torch.finfo(torch.float64).eps) ** 2 * eigenvalues.amax(-1, keepdim=True)
    kept = (eigenvalues > least.clamp_min(limits.max ** (-2 / 3))) & (eigenvalues < 1 - limits.eps**0.75)
    inside = torch.where(kept, eigenvalues, 0.5)
    root, share = (1 / inside - 1).sqrt(), (inside - inside.square()).sqrt()

    def function(value: Tensor, slope: Tensor) -> Tensor:
        slope = torch.where(kept.unsqueeze(-1), slope, 0.0)
        return _of_gram(h, u, eigenvalues, torch.where(kept, value, 0.0), kept, slope)

    # Divided differences of a(p) = sqrt(1 / p - 1) and of 1 / s(p), s(p) = sqrt(p - p^2), between p and q, with
    # b = a(q) and t = s(q); without the difference p - q, in which digits would be lost.
    (p, q), (a, b), (s, t) = ((x.unsqueeze(-1), x.unsqueeze(-2)) for x in (inside, root, share))
    return function(root, -1 / (p * (q * (a + b)))), function(1 / share, (p + q - 1) / (s * t * (s + t)))


_LEAST = 1e-12
"""Smallest fraction of a variance that remains."""


def downdate(root: Tensor, subtracted: Tensor) -> tuple[Tensor, Tensor]:
    """Lower-triangular root of ``root root^T - subtracted subtracted^T``, repaired where that is not positive definite.

    In units of ``root`` the difference is ``I - H H^T`` with ``H = root^-1 subtracted``.  Its eigenvalues below 1e-12
    are raised to that: in those directions the result is repaired, and has no gradient.

    Args:
        root: ``(..., n, n)`` lower; a direction without uncertainty (a zero on the diagonal) is left as it is.
        subtracted: ``(..., n, r)`` root of the covariance to subtract.

    Returns:
        ``(root, repaired)``: the new root ``(..., n, n)``, and ``(...)`` bool, whether it had to be repaired.  The
        gradient is exact where it did not.
    """
    certain = root.diagonal(dim1=-2, dim2=-1) == 0
    invertible = root + torch.diag_embed(certain.to(root))
    h = torch.linalg.solve_triangular(invertible, torch.where(certain.unsqueeze(-1), 0.0, subtracted), upper=False)
    u, eigenvalues = _left_singular(_finite(h).detach())
    kept = 1 - eigenvalues > _LEAST
    remaining = torch.where(kept, 1 - eigenvalues, _LEAST).sqrt()
    slope = -kept.to(remaining).unsqueeze(-1) / (remaining.unsqueeze(-1) + remaining.unsqueeze(-2))
    return tria(root @ _of_gram(h, u, eigenvalues, remaining, kept, slope)), ~kept.all(-1)


def _finite(h: Tensor) -> Tensor:
    """``h (..., m, d)`` with zeros in the place of matrices that contain NaN or infinity."""
    return torch.where(h.isfinite().flatten(-2).all(-1)[..., None, None], h, 0.0)


def _of_gram(h: Tensor, u: Tensor, eigenvalues: Tensor, value: Tensor, kept: Tensor, slope: Tensor) -> Tensor:
    """``u diag(value) u^T``, a function of ``H H^T = u diag(eigenvalues) u^T``, with its gradient with respect to H.

    Args:
        h: ``(..., m, d)``; the gradient flows to it.
        u: ``(..., m, m)`` eigenvectors, detached.
        eigenvalues: ``(..., m)``, detached.
        value: ``(..., m)`` the function of the eigenvalues.
        kept: ``(..., m)`` bool, which eigenvalues the function depends on; of the others it is constant.
        slope: ``(..., m, m)`` divided differences of the function between two eigenvalues that are both kept or both
            not; they are the derivative of a matrix function in its eigenbasis (Daleckii-Krein).
    """
    if is_plain(h) or (is_elementary() and not h.requires_grad):
        return (u * value.unsqueeze(-2)) @ u.mT
    gap = eigenvalues.unsqueeze(-1) - eigenvalues.unsqueeze(-2)
    mixed = kept.unsqueeze(-1) != kept.unsqueeze(-2)
    jump = safe_divide(value.unsqueeze(-1) - value.unsqueeze(-2), gap)
    gram = h @ h.mT
    change = u.mT @ (gram - gram.detach()) @ u  # its value is zero, its gradient is not
    result: Tensor = u @ (torch.diag_embed(value) + torch.where(mixed, jump, slope) * change) @ u.mT
    return result


def _left_singular(h: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvectors ``(..., m, m)`` and eigenvalues ``(..., m)`` of ``H H^T``, from the singular values of ``H``."""
    m = h.shape[-2]
    if not (is_elementary() or ((h.is_cuda or torch.compiler.is_compiling()) and m <= 3)):
        u, sigma, _ = torch.linalg.svd(h, full_matrices=True)
        return u, pad(sigma.square(), (0, m))[..., :m]
    # One-sided Jacobi: pairs of rows are rotated until all are orthogonal; the product of the rotations is u^T.
    rotations = torch.eye(m, dtype=h.dtype, device=h.device).expand((*h.shape[:-1], m))
    for _ in range(2 if m == 2 else min(m + 2, 8)):  # one more than the worst of 300,000 matrices of 3 to 5 rows needs
        h, rotations = _rotated(h, rotations)
    return rotations.mT, h.square().sum(-1)


@batchwise(2, 2)
def _rotated(h: Tensor, rotations: Tensor) -> tuple[Tensor, Tensor]:
    """The rows of ``h (..., m, d)`` after a rotation of each pair that makes it orthogonal; ``rotations`` go along."""
    d = h.shape[-1]
    rows = list(torch.cat([h, rotations], -1).unbind(-2))
    for p, q in combinations(range(len(rows)), 2):
        a, b = rows[p], rows[q]
        gap = b[..., :d].square().sum(-1, keepdim=True) - a[..., :d].square().sum(-1, keepdim=True)
        product = 2 * (a[..., :d] * b[..., :d]).sum(-1, keepdim=True)
        tangent = safe_divide(product, gap.abs() + torch.hypot(gap, product))
        tangent = torch.where(gap < 0, -tangent, tangent)
        cosine = (1 + tangent.square()).rsqrt()
        rows[p], rows[q] = cosine * (a - tangent * b), cosine * (b + tangent * a)
    rotated = torch.stack(rows, -2)
    return rotated[..., :d], rotated[..., d:]
