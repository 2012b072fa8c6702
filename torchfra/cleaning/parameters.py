"""Parameters of tracks, estimated from their fixes: sigma, process noise and outliers; and estimates by these."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchfra.cleaning.closed_form import DEFAULT, Belief
from torchfra.cleaning.parts import Part, summed
from torchfra.cleaning.sigma import finer_sigma, little_gained, lowest_sigma
from torchfra.cleaning.two_filters import Smoothed, filtered, two_filters

_ROUNDS = 2
"""Number of times that all parameters but sigma are estimated."""
_FEW = 2.0
"""Weight of the prior shares of levels, in fixes."""
_WORTH = 300.0, 30.0
"""Weight of the default rates of outliers, in fixes: of those conditional on an inlier, and on an outlier."""
_SURELY = 0.95
"""Probability above which an outlier is left out of the path where sigma is unsure."""
_DECIDED = 50.0
"""Log odds of outliers and inliers that are decided."""


def fitted(parts: list[Part], owner: Tensor, *, find_sigma: bool, find_q: bool) -> list[Part]:
    """Parts with parameters that are estimated from all of their fixes.

    Each round sets the shares of levels and the probabilities of outliers to their smoothed values, as expectation
    maximisation does; the axes across the ground are evidence for outliers in height, and conversely.  The last step is
    the likeliest sigma nearby, and the lowest that is not ruled out.

    Args:
        parts: the axes; the first are those across the ground.
        owner: ``(B,)`` numbers; rows of the same one are of one track, or of tracks with common values.
        find_sigma: whether to estimate sigma.
        find_q: whether to estimate the shares of the levels.
    """
    before = [part.levels for part in parts]
    for _ in range(_ROUNDS):
        smoothed = [two_filters(part.scaled, part.levels, part.model.independent_offsets) for part in parts]
        if find_q:
            parts = [_with_shares(part, of, owner) for part, of in zip(parts, smoothed, strict=True)]
        parts = [_with_transition(part, of, owner) for part, of in zip(parts, smoothed, strict=True)]
        parts = _with_evidence(parts, smoothed, owner)
    unsure = [little_gained(part, of, owner) for part, of in zip(parts, smoothed, strict=True)]
    if not find_sigma:
        lowest = [part.sigma.where(of, math.nan) for part, of in zip(parts, unsure, strict=True)]
        return [part._replace(lowest=of) for part, of in zip(parts, lowest, strict=True)]
    parts = [part._replace(sigma=finer_sigma(part, owner).maximum(part.least)) for part in parts]
    # With the prior levels: the estimated ones fit the motion that the estimated sigma left.
    asked = [part._replace(levels=levels) for part, levels in zip(parts, before, strict=True)]
    lowest = [_lowest_of(part, rows, owner) for part, rows in zip(asked, unsure, strict=True)]
    return [part._replace(lowest=sigma) for part, sigma in zip(parts, lowest, strict=True)]


def _lowest_of(part: Part, unsure: Tensor, owner: Tensor) -> Tensor:
    """The lowest sigma ``(B,)`` that is not ruled out, of ``unsure (B,)`` rows; NaN of the others."""
    rows = unsure.nonzero()[:, 0]
    lowest = torch.full_like(part.sigma, math.nan)
    return lowest.index_copy(0, rows, lowest_sigma(part.at(rows), owner[rows])) if len(rows) else lowest


def _with_shares(part: Part, smoothed: Smoothed, owner: Tensor) -> Part:
    """The part with the smoothed shares of the levels."""
    measured = (~part.fixes.missing).to(part.sigma).unsqueeze(1)
    share = summed((measured * smoothed.levels).sum(0), owner) + _FEW * part.levels.log_share.exp()
    return part._replace(levels=part.levels._replace(log_share=(share / share.sum(0)).log()))


def _with_transition(part: Part, smoothed: Smoothed, owner: Tensor) -> Part:
    """The part with smoothed probabilities of an outlier after an inlier and after an outlier."""
    both = ~(part.fixes.missing[1:] | part.fixes.missing[:-1])
    usual = DEFAULT.after_inlier, DEFAULT.after_outlier
    after_inlier, after_outlier = _rates(smoothed.outlier[1:], smoothed.outlier[:-1], both, owner, usual)
    return part._replace(model=part.model._replace(after_inlier=after_inlier, after_outlier=after_outlier))


def _with_evidence(parts: Sequence[Part], smoothed: Sequence[Smoothed], owner: Tensor) -> list[Part]:
    """Parts with the evidence of each other for outliers, and the rates of outliers beside inliers and outliers."""
    if len(parts) == 1:
        return list(parts)
    both, found = ~(parts[0].fixes.missing | parts[1].fixes.missing), []
    for part, own, other in zip(parts, smoothed, reversed(smoothed), strict=True):
        usual = DEFAULT.beside_inlier, DEFAULT.beside_outlier
        beside_inlier, beside_outlier = _rates(own.outlier, other.outlier, both, owner, usual)
        found.append(
            part._replace(model=part.model._replace(beside_inlier=beside_inlier, beside_outlier=beside_outlier))
        )
    log_odds = [
        _log_mean_with_one(of.evidence, part.model.beside_outlier)
        - _log_mean_with_one(of.evidence, part.model.beside_inlier)
        for of, part in zip(smoothed, found, strict=True)
    ]
    return [
        part._replace(fixes=part.fixes._replace(log_odds=of_other))
        for part, of_other in zip(found, reversed(log_odds), strict=True)
    ]


def _rates(
    outlier: Tensor, other: Tensor, both: Tensor, owner: Tensor, usual: tuple[Tensor | float, Tensor | float]
) -> tuple[Tensor, Tensor]:
    """Rates of outliers where another fix is an inlier, and where it is an outlier.

    Args:
        outlier: ``(T, B)`` probabilities of outliers.
        other: ``(T, B)`` those of the other fixes.
        both: ``(T, B)`` bool, where both fixes exist.
        owner: ``(B,)`` numbers; rows of the same one have the same rates.
        usual: prior rates.
    """
    there = both.to(outlier)
    rates = [
        (worth * rate + summed((of * outlier).sum(0), owner)) / (worth + summed(of.sum(0), owner))
        for rate, worth, of in zip(usual, _WORTH, (there * (1 - other), there * other), strict=True)
    ]
    return rates[0], rates[1]


def estimated(parts: Sequence[Part], *, smooth: bool) -> tuple[list[Smoothed], Tensor]:
    """Estimates of each part, smoothed or, of parts ``on_line``, filtered; and ``(T, B)`` probabilities of outliers."""
    if not smooth:
        smoothed = [filtered(part.scaled, part.levels, part.model) for part in parts]
        return smoothed, _outlier(parts, smoothed)
    smoothed = [two_filters(part.scaled, part.levels, part.model) for part in parts]
    outlier = _outlier(parts, smoothed)
    return [_near_fixes(part, of, outlier) for part, of in zip(parts, smoothed, strict=True)], outlier


def _near_fixes(part: Part, smoothed: Smoothed, outlier: Tensor) -> Smoothed:
    """Estimates with the path of the lowest sigma that a track does not rule out, without its outliers.

    So no fix is moved far for a noise that may not exist.  If the noise does exist, these estimates are off by the
    distance from those of the found sigma too, whose mean square covariances contain; but at a fix that is no outlier
    they are no less certain than the fix.
    """
    rows = (~part.lowest.isnan()).nonzero()[:, 0]
    if not len(rows):
        return smoothed
    some = part.at(rows)
    fixes = some.fixes._replace(log_odds=torch.where(outlier[:, rows] > _SURELY, _DECIDED, -_DECIDED))
    path = two_filters(some._replace(fixes=fixes, sigma=some.lowest).scaled, some.levels, some.model).belief
    old = smoothed.belief
    position, velocity = (of.index_copy(-1, rows, new) for new, of in zip(path[:2], old[:2], strict=True))
    measured = (~fixes.missing).to(path.pp)
    share = measured / measured.sum(0)
    more_p, more_v = (
        (share * (new - of[..., rows]).square().mean(0)).sum(0) for new, of in zip(path[:2], old[:2], strict=True)
    )
    there = ~fixes.missing & (outlier[:, rows] <= _SURELY)
    least = torch.where(there, some.scaled.variance, math.inf)
    pp, pv, vv = old.pp[:, rows] + more_p, old.pv[:, rows], old.vv[:, rows] + more_v
    share = (least / pp).clamp_max(1.0)
    moments = (
        of.index_copy(-1, rows, new) for of, new in zip(old[2:], (share * pp, share.sqrt() * pv, vv), strict=True)
    )
    return smoothed._replace(belief=Belief(position, velocity, *moments))


def _outlier(parts: Sequence[Part], smoothed: Sequence[Smoothed]) -> Tensor:
    """Probabilities ``(T, B)`` that fixes are outliers, in position or height; 0 where there is none."""
    log_odds, missing = smoothed[0].predictions.prior_outlier.logit() + smoothed[0].evidence, parts[0].fixes.missing
    if len(parts) == 2:
        model, height = parts[1].model, smoothed[1].evidence
        alone = torch.zeros_like(height) + model.beside_inlier
        either = torch.logaddexp(log_odds + _log_mean_with_one(height, model.beside_outlier), alone.log() + height)
        log_odds = torch.where(parts[1].fixes.missing, log_odds, either - torch.log1p(-alone))
    return torch.where(missing, 0.0, log_odds.sigmoid())


def _log_mean_with_one(log_factor: Tensor, share: Tensor | float) -> Tensor:
    """Log of the mean of a factor, of weight ``share``, and of 1: the evidence if an outlier is not certain."""
    share = torch.zeros_like(log_factor) + share
    return torch.logaddexp(log_factor + share.log(), torch.log1p(-share))
