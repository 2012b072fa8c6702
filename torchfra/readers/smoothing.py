"""The smoothest curve near measured values, and the nearest one whose accelerations are bounded."""

from __future__ import annotations

import numpy as np

from torchfra.readers.columns import Array

_BLOCK = 32
"""Unknowns that are eliminated together."""
_ROUNDS, _START, _LEAST, _MOST = 30, 0.03, 1e-6, 1e9
"""Rounds of the multipliers; what they grow from, and their bounds, where 1 moves a lone jump by its own size."""


def smoothed(
    time: Array, x: Array, weight: Array, *, limit: float, roughness: float = 0.0,
    bounds: tuple[Array, Array] | None = None,
) -> Array:  # fmt: skip
    """Minimises the weighted squared distances from ``x`` under a limit on the second derivative.

    The limits are met by multipliers that grow where they are exceeded and shrink where they are not, until what moved
    least is left.  Limits that contradict each other are met as far as they go.

    Args:
        time: ``(k,)`` seconds, increasing.
        x: ``(k, d)`` values.
        weight: ``(k,)`` of the squared distances; 0 where the value is to be interpolated.
        limit: of the length of the second derivative.
        roughness: weight of the integral of the squared third derivative.
        bounds: lowest and highest value ``(k,)``, of a single dimension; ``x`` lies between.

    Returns:
        ``(k, d)``.
    """
    bend, third = differences(time, 2), differences(time, 3)
    share = roughness * (time[3:] - time[:-3]) / 3
    rough = _normal_bands(third, share, len(time))
    force = _returned(third, share[:, None] * _applied(third, x), len(time))
    scale = np.median(weight[weight > 0]) * ((time[2:] - time[:-2]) / 2) ** 4
    stiff, tight = _LEAST * scale, np.ones_like(weight)
    result = x
    for number in range(_ROUNDS):
        if number or roughness or _lengths(bend, x).max(initial=0.0) > limit:
            bands = rough.copy()
            bands[:3] += _normal_bands(bend, stiff, len(time))
            bands[0] += weight * tight
            # Moves instead of values: they are small, so that little is lost to rounding where times are close.
            result = x - solve(bands, force + _returned(bend, stiff[:, None] * _applied(bend, x), len(time)))
        excess, outside = _lengths(bend, result) / limit, _outside(x, result, bounds)
        if max(excess.max(initial=0.0), outside.max(initial=0.0)) < 1.01:
            break
        stiff = np.where(excess > 1, np.maximum(stiff, _START * scale), stiff)
        stiff = (stiff * excess.clip(0.1, 10.0) ** 1.5).clip(_LEAST * scale, _MOST * scale)
        tight = (tight * outside.clip(0.1, 10.0) ** 1.5).clip(1.0, _MOST)
    return result


def differences(time: Array, order: int) -> Array:
    """Coefficients ``(k - order, order + 1)`` of the derivative of this order, from ``order + 1`` neighbours."""
    rows: Array = np.ones((len(time), 1))
    for degree in range(1, order + 1):
        longer = np.zeros((len(rows[1:]), degree + 1))  # by ``np.pad`` it takes three times as long
        longer[:, 1:] = rows[1:]
        longer[:, :-1] -= rows[:-1]
        rows = degree * longer / (time[degree:] - time[:-degree])[:, None]
    return rows


def solve(bands: Array, right: Array) -> Array:
    """Solves a symmetric, positive definite, banded system by elimination in blocks.

    Args:
        bands: ``(b + 1, k)``, the diagonal first; element i of row j couples unknowns i and i + j, and is 0 where there
            is no such unknown.
        right: ``(k, d)``.
    """
    size, near = len(right), len(bands) - 1
    count = -(-size // _BLOCK)
    diagonal, upper = _blocks(bands, count)
    rows = np.zeros((count * _BLOCK, near + right.shape[1]))  # a block knows only the first unknowns of the next
    rows[:, :near], rows[:size, near:] = upper.reshape(-1, near), right
    coupled = rows.reshape(count, _BLOCK, -1)
    for i in range(count):
        if i:
            left = upper[i - 1].T @ coupled[i - 1]
            diagonal[i, :near, :near] -= left[:, :near]
            coupled[i, :near, near:] -= left[:, near:]
        coupled[i] = np.linalg.solve(diagonal[i], coupled[i])
    gains, values = coupled[:, :, :near], coupled[:, :, near:]
    for i in range(count - 2, -1, -1):
        values[i] -= gains[i] @ values[i + 1, :near]
    return np.asarray(values.reshape(count * _BLOCK, -1)[:size])


def _blocks(bands: Array, count: int) -> tuple[Array, Array]:
    """Blocks ``(count, _BLOCK, _BLOCK)`` on the diagonal, and the ``(count, _BLOCK, b)`` beside them that are not 0.

    After the end they are the identity.
    """
    width, size = bands.shape
    longer = np.zeros((width, count * _BLOCK))
    longer[:, :size], longer[0, size:] = bands, 1.0
    diagonal, upper = np.zeros((count, _BLOCK, _BLOCK)), np.zeros((count, _BLOCK, width - 1))
    row = np.arange(_BLOCK)
    for j, band in enumerate(longer.reshape(width, count, _BLOCK)):
        inside = row[: _BLOCK - j]
        diagonal[:, inside, inside + j] = diagonal[:, inside + j, inside] = band[:, inside]
        upper[:, row[_BLOCK - j :], row[:j]] = band[:, _BLOCK - j :]
    return diagonal, upper


def _normal_bands(rows: Array, weight: Array, size: int) -> Array:
    """Bands of the sum of ``weight * outer(row, row)``, each row starting at its own unknown."""
    width = rows.shape[1]
    bands = np.zeros((width, size))
    for i in range(width):
        for j in range(i, width):
            bands[j - i, i : i + len(rows)] += weight * rows[:, i] * rows[:, j]
    return bands


def _applied(rows: Array, x: Array) -> Array:
    """Derivatives ``(k - width + 1, d)`` of ``(k, d)``."""
    return np.asarray(sum(rows[:, [i]] * x[i : i + len(rows)] for i in range(rows.shape[1])))


def _returned(rows: Array, x: Array, size: int) -> Array:
    """The transpose of ``_applied``: ``(k, d)`` of ``(k - width + 1, d)``."""
    result = np.zeros((size, x.shape[1]))
    for i in range(rows.shape[1]):
        result[i : i + len(rows)] += rows[:, [i]] * x
    return result


def _lengths(rows: Array, x: Array) -> Array:
    return np.asarray(np.linalg.norm(_applied(rows, x), axis=1))


def _outside(x: Array, moved: Array, bounds: tuple[Array, Array] | None) -> Array:
    """How far values were moved, in units of what the bounds allow."""
    if bounds is None:
        return np.zeros(len(x))
    low, high = bounds
    step, old = (moved - x)[:, 0], x[:, 0]
    return np.asarray(np.abs(step) / np.maximum(np.where(step > 0, high - old, old - low), 1e-6))
