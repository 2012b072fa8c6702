"""Time-correlated errors, as of a phone between houses: their probability, and covariances that contain them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchfra.cleaning.batches import Steps, padded
from torchfra.cleaning.cleaned import Cleaned
from torchfra.cleaning.kinds import KINDS
from torchfra.cleaning.positions import Answer, period_of
from torchfra.cleaning.process_noise import LONGEST
from torchfra.filters.alarms import LIKELY
from torchfra.readers.columns import Array
from torchfra.tables import duration, metres

_LEAST, _LONGEST = 30, 10.0
"""Fewest fixes, and longest median time between them, s, with which time-correlated errors are examined."""
_SECONDS = {10.0: 1.0, 20.0: 2.0, 40.0: 4.0}
"""Correlation times, s, with their prior weights."""
_SIZES = {0.5: 1.0, 0.7: 1.0, 1.0: 1.0, 1.5: 0.5, 2.5: 0.2, 4.0: 0.1, 6.0: 0.05}
"""Standard deviations in units of sigma, with their prior weights."""
_WHITE = (1.0, 0.9, 0.75, 0.5, 0.2)
"""Standard deviations of the white noise, alone or beside them, in units of sigma."""
_CALM = (1.0, 1 / 4, 1 / 16, 1 / 64)
"""Factors on the process noise where a target goes straight on: the estimated one includes the errors."""
_STRAIGHT = 3.0
"""Times the median process noise below which a target goes straight on."""
_STEPS, _ROWS = 256, 4
"""Fixes of a row, and rows, that are examined of each track."""
_TOGETHER = 16
"""Rows of one batch."""
_NOTABLE = 1.1
"""Factor on standard deviations above which a note is written."""
_DETECTED = 0.9
"""Probability above which time-correlated errors are detected, and not assumed."""
_POSITION_VARIANCE, _VELOCITY_VARIANCE = 1e10, 1e5
"""Prior variances of position and velocity, in units of a fix and seconds."""


class CorrelatedErrors(NamedTuple):
    """Hypotheses about errors of positions, per axis: Gauss-Markov processes, or none."""

    probability: Array
    """``(H,)`` of each; the rest to 1 is the probability of none."""
    std: Array
    """``(H,)`` of the process, m."""
    seconds: Array
    """``(H,)`` its correlation time, s."""
    sigma: float
    """Standard deviation of a fix, estimated with white noise alone, m."""


class _Hypotheses(NamedTuple):
    """Hypotheses that are tried for every track; each ``(H,)``."""

    size: Tensor
    seconds: Tensor
    white: Tensor
    calm: Tensor
    log_prior: Tensor
    """Conditional on time-correlated errors, and on none: each of the two sums to 1."""


def _hypotheses() -> _Hypotheses:
    without = [(0.0, 1.0, white, calm, 1.0, 1.0) for white, calm in product(_WHITE, _CALM)]
    correlated = [
        (size, seconds, white, calm, likely, often)
        for (size, likely), (seconds, often), white, calm in product(_SIZES.items(), _SECONDS.items(), _WHITE, _CALM)
    ]
    size, seconds, white, calm, *prior = torch.tensor(without + correlated, dtype=torch.float64).T
    weight, there = prior[0] * prior[1], size > 0
    total = torch.where(there, weight[there].sum(), weight[~there].sum())
    return _Hypotheses(size, seconds, white, calm, (weight / total).log())


def correlated_errors(
    tracks: Sequence[Steps], kinds: Sequence[str], answers: Sequence[Answer]
) -> list[CorrelatedErrors | None]:
    """Probabilities of time-correlated errors of each track, by its likelihood; None where they are not examined.

    Each hypothesis is a Gauss-Markov process beside white noise, and a motion of nearly constant velocity whose process
    noise is the estimated one, or less where the target goes straight on.  Where the likelihood does not decide, as for
    a target that turns as often as errors change, the posterior is near the prior of its kind.

    Args:
        tracks: steps of each.
        kinds: name of the kind of each.
        answers: their results with white noise alone.
    """
    tried, found = _hypotheses(), list[CorrelatedErrors | None]([None] * len(tracks))
    measured = [np.flatnonzero(steps.measured & ~np.isnan(steps.raw[:, :2]).any(1)) for steps in tracks]
    examined = [i for i, at in enumerate(measured) if len(at) >= _LEAST and period_of(tracks[i]) <= _LONGEST]
    rows = [(i, part) for i in examined for part in _parts_of(measured[i])]
    fit = [torch.zeros_like(tried.size) for _ in tracks]
    for first in range(0, len(rows), _TOGETHER):
        some = rows[first : first + _TOGETHER]
        for (i, _), fits in zip(some, _fits(tracks, answers, some, tried), strict=True):
            fit[i] += fits
    there = tried.size > 0
    for i in examined:
        usual = KINDS[kinds[i]].correlated
        prior = torch.where(there, usual, 1 - usual).log() + tried.log_prior
        every = (fit[i] + prior).softmax(0)[there].unflatten(0, (-1, len(_WHITE) * len(_CALM)))
        size, seconds = (x[there][:: every.shape[1]].numpy() for x in (tried.size, tried.seconds))
        sigma = _usual(tracks[i], measured[i], answers[i])
        found[i] = CorrelatedErrors(every.sum(1).numpy(), sigma * size, seconds, sigma)
    return found


def _parts_of(fixes: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Some stretches of the fixes of a track, all of them if it is short."""
    parts = np.array_split(fixes, max(1, round(len(fixes) / _STEPS)))
    chosen = np.linspace(0, len(parts) - 1, min(_ROWS, len(parts))).round().astype(int)
    return [parts[k] for k in chosen]


def _fits(
    tracks: Sequence[Steps], answers: Sequence[Answer], rows: Sequence[tuple[int, NDArray[np.intp]]], tried: _Hypotheses
) -> Tensor:
    """Log-likelihoods ``(B, H)`` of rows, with fixes in units of their usual standard deviation."""
    z, gap, std = padded([tracks[i].at(at) for i, at in rows])
    q = torch.ones_like(gap)
    for b, (i, at) in enumerate(rows):
        z[b, : len(at), :2][torch.from_numpy(answers[i].outlier[at] > LIKELY)] = torch.nan
        q[b, : len(at)] = torch.from_numpy(answers[i].density[at])
    straight = q < _STRAIGHT * torch.stack([q[b, : len(at)].median() for b, (_, at) in enumerate(rows)]).unsqueeze(1)
    variance = (std[..., 0] * torch.tensor([answers[i].sigma for i, _ in rows], dtype=z.dtype).unsqueeze(1)).square()
    usual = torch.tensor([_usual(tracks[i], at, answers[i]) for i, at in rows], dtype=z.dtype)
    density = torch.where(straight.unsqueeze(-1), tried.calm, 1.0) * (q / usual.square().unsqueeze(1)).unsqueeze(-1)
    # The way of a target over a pause is no evidence of errors.
    density = torch.where((gap > LONGEST).unsqueeze(-1), (_VELOCITY_VARIANCE / gap).unsqueeze(-1), density)
    return log_likelihood(
        (z[..., :2].permute(1, 2, 0) / usual).unsqueeze(-1), gap.T.unsqueeze(-1),
        (variance.T / usual.square()).unsqueeze(-1) * tried.white.square(), density.movedim(1, 0),
        tried.size.square(), tried.seconds,
    )  # fmt: skip


def _usual(steps: Steps, at: NDArray[np.intp], answer: Answer) -> float:
    """The usual standard deviation of a fix, m."""
    return answer.sigma * float(np.median(steps.std[at, 0]))


def log_likelihood(z: Tensor, gap: Tensor, variance: Tensor, q: Tensor, error: Tensor, seconds: Tensor) -> Tensor:
    """Log-likelihood of fixes with white noise and a Gauss-Markov error, by a Kalman filter.

    Its states are position, velocity and error.  The axes are alike and independent, and the first two fixes, which
    determine position and velocity, do not count.

    Args:
        z: ``(T, d, ...)`` in any unit of length, m say; NaN where there is none.
        gap: ``(T, ...)`` seconds since the step before.
        variance: ``(T, ...)`` of the white noise, m^2.
        q: ``(T, ...)`` density of the process noise up to each step, m^2/s^3.
        error: ``(...)`` variance of the Gauss-Markov error, m^2.
        seconds: ``(...)`` its correlation time, s.

    Returns:
        ``(...)``.
    """
    missing = z.isnan().any(1)
    measured, count = (~missing).to(z), (~missing).cumsum(0)
    z = z.nan_to_num()
    shape = torch.broadcast_shapes(variance.shape[1:], q.shape[1:], error.shape)
    none = z.new_zeros(shape)
    p, v, e = (z.new_zeros(z.shape[1], *shape) for _ in range(3))
    pp, vv, ee = none + _POSITION_VARIANCE, none + _VELOCITY_VARIANCE, none + error
    pv = pe = ve = total = none
    for k in range(len(z)):
        if k:
            dt, kept = gap[k], torch.exp(-gap[k] / seconds)
            p, e = p + dt * v, kept * e
            ahead = pv + dt * vv
            pp, pv, vv = pp + dt * (pv + ahead) + q[k] * dt**3 / 3, ahead + q[k] * dt**2 / 2, vv + q[k] * dt
            pe, ve, ee = kept * (pe + dt * ve), kept * ve, kept**2 * ee + (1 - kept**2) * error
        hp, hv, he = pp + pe, pv + ve, pe + ee
        spread = hp + he + variance[k]
        residual = measured[k] * (z[k] - p - e)
        fit = residual.square().sum(0) / spread + len(residual) * spread.log()
        total = total - 0.5 * torch.where(count[k] > 2, measured[k] * fit, 0.0)
        gp, gv, ge = (measured[k] * x / spread for x in (hp, hv, he))
        p, v, e = p + gp * residual, v + gv * residual, e + ge * residual
        pp, pv, vv, pe, ve, ee = pp - gp * hp, pv - gp * hv, vv - gv * hv, pe - gp * he, ve - gv * he, ee - ge * he
    return total


def widened(one: Cleaned, errors: CorrelatedErrors | None) -> Cleaned:
    """The result with covariances that contain time-correlated errors, weighted by their probabilities.

    An estimate with the variance of the mean of m fixes of independent errors has also the variance of the mean of m
    values of the process.
    """
    if errors is None or one.found.failure:
        return one
    known = (one.covariance[:, 0, 0] + one.covariance[:, 1, 1]) / 2
    count, step = (errors.sigma**2 / known).clip(1.0), np.median(np.diff(one.recording.time))
    kept = np.exp(-step / errors.seconds[:, None])
    more = (errors.probability * errors.std**2) @ _variance_of_mean(kept, count)
    factor = np.sqrt(1 + more / known)
    covariance = one.covariance.copy()
    covariance[:, :2] *= factor[:, None, None]
    covariance[:, :, :2] *= factor[:, None, None]
    notes = _notes(errors) if np.median(factor) > _NOTABLE else ()
    return replace(one, covariance=covariance, found=replace(one.found, notes=(*one.found.notes, *notes)))


def _notes(errors: CorrelatedErrors) -> tuple[str]:
    """The size of time-correlated errors, and whether they are detected or assumed."""
    likely = float(errors.probability.sum())
    share = errors.probability / likely
    std, seconds = (
        metres(float(np.sqrt(share @ errors.std**2))),
        duration(float(np.exp(share @ np.log(errors.seconds)))),
    )
    if likely > _DETECTED:
        return (f"Time-correlated errors detected: {std} over about {seconds}; standard deviations contain them",)
    return (
        "Time-correlated errors possible: not distinguishable from motion here; standard deviations assume "
        f"{std} over about {seconds} with a probability of {100 * likely:.0f} %",
    )


def _variance_of_mean(kept: float, count: Array) -> Array:
    """Variance of the mean of ``count`` values of a process of variance 1 and autocorrelation ``kept`` over a step."""
    spare = 2 * kept * (1 - kept**count) / (count * (1 - kept) ** 2)
    return np.asarray(((1 + kept) / (1 - kept) - spare) / count)
