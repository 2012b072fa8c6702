"""Roots of covariances that users state."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.linalg.tracing import is_traced
from torchfra.linalg.triangular import rounding, tria

_ROUNDING = 1e-9
"""Largest negative eigenvalue of a covariance that counts as rounding, relative to the largest eigenvalue."""


def covariance_root(covariance: Tensor, name: str = "covariance") -> Tensor:
    """The lower root ``(..., n, n)`` of covariances ``(..., n, n)`` of any rank, such as one with variances of 0.

    It has gradients where the covariance is positive definite apart from variances of 0.  While code is traced,
    into a kernel say, the lower triangle counts, and the root of what is no covariance has NaN instead of an error.

    Args:
        covariance: symmetric, positive semidefinite.
        name: what error messages call it.

    Raises:
        ValueError: not square, not finite, not symmetric or with a negative eigenvalue.

    Example:
        >>> torchfra.linalg.covariance_root(torch.tensor([[4.0, 0.0], [0.0, 0.0]]))
        tensor([[2., 0.],
                [0., 0.]])
    """
    if covariance.dim() < 2 or covariance.shape[-1] != covariance.shape[-2]:
        raise ValueError(f"{name}: expected a covariance (..., n, n), received {tuple(covariance.shape)}")
    if is_traced(covariance):
        return _by_columns(covariance)
    variances = covariance.diagonal(dim1=-2, dim2=-1)
    known = variances == 0
    zero = known.unsqueeze(-1) | known.unsqueeze(-2)
    with torch.no_grad():
        _check(covariance, zero, name)
    root: Tensor
    root, failed = torch.linalg.cholesky_ex(torch.where(zero, 0.0, covariance) + torch.diag_embed(known.to(covariance)))
    root = root - torch.diag_embed(known.to(root))
    if not bool(failed.any()):
        return root
    values, vectors = torch.linalg.eigh(covariance.detach())
    return torch.where((failed != 0)[..., None, None], tria(vectors * values.clamp_min(0.0).sqrt().unsqueeze(-2)), root)


def _check(covariance: Tensor, zero: Tensor, name: str) -> None:
    """Checks that these are covariances, without correlations of what has no variance (``zero``)."""
    if not bool(covariance.isfinite().all()):
        raise ValueError(f"{name}: expected finite numbers, received {_first(covariance, ~covariance.isfinite())}")
    values = torch.linalg.eigvalsh((covariance + covariance.mT) / 2)
    rounding = max(_ROUNDING, 8 * torch.finfo(covariance.dtype).eps)
    largest = values.abs().amax(-1).clamp_min(torch.finfo(covariance.dtype).tiny)
    bad = (values < -rounding * largest.unsqueeze(-1)).any(-1)
    bad = bad | ((covariance - covariance.mT).abs().amax((-2, -1)) > 1e3 * rounding * largest)
    bad = bad | (zero & (covariance != 0)).flatten(-2).any(-1)
    if bool(bad.any()):
        received = _first(covariance, bad[..., None, None].expand_as(covariance))
        raise ValueError(f"{name}: expected a symmetric positive semidefinite matrix, received {received}")


def _first(covariance: Tensor, bad: Tensor) -> list[list[float]]:
    """The first of several matrices that has a bad entry."""
    worst = bad.flatten(-2).any(-1).reshape(-1)
    found: list[list[float]] = covariance.reshape(-1, *covariance.shape[-2:])[worst][0].tolist()
    return found


def _by_columns(covariance: Tensor) -> Tensor:
    """The lower root column by column, without a branch on values: a pivot that is rounding has a column of zeros."""
    left, columns, n = covariance, list[Tensor](), covariance.shape[-1]
    variances = covariance.diagonal(dim1=-2, dim2=-1)
    for j in range(n):
        pivot, column, variance = left[..., 0, :1], left[..., 0], variances[..., j : j + 1]
        known = (pivot >= -_ROUNDING * variance) & (pivot <= rounding(n * n, covariance.dtype) * variance)
        known = known & (variance < torch.inf)
        # Beside a pivot of 0 a covariance has nothing else.
        rest = torch.where(column.square() > _ROUNDING * variance * variances[..., j:], torch.nan, 0.0)
        column = torch.where(known, rest, column / torch.where(known, 1.0, pivot).sqrt())
        columns.append(torch.cat([covariance.new_zeros((*column.shape[:-1], j)), column], -1))
        left = left[..., 1:, 1:] - column[..., 1:, None] * column[..., None, 1:]
    return torch.stack(columns, -1)
