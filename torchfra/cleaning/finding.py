"""What fixes say of their noise, of how targets move and of outliers; and with that, where the targets were."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchfra.cleaning.closed_form import DEFAULT
from torchfra.cleaning.parts import Part, summed
from torchfra.cleaning.sigma import finer_sigma, hardly_surer, lowest_sigma
from torchfra.cleaning.two_filters import Smoothed, filtered, two_filters

_ROUNDS = 2
"""Number of times that everything but sigma is found."""
_FEW = 2.0
"""Fixes that shares of levels are worth before any was seen."""
_WORTH = 300.0, 30.0
"""How many fixes the default rates of outliers count for: where the other one, before or beside it, is none; and where
it is an outlier."""
_SURELY = 0.95
"""Probability of an outlier that the path goes past where sigma is open."""
_DECIDED = 50.0
"""Log of the odds of what is decided."""


def fitted(parts: list[Part], owner: Tensor, *, find_sigma: bool, find_q: bool) -> list[Part]:
    """Parts with what is found of all of their fixes.

    Each round takes the levels' shares and how likely outliers are as smoothing has found them, and what the axes
    across the ground say of an outlier counts for the height, and the other way round.  In the end comes the likeliest
    sigma nearby, and the lowest that is not ruled out.

    Args:
        parts: the axes; the first are those across the ground.
        owner: ``(B,)`` numbers; rows of the same one are of one track, or of tracks that are looked at together.
        find_sigma: whether to find sigma.
        find_q: whether to find the shares of the levels.
    """
    before = [part.levels for part in parts]
    for _ in range(_ROUNDS):
        known = [two_filters(part.scaled, part.levels, part.model.independent_offsets) for part in parts]
        if find_q:
            parts = [_with_shares(part, of, owner) for part, of in zip(parts, known, strict=True)]
        parts = [_with_transition(part, of, owner) for part, of in zip(parts, known, strict=True)]
        parts = _with_evidence(parts, known, owner)
    unsure = [hardly_surer(part, of, owner) for part, of in zip(parts, known, strict=True)]
    if not find_sigma:
        lowest = [part.sigma.where(of, math.nan) for part, of in zip(parts, unsure, strict=True)]
        return [part._replace(lowest=of) for part, of in zip(parts, lowest, strict=True)]
    parts = [part._replace(sigma=finer_sigma(part, owner).maximum(part.least)) for part in parts]
    # By the levels from before the track: those that have been found fit the motion that sigma left.
    asked = [part._replace(levels=levels) for part, levels in zip(parts, before, strict=True)]
    lowest = [_lowest_of(part, rows, owner) for part, rows in zip(asked, unsure, strict=True)]
    return [part._replace(lowest=sigma) for part, sigma in zip(parts, lowest, strict=True)]


def _lowest_of(part: Part, chosen: Tensor, owner: Tensor) -> Tensor:
    """The lowest sigma ``(B,)`` of the ``chosen (B,)`` rows, bool, that is not ruled out; NaN of the others."""
    rows = chosen.nonzero()[:, 0]
    lowest = torch.full_like(part.sigma, math.nan)
    return lowest.index_copy(0, rows, lowest_sigma(part.at(rows), owner[rows])) if len(rows) else lowest


def _with_shares(part: Part, known: Smoothed, owner: Tensor) -> Part:
    """With the shares of the levels that smoothing has found."""
    measured = (~part.fixes.missing).to(part.sigma).unsqueeze(1)
    share = summed((measured * known.levels).sum(0), owner) + _FEW * part.levels.log_share.exp()
    return part._replace(levels=part.levels._replace(log_share=(share / share.sum(0)).log()))


def _with_transition(part: Part, known: Smoothed, owner: Tensor) -> Part:
    """With the probabilities of an outlier after an inlier and after an outlier that smoothing has found."""
    both = ~(part.fixes.missing[1:] | part.fixes.missing[:-1])
    usual = DEFAULT.after_inlier, DEFAULT.after_outlier
    after_inlier, after_outlier = _rates(known.outlier[1:], known.outlier[:-1], both, owner, usual)
    return part._replace(model=part.model._replace(after_inlier=after_inlier, after_outlier=after_outlier))


def _with_evidence(parts: Sequence[Part], known: Sequence[Smoothed], owner: Tensor) -> list[Part]:
    """Parts that know what the other says of outliers, and how often one is where the other is."""
    if len(parts) == 1:
        return list(parts)
    both, found = ~(parts[0].fixes.missing | parts[1].fixes.missing), []
    for part, own, other in zip(parts, known, reversed(known), strict=True):
        usual = DEFAULT.beside_inlier, DEFAULT.beside_outlier
        beside_inlier, beside_outlier = _rates(own.outlier, other.outlier, both, owner, usual)
        found.append(
            part._replace(model=part.model._replace(beside_inlier=beside_inlier, beside_outlier=beside_outlier))
        )
    log_odds = [
        _log_mean_with_one(of.evidence, part.model.beside_outlier)
        - _log_mean_with_one(of.evidence, part.model.beside_inlier)
        for of, part in zip(known, found, strict=True)
    ]
    return [
        part._replace(fixes=part.fixes._replace(log_odds=of_other))
        for part, of_other in zip(found, reversed(log_odds), strict=True)
    ]


def _rates(
    outlier: Tensor, other: Tensor, both: Tensor, owner: Tensor, usual: tuple[Tensor | float, Tensor | float]
) -> tuple[Tensor, Tensor]:
    """How often fixes are outliers where another is none, and where it is an outlier.

    Args:
        outlier: ``(T, B)`` probabilities of outliers.
        other: ``(T, B)`` those of the others.
        both: ``(T, B)`` bool, where there are both.
        owner: ``(B,)`` numbers; rows of the same one have the same rates.
        usual: rates before any was seen.
    """
    there = both.to(outlier)
    rates = [
        (worth * rate + summed((of * outlier).sum(0), owner)) / (worth + summed(of.sum(0), owner))
        for rate, worth, of in zip(usual, _WORTH, (there * (1 - other), there * other), strict=True)
    ]
    return rates[0], rates[1]


def estimated(parts: Sequence[Part], *, smooth: bool) -> tuple[list[Smoothed], Tensor]:
    """What is known of each part, from all fixes or those before; and ``(T, B)`` probabilities of outliers."""
    if not smooth:  # what other axes say of an outlier, and how likely one is, is of all fixes
        parts = [
            part._replace(fixes=part.fixes._replace(log_odds=torch.zeros_like(part.fixes.log_odds))) for part in parts
        ]
        parts = [part.on_line for part in parts]
        known = [filtered(part.scaled, part.levels, part.model) for part in parts]
        return known, _outlier(parts, known)
    known = [two_filters(part.scaled, part.levels, part.model) for part in parts]
    outlier = _outlier(parts, known)
    return [_near_fixes(part, of, outlier) for part, of in zip(parts, known, strict=True)], outlier


def _near_fixes(part: Part, known: Smoothed, outlier: Tensor) -> Smoothed:
    """With the path of the lowest sigma that a track does not rule out, past the outliers that are found.

    No fix is moved far for a noise that may not be there.  How sure that is stays as it was.
    """
    rows = (~part.lowest.isnan()).nonzero()[:, 0]
    if not len(rows):
        return known
    some = part.at(rows)
    fixes = some.fixes._replace(log_odds=torch.where(outlier[:, rows] > _SURELY, _DECIDED, -_DECIDED))
    path = two_filters(some._replace(fixes=fixes, sigma=some.lowest).scaled, some.levels, some.model).belief
    position, velocity = (old.index_copy(-1, rows, new) for new, old in zip(path[:2], known.belief[:2], strict=True))
    return known._replace(belief=known.belief._replace(position=position, velocity=velocity))


def _outlier(parts: Sequence[Part], known: Sequence[Smoothed]) -> Tensor:
    """Probabilities ``(T, B)`` that fixes are outliers, in position or height; 0 where there is none."""
    log_odds, missing = known[0].predictions.prior_outlier.logit() + known[0].evidence, parts[0].fixes.missing
    if len(parts) == 2:
        model, height = parts[1].model, known[1].evidence
        alone = torch.zeros_like(height) + model.beside_inlier
        either = torch.logaddexp(log_odds + _log_mean_with_one(height, model.beside_outlier), alone.log() + height)
        log_odds = torch.where(parts[1].fixes.missing, log_odds, either - torch.log1p(-alone))
    return torch.where(missing, 0.0, log_odds.sigmoid())


def _log_mean_with_one(log_factor: Tensor, share: Tensor | float) -> Tensor:
    """Log of the mean of a factor, of weight ``share``, and of 1: the evidence if an outlier is not certain."""
    share = torch.zeros_like(log_factor) + share
    return torch.logaddexp(log_factor + share.log(), torch.log1p(-share))
