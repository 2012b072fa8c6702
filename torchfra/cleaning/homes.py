"""Targets that return to a home between rare fixes: their motion is not white noise about a random walk."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

_RATIOS = 2.0 ** torch.arange(-12.0, 5.0, dtype=torch.float64)
"""Variances that are tried of the home's drift between two fixes, and of slow returns, in units of the other one."""
_SOON, _LATER = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0), (8.0, 16.0, 32.0)
"""Correlation times of a deviation without white noise, and beside it, in units of the usual time between fixes."""
_ANYWHERE = 1e12
"""Variance of the home before the first fix, in units of the noise or the deviation."""


class Homes(NamedTuple):
    """Log-likelihoods ``(B,)`` of fixes about a home that drifts, and the noise that explains them."""

    white: Tensor
    """With white noise."""
    sigma: Tensor
    """The standard deviation of that noise, in units of the fixes' own."""
    returns: Tensor
    """With a deviation from a drifting home that is forgotten in a few fixes, and no noise."""


class Fit(NamedTuple):
    """Sums over the innovations of fixes but the first; each ``(..., B)``."""

    squares: Tensor
    """Of their normalised squares."""
    log_variance: Tensor
    """Of the log of their variances."""
    number: Tensor
    """``(B,)`` number of these."""


def homes(z: Tensor, gap: Tensor, variance: Tensor, owner: Tensor) -> Homes:
    """The largest log-likelihoods of fixes with white noise, and of a target that returns within a few fixes.

    Beside white noise its home drifts, or it returns to it within many fixes.

    Source: Dunn & Gipson (1977), Biometrics 33, 85, for the Ornstein-Uhlenbeck process about a home.

    Args:
        z: ``(T, d, B)`` m; NaN where there is none, or an outlier.
        gap: ``(T, B)`` seconds since the step before.
        variance: ``(T, B)`` of the fixes in units of sigma squared.
        owner: ``(B,)`` numbers; rows of the same one have common values.
    """
    period = gap[1:].median(0).values
    ratio = _RATIOS.to(z).unsqueeze(1)
    one, none = torch.ones_like(ratio * period), torch.zeros_like(ratio * period)
    soon, later = (torch.tensor(of).to(z)[:, None, None] * period for of in (_SOON, _LATER))
    returns = _likelihoods(innovations(z, gap, variance, none, ratio / period, one, soon), owner)[0]
    white, noise = (
        torch.cat(of) for of in zip(
            _likelihoods(innovations(z, gap, variance, one, ratio / period, none, one), owner),
            _likelihoods(innovations(z, gap, variance, one, none, ratio * variance.median(0).values, later), owner),
            strict=True,
        )
    )  # fmt: skip
    best = white.argmax(0, keepdim=True)
    return Homes(white.amax(0), noise.gather(0, best)[0].sqrt(), returns.amax(0))


def _likelihoods(fit: Fit, owner: Tensor) -> tuple[Tensor, Tensor]:
    """The largest log-likelihoods ``(H, B)`` over a common factor on all variances, and that factor."""
    squares, log_variance = fit.squares.flatten(0, -2), fit.log_variance.flatten(0, -2)
    sums = torch.cat([squares, log_variance, fit.number.unsqueeze(0)])
    sums = sums.new_zeros(len(sums), int(owner.max()) + 1).index_add(1, owner, sums)[:, owner]
    squares, log_variance, (count,) = sums.split([len(squares), len(squares), 1])
    factor = squares / count
    return -0.5 * (count * factor.log() + count + log_variance), factor


def innovations(
    z: Tensor, gap: Tensor, variance: Tensor, noise: Tensor, drift: Tensor, deviation: Tensor, seconds: Tensor
) -> Fit:
    """The innovations of a Kalman filter for fixes about a home.

    Its states are the home, a random walk, and the deviation from it, a Gauss-Markov process.

    Args:
        z: ``(T, d, B)`` m; NaN where there is none.
        gap: ``(T, B)`` seconds since the step before.
        variance: ``(T, B)`` of the fixes in units of ``noise``.
        noise: ``(..., B)`` m^2.
        drift: ``(..., B)`` density of the home's random walk, m^2/s.
        deviation: ``(..., B)`` variance of the deviation, m^2.
        seconds: ``(..., B)`` its correlation time, s.
    """
    measured, axes = (~z.isnan().any(1)).to(z), z.shape[1]
    before, z = measured.cumsum(0) > 1, z.nan_to_num().movedim(1, 0)
    shape = torch.broadcast_shapes(noise.shape, drift.shape, deviation.shape, seconds.shape)
    h = torch.zeros(axes, *shape, dtype=z.dtype)
    e, he = torch.zeros_like(h), torch.zeros(shape, dtype=z.dtype)
    hh, ee = torch.full_like(he, _ANYWHERE), deviation + he
    squares = log_variance = he
    for k in range(z.shape[1]):
        if k:
            kept = torch.exp(-gap[k] / seconds)
            hh, he, ee, e = hh + drift * gap[k], kept * he, deviation + kept**2 * (ee - deviation), kept * e
        to_home, to_deviation = hh + he, he + ee
        spread = to_home + to_deviation + noise * variance[k]
        residual = z[:, k].reshape(axes, *[1] * (len(shape) - 1), -1) - h - e
        counts = measured[k] * before[k]
        squares = squares + counts * residual.square().sum(0) / spread
        log_variance = log_variance + counts * axes * spread.log()
        gain_h, gain_e = measured[k] * to_home / spread, measured[k] * to_deviation / spread
        h, e = h + gain_h * residual, e + gain_e * residual
        hh, he, ee = hh - gain_h * to_home, he - gain_h * to_deviation, ee - gain_e * to_deviation
    return Fit(squares, log_variance, axes * (measured * before).sum(0))
