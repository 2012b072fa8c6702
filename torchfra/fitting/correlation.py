"""How errors of a sensor are correlated in time: a white part, a part that lasts, and how long, from residuals."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from torchfra.fitting.vector import NORMAL_95
from torchfra.numbers import Array, as_numbers
from torchfra.tables import text_table

_FEWEST = 20
"""Residuals of an element, without which nothing is said."""
_STEP = 1e-3
"""Difference of logs for derivatives."""
_NEWTON = 60
"""Steps of Newton's method at most."""


class Correlation(NamedTuple):
    """White and correlated part of residuals, one value for each element; ``print`` shows them with their intervals."""

    white: Array
    """``(m,)`` standard deviation of the white part."""
    std: Array
    """``(m,)`` standard deviation of the part that lasts."""
    time: Array
    """``(m,)`` its correlation time, s, after which the correlation is ``exp(-1)``."""
    intervals: Array
    """``(3, m, 2)`` 95 % intervals of the three, infinitely wide where the residuals do not identify a value."""
    gain: Array
    """``(m,)`` log likelihood of both parts less that of white noise alone: below about 4 there is no correlation."""

    def __str__(self) -> str:
        names = ("white std", "correlated std", "correlation time, s")
        rows = [
            [f"{name}[{i}]", f"{value:.3g}", f"{low:.3g}", f"{high:.3g}"]
            for name, values, ends in zip(names, self[:3], self.intervals, strict=True)
            for i, (value, (low, high)) in enumerate(zip(values, ends, strict=True))
        ]
        return text_table(("", "value", "95 % from", "to"), rows)


def correlation(residuals: ArrayLike, time: ArrayLike) -> Correlation:
    """Splits the errors of a sensor into a white part and one that lasts, by maximum likelihood.

    Residuals are measurements less the truth, or less a reference that is far better: a receiver that stands, a survey,
    a second receiver.  Innovations of a filter will not do, as the filter has followed what lasts.  Leave outliers out,
    as NaN.  What is found goes into a sensor by one line::

        found = torchfra.correlation(residuals, time)
        sensor = sensors.Correlated(Position(found.white), std=found.std, time=found.time)

    The model is a first-order Gauss-Markov process beside white noise, in each element its own, at any times; its
    likelihood is that of a Kalman filter, and the intervals are those of its curvature in logs.

    Args:
        residuals: ``(T,)``, ``(T, m)``, or ``(B, T, m)`` of several tracks with the same values; NaN is missing.
        time: ``(T,)`` or ``(B, T)`` s, not decreasing.

    Raises:
        ValueError: shapes that do not fit, times that decrease, infinite residuals, fewer than 20 of an element or
            ones that are all the same.

    Source: Brown & Hwang (2012), "Introduction to Random Signals and Applied Kalman Filtering", section 3.6.
    """
    values = as_numbers(residuals, "residuals").detach().double().numpy()
    values = values[:, None] if values.ndim == 1 else values
    values = values[None] if values.ndim == 2 else values
    seconds = np.atleast_2d(as_numbers(time, "time").detach().double().numpy())
    if values.ndim != 3 or seconds.ndim != 2 or not _fit(seconds, values):
        received = f"{tuple(np.shape(residuals))} and {tuple(np.shape(time))}"
        raise ValueError(f"residuals, time: expected (T,), (T, m) or (B, T, m) and (T,) or (B, T), received {received}")
    gaps = np.diff(seconds, axis=1, prepend=seconds[:, :1])
    if not (np.isfinite(gaps) & (gaps >= 0)).all():
        raise ValueError("time: expected finite seconds that do not decrease, received others")
    if np.isinf(values).any():
        raise ValueError("residuals: expected finite numbers, or NaN where there is none, received infinite ones")
    each = [_element(values[..., i], np.broadcast_to(gaps, values.shape[:2]), i) for i in range(values.shape[2])]
    found, ends, gain = (np.array(part) for part in zip(*each, strict=True))
    white, std, lasts = found.T
    return Correlation(white, std, lasts, ends.swapaxes(0, 1), gain)


def _fit(seconds: Array, values: Array) -> bool:
    """Whether times ``(1 or B, T)`` are those of residuals ``(B, T, m)``."""
    return seconds.shape[1] == values.shape[1] and seconds.shape[0] in (1, values.shape[0])


def _element(r: Array, gaps: Array, i: int) -> tuple[Array, Array, float]:
    """White std, correlated std and time ``(3,)``, intervals ``(3, 2)`` and the gain, of an element ``(B, T)``."""
    count, scale = int((~np.isnan(r)).sum()), float(np.sqrt(np.nanmean(r**2))) if (~np.isnan(r)).any() else 0.0
    if count < _FEWEST or not scale > 0:
        received = f"{count} of element {i}" if count < _FEWEST else f"zeros in element {i}"
        raise ValueError(f"residuals: expected {_FEWEST} or more that differ, received {received}")
    shortest, longest = float(gaps[gaps > 0].min(initial=1.0)), float(gaps.sum(1).max())
    times = np.geomspace(shortest, max(longest, 2 * shortest), 16)
    shares = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
    grid = np.array(
        [
            [math.log(scale * math.sqrt(1 - s)), math.log(scale * math.sqrt(s)), math.log(t)]
            for s in shares
            for t in times
        ]
    )
    at = grid[int(_loss(grid, r, gaps).argmin())]
    value, slope, curve = _derivatives(at, r, gaps)
    damping = 1e-3
    for _ in range(_NEWTON):
        size = np.abs(np.linalg.eigvalsh(curve)).max()
        least = np.linalg.eigvalsh(curve).min()
        step = np.linalg.solve(curve + (max(0.0, -least) + damping * size) * np.eye(3), -slope)
        step *= min(1.0, 1.0 / np.abs(step).max())
        after = _loss((at + step)[None], r, gaps)[0]
        if after <= value:
            at, damping = at + step, damping / 5
            done = value - after < 1e-9 * max(1.0, abs(value)) or np.abs(step).max() < 1e-6
            value, slope, curve = _derivatives(at, r, gaps)
            if done:
                break
        else:
            damping *= 10
            if damping > 1e6:
                break
    alone = np.array([[math.log(scale), math.log(scale) - 30.0, 0.0]])
    values, vectors = np.linalg.eigh(curve)
    with np.errstate(divide="ignore"):
        variance = (vectors**2 / np.where(values > 0, values, 0.0)).sum(1)
    half = NORMAL_95 * np.sqrt(variance)
    ends = np.exp(np.stack([at - half, np.minimum(at + half, 700.0)], 1))
    ends[~np.isfinite(half)] = [0.0, np.inf]
    return np.exp(at), ends, float(_loss(alone, r, gaps)[0] - value)


def _derivatives(at: Array, r: Array, gaps: Array) -> tuple[float, Array, Array]:
    """Value, gradient ``(3,)`` and Hessian ``(3, 3)`` at logs of the values, by differences, in one pass."""
    unit = _STEP * np.eye(3)
    pairs = [(i, j) for i in range(3) for j in range(i, 3)]
    points = [at, *(at + s * unit[i] for i in range(3) for s in (1, -1))]
    points += [at + a * unit[i] + b * unit[j] for i, j in pairs if i < j for a in (1, -1) for b in (1, -1)]
    found = _loss(np.array(points), r, gaps)
    value, sides = found[0], found[1:7].reshape(3, 2)
    curve = np.diag((sides.sum(1) - 2 * value) / _STEP**2)
    corners = iter(found[7:].reshape(-1, 4))
    for i, j in pairs:
        if i < j:
            pp, pm, mp, mm = next(corners)
            curve[i, j] = curve[j, i] = (pp - pm - mp + mm) / (4 * _STEP**2)
    return float(value), (sides[:, 0] - sides[:, 1]) / (2 * _STEP), curve


def _loss(logs: Array, r: Array, gaps: Array) -> Array:
    """Minus the log likelihood ``(P,)`` of residuals ``(B, T)`` for logs ``(P, 3)`` of white std, std and time."""
    white, variance, time = np.exp(2 * logs[:, 0]), np.exp(2 * logs[:, 1]), np.exp(logs[:, 2])
    mean, spread = np.zeros((len(r), len(logs))), np.broadcast_to(variance, (len(r), len(logs)))
    total = np.zeros(len(logs))
    for k in range(r.shape[1]):
        kept = np.exp(-gaps[:, k, None] / time)
        mean, spread = kept * mean, variance + kept**2 * (spread - variance)
        seen = ~np.isnan(r[:, k, None])
        gap, total_variance = np.where(seen, r[:, k, None], 0.0) - mean, spread + white
        gain = np.where(seen, spread / total_variance, 0.0)
        total += np.where(seen, 0.5 * (gap**2 / total_variance + np.log(2 * np.pi * total_variance)), 0.0).sum(0)
        mean, spread = mean + gain * gap, (1 - gain) * spread
    return total
