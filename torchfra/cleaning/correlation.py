"""Errors that last from fix to fix, as of a phone between houses: they are seen, and uncertainties widened for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from torchfra.cleaning.cleaned import Cleaned
from torchfra.cleaning.kinds import KINDS, USUAL
from torchfra.cleaning.second import second_differences, spread
from torchfra.readers.columns import Array
from torchfra.readers.recording import Recording
from torchfra.tables import duration, metres

_LEAST = 100
"""Fixes from which on errors that last can be told from a motion."""
_LAGS = 7
"""Most lags, each twice the one before, at which second differences are compared."""
_STRAIGHT = 0.35
"""Share of the second differences that hardly ever are of a turn, and from which the errors are found."""
_GROWTH, _TWICE = (1.15, 1.9), 1.6
"""By what second differences grow from each of the first lags to the next, and at least over two of them, where errors
last: those of white noise do not grow, and those of a motion do by 2 or 2.8."""
_NOISE = 1.75
"""Growth from which on second differences are those of the motion."""
_SECONDS = 4.0, 90.0, 14
"""For how long errors may last: least, which fixes have to be within, most, and how many times in between are tried."""
_USUALLY, _WEIGHT = 30.0, 1e-3
"""For how long they usually last, and what the square of the log of another time costs."""


class Lasting(NamedTuple):
    """Errors of positions, per axis: a Gauss-Markov process, and white noise."""

    std: float
    """Of the process, m."""
    seconds: float
    """After which it is forgotten to a share of 1 / e."""
    white: float
    """Standard deviation of the noise, m."""


def lasting_errors(recording: Recording, kind: str) -> Lasting | None:
    """The errors of a track that last from fix to fix; None if there are none to be seen.

    Second differences over a lag h, scaled so that white noise has its own variance, have that of a Gauss-Markov
    process times 1 - 4/3 exp(-h/T) + 1/3 exp(-2 h/T), which is proportional to h at first.  Those of a motion grow
    faster.  As errors that last for minutes look like a motion, a time of half a minute is taken for likely.

    Args:
        recording: of a target.
        kind: name of its kind.
    """
    there = np.isfinite(recording.position[:, :2]).all(1)
    time, path = recording.time[there], recording.position[there, :2]
    step = float(np.median(np.diff(time))) if len(time) >= _LEAST else np.inf
    if step > _SECONDS[0]:
        return None
    every = [second_differences(time, path, 2**lag) for lag in range(_LAGS) if 4 * 2**lag <= len(time)]
    usual = np.array([spread(x, 0.5) for x in every[:4]])
    growth = usual[1:] / usual[:-1].clip(1e-9)
    lasts = _GROWTH[0] < growth.min() and growth.max() < _GROWTH[1] and usual[2] > _TWICE * usual[0]
    if not lasts or np.sqrt(6) * usual[0] < USUAL * KINDS[kind].acceleration * step**2:
        return None
    found = np.array([spread(x, _STRAIGHT) for x in every])
    fast = np.flatnonzero(found[1:] > _NOISE * found[:-1])
    count = max(3, fast[0] + 1) if len(fast) else len(found)
    fitted = _fitted(step * 2.0 ** np.arange(count), found[:count] ** 2)
    return fitted if fitted.std > 0 else None


def _fitted(lag: Array, variance: Array) -> Lasting:
    """The process and the noise that make the least relative squared error of variances ``(j,)`` at lags, s.

    A third part is proportional to the square of the lag, for the motion.
    """
    best = np.inf, Lasting(0.0, 0.0, 0.0)
    for seconds in np.geomspace(*_SECONDS[:2], _SECONDS[2]):
        parts = [np.ones_like(lag), 1 - 4 / 3 * np.exp(-lag / seconds) + np.exp(-2 * lag / seconds) / 3, lag**2]
        rest, (white, process, _) = _least_squares([part / variance for part in parts])
        cost = rest + _WEIGHT * np.log(seconds / _USUALLY) ** 2
        if cost < best[0]:
            best = cost, Lasting(float(np.sqrt(process)), float(seconds), float(np.sqrt(white)))
    return best[1]


def _least_squares(parts: Sequence[Array]) -> tuple[float, Array]:
    """How many of each part, 0 or more, make a sum that is nearest to 1; with what is left of the squared error."""
    best, every = (np.inf, np.zeros(len(parts))), range(len(parts))
    for chosen in (list(some) for count in every for some in combinations(every, count + 1)):
        columns = np.stack([parts[i] for i in chosen], 1)
        size = np.linalg.norm(columns, axis=0)
        shares = np.linalg.lstsq(columns / size, np.ones(len(columns)), rcond=None)[0] / size
        rest = float(np.square(columns @ shares - 1).sum())
        if rest < best[0] and (shares >= 0).all():
            best = rest, np.zeros(len(parts))
            best[1][chosen] = shares
    return best


def widened(one: Cleaned, kind: str) -> Cleaned:
    """The result with covariances that know of errors that last, if there are any.

    An estimate that is as sure as the mean of m fixes of independent errors is as sure as the mean of m fixes whose
    errors are those of the process.
    """
    errors = lasting_errors(one.recording, kind)
    if errors is None:
        return one
    known = (one.covariance[:, 0, 0] + one.covariance[:, 1, 1]) / 2
    count = (one.found.sigma**2 / known).clip(1.0)
    step = np.median(np.diff(one.recording.time))
    variance = errors.std**2 * _of_a_mean(np.exp(-step / errors.seconds), count) + errors.white**2 / count
    factor = np.sqrt((variance / known).clip(1.0))
    covariance = one.covariance.copy()
    covariance[:, :2] *= factor[:, None, None]
    covariance[:, :, :2] *= factor[:, None, None]
    said = (
        f"Errors that last: those of neighbouring fixes are alike over about {duration(errors.seconds)}, by "
        f"{metres(errors.std)}; standard deviations are larger for that"
    )
    return replace(one, covariance=covariance, found=replace(one.found, said=(*one.found.said, said)))


def _of_a_mean(kept: float, count: Array) -> Array:
    """Variance of the mean of so many values of a process of variance 1 that keeps a share from each to the next."""
    spare = 2 * kept * (1 - kept**count) / (count * (1 - kept) ** 2)
    return np.asarray(((1 + kept) / (1 - kept) - spare) / count)
