"""Triangularisation with an exact gradient, for matrices of any rank, and products with triangular roots."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import Enum
from functools import lru_cache
from inspect import signature
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchfra.linalg.autograd import Context
from torchfra.linalg.batches import broadcast_shapes
from torchfra.linalg.safe import safe_divide
from torchfra.linalg.tracing import batchwise, has_caller, has_tangents, is_elementary, is_plain, is_traced


def tria(a: Tensor, *, graded: bool = True) -> Tensor:
    """Lower-triangular root of ``a a^T`` with a non-negative diagonal, by orthogonal transformations.

    Args:
        a: ``(..., n, p)``, any ``n`` and ``p``: wide, square or tall.
        graded: whether columns may be of any scale, as where little is known beside what is known well, and keep their
            own digits.  Otherwise all entries of a row may lose the digits of its largest.

    Returns:
        ``L (..., n, n)`` with ``L L^T = a a^T``.  Where a row of ``a`` is zero, so are that row of ``L`` and the
        column below its diagonal.  Rows may be of any scale, as far apart as the dtype has numbers.

    The gradient is exact to any order wherever ``L`` is differentiable.  Where ``a`` does not have full rank (a zero
    row, or no initial uncertainty and process noise of low rank), ``L`` is differentiable only in the directions that
    keep the zero pivots at zero.  In those directions the gradient is exact too, and it is always finite.

    Source: Arasaratnam & Haykin (2009), "Cubature Kalman Filters", Tria(.); Bjoerck & Paige (1992) for the equivalence
    of Householder QR on ``[0; A]`` with Gram-Schmidt.

    Example:
        >>> torchfra.linalg.tria(torch.tensor([[3.0, 4.0]]))
        tensor([[5.]])
    """
    n, way = a.shape[-2], _Way.GRADED if graded else _Way.EVEN
    if is_plain(a):
        return _reflect(a, way)  # the same result, without the overhead of autograd
    if not graded and a.shape[-1] > (_COLUMNS + 1) * n and has_caller():
        first, rest = a[..., : (_COLUMNS - 1) * n], a[..., (_COLUMNS - 1) * n :]
        lower = tria(first, graded=False)
        for columns in rest.split(_COLUMNS * n, -1):
            lower = tria(hstack(lower, columns), graded=False)
        return lower
    return _apply(a, way)


def tria_of_update(a: Tensor, measured: int, reads: int, *, unit: bool) -> Tensor:
    """``tria`` of ``a = [[B, C, 0], [0, S]]``, if ``unit`` behind ``measured`` columns ``[I, 0]``.

    Args:
        a: ``(..., measured + n, p)``; ``B``, behind ``I`` or alone, has full rank, and ``S (..., n, n)`` is lower.
        measured: number of rows above those of ``S``.
        reads: number of columns of ``C``, those on top of the first columns of ``S``.
        unit: whether ``I`` stands in front.
    """
    way = _Update(measured, reads, unit)
    return _reflect(a, way) if is_plain(a) else _apply(a, way)


def tria_beside(diagonal: Tensor, a: Tensor) -> Tensor:
    """``tria([D, a])`` for ``a (..., n, p)`` and a diagonal matrix ``D`` of ``diagonal (n,)``, not negative.

    The diagonal serves the reflections as the leading zeros of ``tria`` do: each touches its own entry first.
    """
    full = hstack(torch.diag(diagonal), a)
    if _by_rows(full):
        return tria(full)
    if is_plain(full):
        return _positive(_reflect(full, _Way.GRADED))
    return _apply(full, _Way.BESIDE)


_COLUMNS = 4
"""Columns for each row that a step of many matrices takes at once: the function is short, and called for all parts."""


class _Way(Enum):
    """How a matrix is made triangular."""

    EVEN = 0
    """Columns of one scale."""
    GRADED = 1
    """Columns of any scale."""
    BESIDE = 2
    """Columns of any scale beside a diagonal matrix."""


class _Update(NamedTuple):
    """A matrix of ``tria_of_update``."""

    measured: int
    reads: int
    unit: bool


def _apply(a: Tensor, way: _Way | _Update) -> Tensor:
    """The triangularisation as an autograd function."""
    result: Tensor = (_ForwardModeTria if has_tangents() else _Tria).apply(a, way)  # type: ignore[no-untyped-call]  # untyped in torch
    return result


def _positive(lower: Tensor) -> Tensor:
    """The root with a non-negative diagonal: rows whose part beside the diagonal is zero were not reflected."""
    return torch.where(lower.diagonal(dim1=-2, dim2=-1).unsqueeze(-2) < 0, -lower, lower)


def _by_rows(a: Tensor) -> bool:
    """Whether a loop over rows is faster than LAPACK: for many small matrices on a GPU, and in compiled code."""
    return a.is_cuda or is_elementary() or (torch.compiler.is_compiling() and a.shape[-2] <= _SMALL)


def _triangularise(a: Tensor, way: _Way | _Update) -> Tensor:
    """The fastest of four ways to the same root of ``a``."""
    if isinstance(way, _Update) and is_elementary():
        return _rotations(way)(a)
    if _by_rows(a):
        return _by_gram_schmidt(a, way)[0]
    return _reflect(a, way, traced=is_traced(a))


_SMALL = 16
"""Number of rows up to which a loop over rows, which a compiler can fuse, is faster than a call of LAPACK."""


def _by_gram_schmidt(a: Tensor, way: _Way | _Update) -> tuple[Tensor, Tensor]:
    """In exact arithmetic the same root as that of Householder reflections, and its ``Q^T``."""
    a = _behind_unit(a, way.measured) if isinstance(way, _Update) and way.unit else a
    return _orthogonalise(a) if way is _Way.EVEN else _orthogonalise_twice(a)


@batchwise(2)
def _orthogonalise(a: Tensor) -> tuple[Tensor, Tensor]:
    """Modified Gram-Schmidt."""
    return _gram_schmidt(a, twice=False)


@batchwise(2)
def _orthogonalise_twice(a: Tensor) -> tuple[Tensor, Tensor]:
    """The same, with what rounding errors leave of a row along those above it taken away: see ``eliminated``."""
    return _gram_schmidt(a, twice=True)


def _gram_schmidt(a: Tensor, *, twice: bool) -> tuple[Tensor, Tensor]:
    columns: list[Tensor] = []
    units: list[Tensor] = []
    rest = a
    for j in range(a.shape[-2]):  # of a tall matrix too: rows without length, as of missing elements, take no direction
        row, rest = rest[..., :1, :], rest[..., 1:, :]
        if twice and units:
            row, _ = _orthogonal(row, torch.cat(units, -2))
        norm = _norms(row)
        unit = row / torch.where(norm == 0, 1.0, norm)  # a row without length is zero
        below = (rest * unit).sum(-1, keepdim=True)
        rest = rest - below * unit
        columns.append(pad(torch.cat([norm, below], -2), (0, 0, j, 0)))
        units.append(unit)
    return torch.cat(columns, -1), torch.cat(units, -2)


@lru_cache(maxsize=64)
def _rotations(way: _Update) -> Callable[[Tensor], Tensor]:
    """The root of ``tria_of_update``, entry by entry.

    Plane rotations of a column of the measurement and one of ``S`` at a time: each keeps the digits of its two columns,
    whatever their scales, and ``S``, taken from its last column to its first, stays lower.

    Source: Carlson (1973), "Fast Triangular Formulation of the Square Root Filter", for one measurement.
    """
    measured, reads, _ = way

    @batchwise(2)
    def rotated_root(a: Tensor) -> Tensor:
        start = a.shape[-1] - (a.shape[-2] - measured)
        first = a[..., :measured, :start]
        first = tria(_behind_unit(first, measured) if way.unit else first)
        first = pad(first, (0, 0, 0, a.shape[-2] - measured))
        rows = [list(row.unbind(-1)) for row in torch.cat([first, a[..., start:]], -1).unbind(-2)]
        for k in range(measured):
            for j in reversed(range(measured, measured + reads)):
                norm = _norms(torch.stack([rows[k][k], rows[k][j]], -1)).squeeze(-1)  # not zero, as B has full rank
                cosine, sine = rows[k][k] / norm, rows[k][j] / norm
                rows[k][k] = norm
                for row in [*rows[k + 1 : measured], *rows[j:]]:
                    row[k], row[j] = cosine * row[k] + sine * row[j], cosine * row[j] - sine * row[k]
        return torch.stack([torch.stack(row, -1) for row in rows], -2).tril()

    return rotated_root


def eliminated(a: Tensor, count: int, least: float, *, graded: bool = False) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Eliminates the first ``count`` rows of ``a (..., n, p)``, of any rank, from the others by modified Gram-Schmidt.

    ``[[L, 0], [cross, rest]]`` is a root of ``a a^T``, except for rows that depend on those above them: such a row
    eliminates nothing, and has a 1 on the diagonal of ``L`` and zeros beside it and below.

    Args:
        a: the rows.
        count: number of rows to eliminate.
        least: relative rounding error of the sums that an entry of a row goes through: a row whose remainder is no
            larger counts as zero.
        graded: whether columns may be of any scale, as where little is known beside what is known well, and keep their
            own digits: rows are made orthogonal twice, and a remainder is compared with what it is left of column by
            column, as well as with its row in double precision.  Otherwise it is compared with the norm of its row.

    Returns:
        ``L (..., count, count)``, ``cross (..., n - count, count)``, ``rest (..., n - count, p)``, and ``(..., count)``
        bool, which rows depend on others.

    Source: Daniel, Gragg, Kaufman & Stewart (1976), "Reorthogonalization and Stable Algorithms for Updating the
    Gram-Schmidt QR Factorization".
    """
    first = a[..., :count, :].detach()
    scale = least * (first.abs() if graded else _norms(first))
    smallest = least * torch.finfo(torch.float64).eps / torch.finfo(a.dtype).eps * _norms(first)
    units: list[Tensor] = []
    columns, dependent, rest = [], [], a
    for j in range(count):
        row, rest = rest[..., :1, :], rest[..., 1:, :]
        if graded and units:
            row, _ = _orthogonal(row, torch.cat(units, -2))
        norm = _norms(row)
        left = row.detach().abs() if graded else norm.detach()
        depends = (left <= scale[..., j : j + 1, :]).all(-1, keepdim=True) | (norm <= smallest[..., j : j + 1, :])
        norm = torch.where(depends, 1.0, norm)
        unit = torch.where(depends, 0.0, row / norm)
        below = (rest * unit).sum(-1, keepdim=True)
        rest = rest - below * unit
        if graded:
            terms = pad(below[..., : count - j - 1, :] * unit, (0, 0, j + 1, 0)).detach()
            scale = scale + least * terms.abs()
        columns.append(pad(torch.cat([norm, below], -2), (0, 0, j, 0)))
        units.append(unit)
        dependent.append(depends.squeeze(-1))
    lower = torch.cat(columns, -1)
    cross = lower[..., count:, :]
    if graded and cross.shape[-2]:
        rest, more = _orthogonal(rest, torch.cat(units, -2))
        cross = cross + more
    return lower[..., :count, :], cross, rest, torch.cat(dependent, -1)


def split(joint: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """``eliminated`` of a root ``(..., n, p)`` that may be ``graded``, by the fastest way that keeps its digits.

    Where little is known of some direction, most digits of what is known well go into sums with large numbers, unless
    each column keeps its own.
    """
    if not (is_elementary() or is_traced(joint)):
        lower = tria(joint)
        root = lower[..., :count, :count].detach()
        lengths = root.square().sum(-1).sqrt()
        if bool((root.diagonal(dim1=-2, dim2=-1) > torch.finfo(joint.dtype).eps ** 0.5 * lengths).all()):
            none = torch.zeros_like(lengths, dtype=torch.bool)  # the usual case: half of the digits at least
            return lower[..., :count, :count], lower[..., count:, :count], lower[..., count:, count:], none
    return eliminated(joint, count, rounding(sum(joint.shape[-2:]) + count, joint.dtype), graded=True)


def _orthogonal(rows: Tensor, units: Tensor) -> tuple[Tensor, Tensor]:
    """Rows without what rounding errors have left along ``units``, and that share of these.

    It is 0 but for rounding, and so is its derivative.
    """
    left = rows.detach() @ units.detach().mT
    return rows - left @ units.detach(), left


def dependent(lower: Tensor, terms: int) -> Tensor:
    """``(..., n)`` bool, which rows of a lower root ``(..., n, n)`` depend on those above them.

    Their pivots are at the level of the rounding errors of sums of ``terms`` terms.
    """
    value = lower.detach()
    return value.diagonal(dim1=-2, dim2=-1) <= rounding(terms, value.dtype) * value.square().sum(-1).sqrt()


def rounding(terms: int, dtype: torch.dtype) -> float:
    """Relative rounding error of sums of ``terms`` terms."""
    return 4 * terms * torch.finfo(dtype).eps


def _norms(a: Tensor) -> Tensor:
    """Euclidean norms of rows, ``(..., n, 1)``, scaled as in LAPACK so that no square over- or underflows."""
    if is_elementary():
        norms: Tensor = torch.linalg.vector_norm(a, dim=-1, keepdim=True)  # entry by entry it scales where it is needed
        return norms
    largest = torch.linalg.vector_norm(a, ord=torch.inf, dim=-1, keepdim=True)
    norms = largest * torch.linalg.vector_norm(safe_divide(a, largest), dim=-1, keepdim=True)
    return norms


def _reflect(a: Tensor, way: _Way | _Update, *, traced: bool = False) -> Tensor:
    """``-torch.linalg.qr(a.mT, mode="r").R.mT``, if not ``traced`` to the bit by the call of LAPACK behind it.

    The columns of ``a`` stand behind zeros, but for a diagonal matrix, which serves as they.  The zeros fix two
    conventions at once.  Every reflection starts from a zero, so the diagonal of R is never positive.  And a row that
    depends on those above leaves its zero coordinate untouched, so no arbitrary direction enters its column of L.
    Reflections keep the digits of rows alone: where columns may be of any scale they need more of them.

    What is left out of ``qr`` is a copy and ``triu``, whose threads an eager step of small matrices pays for.  A step
    of SRCKF takes 3.7 +- 0.3 times as long by ``torch.linalg.qr`` for one track and 1.61 +- 0.03 times for 64 tracks
    with two threads (by the clock 4.4 +- 0.2 and 1.25 +- 0.15); with one thread 1.02 +- 0.02 and 1.00 +- 0.02 times,
    for 1000 tracks 1.06 +- 0.01 (processor time, medians of ratios of turns with standard errors, a busy server).
    """
    n, finer = a.shape[-2], a if way is _Way.EVEN else a.double()
    if isinstance(way, _Update) and way.unit:
        columns = _behind_unit(finer, way.measured, n).mT
    else:
        columns = (finer if way is _Way.BESIDE else pad(finer, (n, 0))).mT
    if traced:
        return -torch.linalg.qr(columns, mode="r").R.mT.to(a)  # type: ignore[no-any-return]  # untyped in torch
    lower: Tensor = torch.geqrf(columns)[0][..., :n, :].mT * _minus_lower(n, columns.dtype, a.device)
    return lower.to(a.dtype)


def _behind_unit(a: Tensor, count: int, zeros: int = 0) -> Tensor:
    """``a (..., n, p)`` behind ``zeros`` columns of zeros and the first ``count`` columns of the identity."""
    return hstack(pad(torch.eye(a.shape[-2], count, dtype=a.dtype, device=a.device), (zeros, 0)), a)


@lru_cache(maxsize=64)
def _minus_lower(n: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """``(n, n)`` minus one on and below the diagonal, zero above."""
    return -torch.ones(n, n, dtype=dtype, device=device).tril()


class _Context(Context):
    way: _Way | _Update


class _Tria(torch.autograd.Function):
    """``dL = B - L K`` with ``B = dA Q``, ``Q = A^T L^-T`` and K skew-symmetric, its upper part that of ``L^-1 B``.

    K is the rotation of the columns of Q that keeps L triangular.  A zero pivot takes no part in it: there K has a zero
    row and a zero column, whatever the column of Q is.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(a: Tensor, way: _Way | _Update) -> Tensor:
        root = _triangularise(a, way)
        return _positive(root) if way is _Way.BESIDE else root

    @staticmethod
    def setup_context(ctx: _Context, inputs: tuple[Tensor, _Way | _Update], output: Tensor) -> None:
        ctx.save_for_backward(inputs[0], output)
        ctx.way = inputs[1]

    @staticmethod
    def backward(ctx: _Context, grad: Tensor) -> tuple[Tensor, None]:
        a, lower = ctx.saved_tensors
        root, q, nonzero = _pivoted(a, lower, ctx.way)
        grad, regular = grad.tril(), not (is_traced(lower) or lower.is_cuda) and bool(nonzero.all())
        grad = grad if regular else grad * nonzero.unsqueeze(-2)
        rotation = lower.mT @ grad
        rotation = (rotation.mT - rotation).triu(1)
        rotation = rotation if regular else rotation * (nonzero.unsqueeze(-1) & nonzero.unsqueeze(-2))
        gradient: Tensor = (grad + torch.linalg.solve_triangular(root.mT, rotation, upper=True)) @ q
        return gradient, None


_Tria.forward.__signature__ = signature(_Tria.forward)  # type: ignore[attr-defined]  # torch asks for it at each call


class _ForwardModeTria(_Tria):
    """``_Tria`` with forward-mode derivatives, a class of its own because ``torch.compile`` refuses such functions."""

    @staticmethod
    def setup_context(ctx: _Context, inputs: tuple[Tensor, _Way | _Update], output: Tensor) -> None:
        _Tria.setup_context(ctx, inputs, output)
        ctx.save_for_forward(inputs[0], output)

    @staticmethod
    def jvp(ctx: _Context, rate: Tensor, _: None) -> Tensor:
        a, lower = ctx.saved_tensors
        root, q, nonzero = _pivoted(a, lower, ctx.way)
        b, kept = rate @ (q * nonzero.unsqueeze(-1)).mT, nonzero.unsqueeze(-1)
        rotation = torch.linalg.solve_triangular(root, b, upper=False).triu(1) * kept
        moved: Tensor = (b - lower @ (rotation - rotation.mT)).tril() * kept.mT
        return moved


def _pivoted(a: Tensor, lower: Tensor, way: _Way | _Update) -> tuple[Tensor, Tensor, Tensor]:
    """``L`` with ones for zero pivots, ``Q^T``, and which pivots are not zero."""
    least = rounding(2 * a.shape[-2] + a.shape[-1], a.dtype) * lower.abs().sum(-1)  # not the norms, which take roots
    nonzero = lower.diagonal(dim1=-2, dim2=-1) > least
    root = lower + torch.diag_embed((~nonzero).to(a.dtype))
    if is_elementary() and not isinstance(way, _Update):
        q = _by_gram_schmidt(a, way)[1]  # a kernel has computed these rows with L, and keeps each expression once
    else:
        q = torch.linalg.solve_triangular(root, a, upper=False)
    return root, q, nonzero


def apply(matrix: Tensor, vector: Tensor) -> Tensor:
    """``matrix (..., m, n)`` times ``vector (..., n)``."""
    if matrix.dim() == 2 <= vector.dim():  # one matrix for all vectors: one product, not a batch of them
        return vector @ matrix.mT
    product: Tensor = (matrix @ vector.unsqueeze(-1)).squeeze(-1)
    return product


def whiten(root: Tensor, vector: Tensor) -> Tensor:
    """``root^-1 vector`` for a lower-triangular ``root (..., m, m)`` and ``vector (..., m)``."""
    if torch.compiler.is_compiling() and root.shape[-1] <= _SMALL:
        solution: list[Tensor] = []
        for i in range(root.shape[-1]):
            products = [root[..., i, j] * x for j, x in enumerate(solution)]
            solution.append((vector[..., i] - sum(products)) / root[..., i, i])
        return torch.stack(solution, -1)
    solved: Tensor = torch.linalg.solve_triangular(root, vector.unsqueeze(-1), upper=False)
    return solved.squeeze(-1)


def marginal_root(root: Tensor, states: slice) -> Tensor:
    """Lower root of the covariance of some components, from the lower root ``(..., n, n)`` of all."""
    rows = root[..., states, :]
    leading = states.start in (0, None) and states.step in (1, None)
    return rows[..., : rows.shape[-2]] if leading else tria(rows)


def hstack(*blocks: Tensor) -> Tensor:
    """Matrices ``(..., n, p_i)`` side by side; their batch dimensions are broadcast."""
    batches = [b.shape[:-2] for b in blocks]
    if batches.count(batches[0]) < len(batches):  # a set would hash sizes, which symbols cannot
        batch = broadcast_shapes(*batches)
        blocks = tuple([b.expand(batch + b.shape[-2:]) for b in blocks])
    return torch.cat(blocks, -1)


def block_diagonal(blocks: Sequence[Tensor]) -> Tensor:
    """Matrices ``(..., n_i, p_i)`` along the diagonal of one; their batch dimensions are broadcast."""
    batch = broadcast_shapes(*(b.shape[:-2] for b in blocks))
    wide, before, rows = sum(b.shape[-1] for b in blocks), 0, []
    for block in blocks:
        rows.append(pad(block, (before, wide - before - block.shape[-1])).expand(*batch, -1, -1))
        before += block.shape[-1]
    return torch.cat(rows, -2)
