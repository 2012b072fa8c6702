"""Statistics of runs: confidence intervals, paired tests, correction for multiple tests, and chi-square bounds."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from torchfra.numbers import Array

LEVEL = 0.95
"""Confidence of intervals."""
EXACT = 25
"""Runs up to which the signed-rank test needs no approximation."""
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(200)


class Interval(NamedTuple):
    """A value with a confidence interval."""

    value: float
    low: float
    high: float


def mean_interval(values: ArrayLike) -> Interval:
    """The mean of independent values ``(N,)`` with Student's interval.

    NaN does not count; infinite values make the mean infinite, and fewer than two values have no interval (NaN).
    """
    x = _known(values)
    if len(x) == 0:
        return Interval(math.nan, math.nan, math.nan)
    mean = float(x.mean())
    if len(x) < 2 or not math.isfinite(mean):
        return Interval(mean, math.nan, math.nan)
    with np.errstate(over="ignore"):  # where squares overflow the interval is infinite
        half = student_quantile((1 + LEVEL) / 2, len(x) - 1) * float(x.std(ddof=1)) / math.sqrt(len(x))
    return Interval(mean, mean - half, mean + half)


def median_interval(values: ArrayLike) -> Interval:
    """The median of independent values ``(N,)`` of any distribution, with an interval between two of them.

    NaN does not count.  Bounds are the order statistics that hold the median with 95 % probability or more (binomial);
    they are NaN where there are too few values.
    """
    x = np.sort(_known(values))
    if len(x) == 0:
        return Interval(math.nan, math.nan, math.nan)
    below = int(_binomial_quantile(len(x), (1 - LEVEL) / 2))
    middle = float(np.median(x))
    if below < 1:
        return Interval(middle, math.nan, math.nan)
    return Interval(middle, float(x[below - 1]), float(x[len(x) - below]))


def signed_rank(one: ArrayLike, other: ArrayLike) -> float:
    """Two-sided p of Wilcoxon's signed-rank test of two filters' errors on the same runs ``(N,)``.

    Runs on which both are equal, or one is NaN, do not count; an infinite error has the highest rank; p is 1 where
    nothing differs.  Up to ``EXACT`` runs have the exact distribution of the sum of ranks over all signs, ties
    included; more have the normal approximation, corrected for ties and continuity.

    Source: Wilcoxon (1945); Pratt & Gibbons (1981), section 3.7; Streitberg & Roehmel (1986) for the distribution.
    """
    a, b = np.asarray(one, dtype=float), np.asarray(other, dtype=float)
    with np.errstate(invalid="ignore"):
        gap = np.where(a == b, 0.0, a - b)
    gap = gap[~np.isnan(gap) & (gap != 0)]
    n = len(gap)
    if n == 0:
        return 1.0
    _, inverse, counts = np.unique(np.abs(gap), return_inverse=True, return_counts=True)
    rank = (np.cumsum(counts) - (counts - 1) / 2)[inverse]
    off = abs(float(rank[gap > 0].sum()) - n * (n + 1) / 4)
    if n <= EXACT:
        return _two_sided(np.rint(2 * rank).astype(int), round(4 * off))
    variance = n * (n + 1) * (2 * n + 1) / 24 - float((counts.astype(float) ** 3 - counts).sum()) / 48
    return math.erfc(max(off - 0.5, 0.0) / math.sqrt(2 * variance)) if variance > 0 else 1.0


def _two_sided(doubled: NDArray[np.int_], off: int) -> float:
    """The probability of a sum of ranks at least so far from its mean, where each counts with probability one half.

    Args:
        doubled: twice the ranks, which may be halves.
        off: four times the distance from the mean.
    """
    probability = np.zeros(int(doubled.sum()) + 1)  # of each sum of doubled ranks
    probability[0] = 1.0
    for rank in doubled:
        probability[rank:] += probability[: len(probability) - rank].copy()
        probability /= 2
    far = np.abs(2 * np.arange(len(probability)) - doubled.sum()) >= off
    return min(1.0, float(probability[far].sum()))


def holm(p: Sequence[float]) -> list[float]:
    """P values of tests made together, corrected: a level then bounds the probability of any false rejection.

    Source: Holm (1979).
    """
    order = sorted(range(len(p)), key=lambda i: p[i])
    corrected, most = [0.0] * len(p), 0.0
    for rank, i in enumerate(order):
        most = max(most, min(1.0, (len(p) - rank) * p[i]))
        corrected[i] = most
    return corrected


def chi_square_bounds(degrees: float) -> tuple[float, float]:
    """Bounds of a chi-square variable divided by its degrees of freedom, between which it lies with 95 % probability.

    The mean over ``N`` runs of a normalised error squared of ``d`` components, divided by ``d``, lies between the
    bounds of ``N d`` degrees if the covariances are consistent: Bar-Shalom, Li & Kirubarajan (2001), section 5.4.2.
    """

    def below(x: float) -> float:
        half = torch.tensor([degrees / 2, x / 2], dtype=torch.float64)
        return float(torch.special.gammainc(half[0], half[1]))

    high = degrees + 20 * math.sqrt(2 * degrees) + 40
    low, most = (_root(below, share, 0.0, high) for share in ((1 - LEVEL) / 2, (1 + LEVEL) / 2))
    return low / degrees, most / degrees


def student_quantile(share: float, degrees: int) -> float:
    """The value that Student's t of so many degrees of freedom is below with probability ``share``, 0.5 or more."""

    def below(t: float) -> float:
        # with t = sqrt(degrees) tan(angle) the density is a power of a cosine
        angle = math.atan(t / math.sqrt(degrees))
        logs = (degrees - 1) * np.log(np.cos(angle / 2 * (_NODES + 1)))
        norm = math.lgamma((degrees + 1) / 2) - math.lgamma(degrees / 2) - 0.5 * math.log(math.pi)
        return 0.5 + angle / 2 * float((_WEIGHTS * np.exp(logs + norm)).sum())

    high = 8.0
    while below(high) < share:
        high *= 2
    return _root(below, share, 0.0, high)


def _root(rising: Callable[[float], float], value: float, low: float, high: float) -> float:
    """The argument at which a rising function has a value, by bisection."""
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if rising(middle) < value else (low, middle)
    return (low + high) / 2


def _binomial_quantile(n: int, share: float) -> int:
    """The largest ``k`` with ``P(B < k) <= share``, of a binomial ``B(n, 1/2)``."""
    if n > 10_000:
        z = student_quantile(1 - share, n - 1)
        return math.floor(n / 2 - z * math.sqrt(n) / 2)
    logs = math.lgamma(n + 1) - n * math.log(2)
    total, k = 0.0, 0
    while True:
        total += math.exp(logs - math.lgamma(k + 1) - math.lgamma(n - k + 1))
        if total > share:
            return k
        k += 1


def _known(values: ArrayLike) -> Array:
    x = np.asarray(values, dtype=np.float64)
    known: Array = x[~np.isnan(x)]
    return known
