"""Motion as rough as noise: targets that return to a home, or change their course, between two fixes."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.cleaning.closed_form import Fixes
from torchfra.cleaning.process_noise import LONGEST
from torchfra.numbers import as_tensor

_RATIOS = 2.0 ** torch.arange(-12.0, 5.0, dtype=torch.float64)
"""Variances that are tried of the home's drift between two fixes, and of slow returns, in units of the other one."""
_SOON, _LATER = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0), (8.0, 16.0, 32.0)
"""Correlation times of a deviation without white noise, and beside it, in units of the usual time between fixes."""
_COURSE, _ROUGH = (0.5, 1.0, 2.0, 4.0, 8.0), (0.25, 0.5, 1.0)
"""Correlation times of a velocity beside white noise, and of one without it, in the same unit."""
_SURE = 6.0
"""Log-likelihood by which a home without noise must be likelier: who returns at once is as white as noise."""
_ANYWHERE = 1e12
"""Variance of the home before the first fix, in units of the noise or the deviation."""


class Fit(NamedTuple):
    """Sums over the innovations of fixes but the first; each ``(..., B)``."""

    squares: Tensor
    """Of their normalised squares."""
    log_variance: Tensor
    """Of the log of their variances."""
    number: Tensor
    """``(B,)`` number of these."""


def log_odds_of_roughness(fixes: Fixes, owner: Tensor, one_size: Tensor) -> Tensor:
    """Log of how much likelier fixes ``(B,)`` are by a motion as rough as noise than with white noise.

    Without noise the target forgets its velocity within a fix; or, where fixes are rare, it returns within a few to a
    home that drifts.  Beside white noise it drifts, returns within many fixes, or keeps its velocity for some.  The
    largest likelihoods are compared.

    Source: Dunn & Gipson (1977), Biometrics 33, 85, for the Ornstein-Uhlenbeck process about a home; Johnson et al.
    (2008), Ecology 89, 1208, for that of a velocity.

    Args:
        fixes: NaN where there is none, or an outlier.
        owner: ``(B,)`` numbers; rows of the same one have common values.
        one_size: ``(B,)`` whether the motion is about as large at any time, so that it may forget its velocity.
    """
    z, gap, period = fixes.z, fixes.gap, fixes.period.nan_to_num(1.0)
    ratio = _RATIOS.to(z).unsqueeze(1)
    one, none = torch.ones_like(ratio * period), torch.zeros_like(ratio * period)
    soon, later, course, rough = (as_tensor(of, z)[:, None, None] * period for of in (_SOON, _LATER, _COURSE, _ROUGH))
    scaled = fixes.variance / torch.where(fixes.missing, math.nan, fixes.variance).nanmedian(0).values.nan_to_num(1.0)

    def likelihood(*motion: Tensor, velocity: bool = False) -> Tensor:
        return _likelihood(innovations(z, gap, scaled, *motion, velocity=velocity), owner)

    without = [
        likelihood(none[:1], none[:1], one[:1] / period.square(), rough, velocity=True).where(one_size, -torch.inf),
        likelihood(none, ratio / period, one, soon).where(period > LONGEST, -torch.inf) - _SURE,
    ]
    beside = [
        likelihood(one, ratio / period, none, one),
        likelihood(one, none, ratio, later),
        likelihood(one, none, 2.0**12 * ratio / period.square(), course, velocity=True),
    ]
    return torch.stack(without).amax(0) - torch.stack(beside).amax(0)


def _likelihood(fit: Fit, owner: Tensor) -> Tensor:
    """The largest log-likelihood ``(B,)`` of hypotheses, each with the likeliest common factor on its variances."""
    squares, log_variance = fit.squares.flatten(0, -2), fit.log_variance.flatten(0, -2)
    sums = torch.cat([squares, log_variance, fit.number.unsqueeze(0)])
    sums = sums.new_zeros(len(sums), int(owner.max()) + 1).index_add(1, owner, sums)[:, owner]
    squares, log_variance, (count,) = sums.split([len(squares), len(squares), 1])
    likelihoods: Tensor = -0.5 * (count * (squares / count).log() + count + log_variance)
    return likelihoods.amax(0)


def innovations(
    z: Tensor, gap: Tensor, variance: Tensor, noise: Tensor, drift: Tensor, deviation: Tensor, seconds: Tensor,
    *, velocity: bool = False,
) -> Fit:  # fmt: skip
    """The innovations of a Kalman filter for fixes about a home, or of a target whose velocity changes.

    Its states are the home, a random walk, and the deviation from it, a Gauss-Markov process; or the position and its
    velocity, which is this process.

    Args:
        z: ``(T, d, B)`` m; NaN where there is none.
        gap: ``(T, B)`` seconds since the step before.
        variance: ``(T, B)`` of the fixes in units of ``noise``.
        noise: ``(..., B)`` m^2.
        drift: ``(..., B)`` density of the home's random walk, m^2/s.
        deviation: ``(..., B)`` variance of the deviation, m^2, or of the velocity, m^2/s^2.
        seconds: ``(..., B)`` its correlation time, s.
        velocity: whether it is of the velocity.
    """
    seen = 0.0 if velocity else 1.0
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
            way = (1 - seen) * seconds * (1 - kept)
            walked = (1 - seen) * seconds**2 * (2 * gap[k] / seconds - (1 - kept) * (3 - kept))
            h, e = h + way * e, kept * e
            hh = hh + way * (2 * he + way * ee) + drift * gap[k] + deviation * walked
            he = kept * (he + way * ee) + deviation * way * (1 - kept)
            ee = deviation + kept**2 * (ee - deviation)
        to_home, to_deviation = hh + seen * he, he + seen * ee
        spread = to_home + seen * to_deviation + noise * variance[k]
        residual = z[:, k].reshape(axes, *[1] * (len(shape) - 1), -1) - h - seen * e
        counts = measured[k] * before[k]
        squares = squares + counts * residual.square().sum(0) / spread
        log_variance = log_variance + counts * axes * spread.log()
        gain_h, gain_e = measured[k] * to_home / spread, measured[k] * to_deviation / spread
        h, e = h + gain_h * residual, e + gain_e * residual
        hh, he, ee = hh - gain_h * to_home, he - gain_h * to_deviation, ee - gain_e * to_deviation
    return Fit(squares, log_variance, axes * (measured * before).sum(0))
