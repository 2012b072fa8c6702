"""Arithmetic of constant-gain filters, axis by axis: prediction, update, gains of special steps, covariances."""

from __future__ import annotations

from functools import reduce
from typing import TypeAlias

import torch
from torch import Tensor

from torchfra.filters.alphabeta import gains as design
from torchfra.hyper import Hyper
from torchfra.linalg.safe import safe_divide, safe_sqrt
from torchfra.linalg.tracing import is_traced
from torchfra.linalg.triangular import tria

Rows: TypeAlias = list[list[Tensor]]
"""Rows of the covariance roots of all axes: entry i, j is ``(..., d)``."""


def predict_axes(parts: tuple[Tensor, ...], dt: Tensor) -> list[Tensor]:
    """Position, velocity(, acceleration) after ``dt``."""
    if len(parts) == 2:
        return [parts[0] + dt * parts[1], parts[1]]
    p, v, a = parts
    return [p + dt * v + dt**2 / 2 * a, v + dt * a, a]


def update_axes(predicted: list[Tensor], column: list[Tensor], since: Tensor, residual: Tensor) -> list[Tensor]:
    """Position, velocity(, acceleration) after the update by a residual; those without a gain are 0."""
    moved = [x + g / since**i * residual for i, (x, g) in enumerate(zip(predicted, column, strict=False))]
    return moved + [torch.zeros_like(residual) for _ in predicted[len(column) :]]


def short_step_gains(column: list[Tensor], since: Tensor, period: Hyper | None) -> list[Tensor]:
    """Gains for a step shorter than their period: those of a tracking index in proportion to the step's square."""
    if period is None:
        return column
    share = (since / period(since).unsqueeze(-1)).clamp_max(1.0)
    return [gain * share ** (i + 1) for i, gain in enumerate(column)]


def startup_gains(column: list[Tensor], count: Tensor) -> list[Tensor]:
    """Gains that take the position from the first measurement and the velocity from the second; later unchanged."""
    first = [1.0] + [0.0] * (len(column) - 1)
    second = [1.0, 1.0] + [0.0] * (len(column) - 2)
    return [
        torch.where(count < 0.5, a, torch.where(count < 1.5, b, gain))
        for a, b, gain in zip(first, second, column, strict=True)
    ]


def two_gain_root(alpha: Tensor, beta: Tensor) -> tuple[list[Tensor], Tensor]:
    """Steady-state covariance root, row by row, and variance of the residual, for measurement noise and step of 1."""
    position, cross, velocity, predicted = design.variances(alpha, beta)
    first = position.sqrt()
    along = cross / first
    return [first, along, (velocity - along.square()).sqrt()], 1 + predicted


def three_gain_root(alpha: Tensor, beta: Tensor, gamma: Tensor) -> tuple[list[Tensor], Tensor]:
    """Steady-state covariance root, row by row, and variance of the residual of three gains: see ``two_gain_root``."""
    rows = [[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]]
    transition = torch.tensor(rows, dtype=alpha.dtype, device=alpha.device)
    root = design.steady_root(transition, torch.stack([alpha, beta, gamma / 2], -1))
    predicted = (transition[0].unsqueeze(-2) @ root).squeeze(-2)
    return [root[..., i, j] for i in range(3) for j in range(i + 1)], 1 + predicted.square().sum(-1)


def root_rows(entries: Tensor) -> Rows:
    """Rows of covariance roots from their nonzero entries ``(..., p, d)``, which are stored row by row."""
    size = 2 if entries.shape[-2] == 3 else 3
    zero = torch.zeros_like(entries[..., 0, :])
    return [[entries[..., i * (i + 1) // 2 + j, :] if j <= i else zero for j in range(size)] for i in range(size)]


def axis_roots(root: Tensor, orders: int, size: int) -> Tensor:
    """Entries ``(..., p, d)`` of the root of each axis, of its first ``size`` orders, from a root ``(..., n, n)``."""
    rows = tria(root.unflatten(-2, (orders, -1)).transpose(-2, -3)[..., :size, :])
    return torch.stack([rows[..., i, j] for i in range(size) for j in range(i + 1)], -2)


def predict_root(rows: Rows, dt: Tensor) -> Rows:
    """Rows of a root after ``dt``."""
    return [list(column) for column in zip(*(predict_axes(tuple(c), dt) for c in zip(*rows, strict=True)), strict=True)]


def corrected_root(rows: Rows, column: list[Tensor], since: Tensor, used: Tensor, std: Tensor) -> Tensor:
    """Entries ``(..., p, d)`` of ``(I - K H) P (I - K H)^T + K R K^T``: the covariance of errors, whatever the gains.

    Args:
        rows: of a root of P.
        column: gains of position, velocity(, acceleration).
        since: seconds that the gains are divided by.
        used: 1 where the measurement is used, 0 where K is 0.
        std: root of R.

    Source: Bar-Shalom, Li & Kirubarajan (2001), section 5.2 (the form of Joseph).
    """
    gains = [used * gain / since**i for i, gain in enumerate(column)]
    rest = [[*(a - g * b for a, b in zip(row, rows[0], strict=True)), g * std]
            for g, row in zip(gains, rows, strict=True)]  # fmt: skip
    entries: list[list[Tensor]] = [[] for _ in rest]
    for i, row in enumerate(rest):  # modified Gram-Schmidt
        norm = safe_sqrt(reduce(torch.add, (x.square() for x in row)))
        unit = [safe_divide(x, norm) for x in row]
        entries[i].append(norm)
        for k in range(i + 1, len(rest)):
            along = reduce(torch.add, (x * u for x, u in zip(rest[k], unit, strict=True)))
            rest[k] = [x - along * u for x, u in zip(rest[k], unit, strict=True)]
            entries[k].append(along)
    return torch.stack(torch.broadcast_tensors(*(x for row in entries for x in row)), -2)


def root_spreads(entries: Tensor) -> Tensor:
    """Standard deviations ``(..., k, d)`` of position, velocity(, acceleration)."""
    rows = root_rows(entries)
    return torch.stack([safe_sqrt(reduce(torch.add, (x.square() for x in row))) for row in rows], -2)


def residual_spread(rows: Rows, std: Tensor) -> Tensor:
    """Standard deviation of the residual of a predicted position, in std of the measurement."""
    return (1 + reduce(torch.add, (x.square() for x in rows[0])) / std.square()).sqrt()


def full_root(entries: Tensor, n: int) -> Tensor:
    """Root ``(..., n, n)`` from its entries ``(..., p, d)``; states without entries are certain."""
    p, d = entries.shape[-2:]
    places = [(row, column) for row in range(3) for column in range(row + 1)][:p]
    if not is_traced(entries) and entries.dim() > 3 and entries.stride(0) == 1:
        # Kernels write the entries of neighbouring tracks side by side; the root keeps that layout.
        batch = entries.shape[:-2]
        root = entries.new_zeros((*batch[1:], n, n, batch[0])).movedim(-1, 0)
        for i, (row, column) in enumerate(places):
            block = root[..., row * d : (row + 1) * d, column * d : (column + 1) * d]
            block.diagonal(dim1=-2, dim2=-1).copy_(entries[..., i, :])
        return root
    place = torch.zeros(p * d, n * n, dtype=entries.dtype, device=entries.device)
    for i, (row, column) in enumerate(places):
        for axis in range(d):
            place[i * d + axis, (row * d + axis) * n + column * d + axis] = 1
    spread: Tensor = (entries.flatten(-2) @ place).unflatten(-1, (n, n))
    return spread
