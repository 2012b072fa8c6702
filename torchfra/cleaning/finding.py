"""Finds the standard deviation of fixes and the process noise of targets by the likelihood of their tracks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.cleaning.ladder import DEFAULT, Fixes, Levels, OutlierModel, steps
from torchfra.cleaning.two_filters import Smoothed, filtered, two_filters

_COARSE, _FINE = 8, 1.2
"""Standard deviations that are tried at first, each half of the one before; and the ratio of those tried later."""
_LEAST_SIGMA = 1e-4
"""Least standard deviation that is tried, m: fixes that repeat have none."""
_LARGER = 8.0
"""Exponent of the prior of sigma: where a track leaves it open, what looks like noise is taken for noise."""
_MANY, _COST = 0.12, 20.0
"""Share of outliers from which on sigma is taken to be too small, and what each of them then costs."""
_HARDLY, _OPEN, _MISFIT, _MISFIT_STOPS, _LOWER = 0.6, 3.0, 0.2, 0.17, 2.0
"""The share of the standard deviation of its fix above which an estimate is hardly surer; how much less likely a track
may be, in log, with a lower sigma that it does not rule out, and each of its fixes as far as levels of a random walk,
of a few sizes, are for it, or where there are none though targets may stop between fixes; and the ratio of those that
are tried."""
_UNSURE, _FORGOTTEN = 0.28, 7200.0
"""The same of a fix where fixes are rarer than any level ends; and seconds in which targets may forget their velocity,
to a share of 1 / e."""
_SURELY, _DECIDED = 0.8, 50.0
"""Probability of an outlier that the path goes past where sigma is open, and log of the odds of what is decided."""
_STEPS, _ROWS = 200, 2
"""Of each track that are looked at for sigma: steps of a row, and rows."""
SHORT = 0
"""Owner of the rows of all tracks that are too short to be looked at alone."""
_FEW = 2.0
"""Fixes that shares of levels are worth before any was seen."""
_BEFORE = 300.0, 30.0
"""How many fixes the default rates of outliers count for: where the other one, before or beside it, is clean; and where
it is an outlier."""
_ROUNDS = 2
"""Of finding."""
_SLOWEST = 1e-5
"""Least density of the process noise, m^2/s^3."""
_STILL = 0.1
"""How far the least process noise may move a target between two fixes, m."""
_HELD = 1.0
"""Seconds for which a target holds its hardest acceleration at least, however often it is measured."""
_LASTING = 300.0, 15.0
"""Mean time that the least and the largest process noise last, s."""
_SLOW, _GAPS = 0.03, 3.0
"""Where fixes come more rarely than any level ends: change of the velocity between two, m/s, from which on levels are
told apart; and gaps that levels last, as what many levels leave in the mean changes slowly."""
_WALKS, _APART, _STAYS = 5, 2.5, 10.0
"""Levels of a target that comes and goes between two fixes, the ratio of the ways by which they move it, and how many
fixes each of them lasts."""
_RARER = 3.0
"""Log of how much rarer the largest process noise is than the least, before a track has said."""
_RAREST = -25.0
"""Log of the least share: of much rarer levels nothing is left of the digits of ``Levels.chain``."""


class Part(NamedTuple):
    """Axes that are alike, and what is known of them: those across the ground, or the height."""

    fixes: Fixes
    """With the variance in units of sigma squared."""
    levels: Levels
    sigma: Tensor
    """``(B,)`` m."""
    least: Tensor
    """``(B,)`` m that sigma has at least."""
    lowest: Tensor
    """``(B,)`` m, the lowest sigma that a track does not rule out whose estimates are hardly surer than its fixes: the
    path goes as near to these as it says.  NaN of other tracks."""
    stops: Tensor
    """``(B,)`` whether targets may stop between two fixes (``may_stop``)."""
    model: OutlierModel = DEFAULT
    """How likely outliers are."""

    def at(self, rows: Tensor) -> Part:
        """Some of the rows."""
        return Part(
            Fixes(*(x[..., rows] for x in self.fixes)), Levels(*(x[:, rows] for x in self.levels)),
            self.sigma[rows], self.least[rows], self.lowest[rows], self.stops[rows],
            self.model.of_rows(lambda x: x[rows]),
        )  # fmt: skip

    @property
    def on_line(self) -> Part:
        """With outliers as likely as before any fix was seen."""
        return self._replace(model=DEFAULT._replace(reach=self.model.reach))

    @property
    def scaled(self) -> Fixes:
        """The fixes with their variance in m^2."""
        return self.fixes._replace(variance=self.fixes.variance * self.sigma.square())


def levels_up_to(
    acceleration: Tensor, fastest: Tensor, period: Tensor, count: int, q: float | None = None,
    steady: Tensor | float = math.inf,
) -> Levels:  # fmt: skip
    """Levels from going straight to changes of the velocity by ``acceleration (B,)`` m/s^2 for a ``period (B,)`` s.

    Such a change lasts for a second at least: of a car that is measured 20 times a second it takes many periods.  Over
    a long period changes are no larger than the speed ``fastest (B,)`` m/s.  Without that limit a target whose fixes
    come every two hours could be anywhere after each, and no fix an outlier.

    Their shares fall towards the hardest, or to either side of a density ``q`` that is told, m^2/s^3.  Over a period in
    which levels begin and end many times those that begin often are likelier: the hardest of them shapes it.  What many
    leave in the mean changes little from one period to the next: where none lasts as long, each is for some periods.

    Where a target can change its velocity by its speed within a period, and its hardest manoeuvres end within one, it
    may come, go and rest between two fixes, and one says nothing of the way to the next but its length: there levels of
    a random walk are added.  Without them what no velocity explains would be noise.  Of fixes that come more often they
    would take errors that last for motion; and of those that are rarer than ``steady (B,)`` s, the slow drifts of
    animals.
    """
    place = torch.linspace(0.0, 1.0, count, dtype=period.dtype).unsqueeze(1)
    held = acceleration.square() * period.clamp_min(_HELD)
    top = held.minimum(fastest.square() / period).clamp_min(10 * _SLOWEST)
    least = (3 * _STILL**2 / period**3).clamp_max(_SLOWEST)
    slow = torch.where(period > _LASTING[0], _SLOW**2 / period, least)
    density = torch.cat([least.unsqueeze(0), (slow * (top / slow) ** place)[1:]])
    duration = (_LASTING[0] * (_LASTING[1] / _LASTING[0]) ** place).expand_as(density)
    rarer = -_RARER * place if q is None else -0.5 * (density / max(q, _SLOWEST)).log10().square()
    passed = period / duration
    often = passed.log() - (-torch.expm1(-passed)).log()  # next to 0 where levels last
    share = (rarer + often).log_softmax(0).clamp_min(_RAREST).log_softmax(0)
    levels = Levels(density, share, duration.maximum(_GAPS * (period - _LASTING[0])), torch.zeros_like(density))
    turns = fastest / acceleration  # seconds in which a target stops
    walking = may_stop(acceleration, fastest, period, steady) & (period > _LASTING[1])
    return _with_walks(levels, fastest * period, period, turns, walking) if q is None and walking.any() else levels


def _with_walks(levels: Levels, farthest: Tensor, period: Tensor, turns: Tensor, walking: Tensor) -> Levels:
    """With levels of a random walk by shares of the ``farthest (B,)`` way, m, of targets that stop in ``turns`` s.

    Those that are not ``walking`` have levels that move nothing.
    """
    size = walking * farthest / _APART ** torch.arange(_WALKS).flip(0).unsqueeze(1)
    walks = torch.where(walking, period / (period + 4 * turns), math.exp(_RAREST))
    return Levels(
        torch.cat([levels.q, levels.q[:1].expand_as(size)]),
        torch.cat([levels.log_share + torch.log1p(-walks), (walks / _WALKS).log().expand_as(size)]),
        torch.cat([levels.duration, levels.duration[:1].maximum(_STAYS * period).expand_as(size)]),
        torch.cat([levels.walk, size.square() / period]),
    )


def may_stop(acceleration: Tensor, fastest: Tensor, period: Tensor, steady: Tensor | float = math.inf) -> Tensor:
    """Whether targets ``(B,)`` may come, go and rest between two fixes: as ``levels_up_to`` says of its arguments."""
    return (period > (fastest / acceleration / 2).clamp_min(_LASTING[1] / 2)) & (period <= steady)


def first_sigma(fixes: Fixes, levels: Levels, owner: Tensor, model: OutlierModel) -> Tensor:
    """Standard deviations ``(B,)`` of the largest likelihood on a coarse grid below what third differences allow."""
    tried = _rough(fixes, owner) / 2.0 ** torch.arange(_COARSE).unsqueeze(1)
    return likeliest(fixes, levels, owner, tried, model.of_any_offset)


def finer_sigma(part: Part, owner: Tensor) -> Tensor:
    """Standard deviations ``(B,)`` of the largest likelihood near those that are known."""
    factors = _FINE ** torch.arange(2, -3, -1, dtype=part.sigma.dtype)
    tried = part.sigma * factors.unsqueeze(1)
    alone, usual = (
        likeliest(part.fixes, part.levels, owner, tried, of) for of in (part.model.of_any_offset, part.model)
    )
    return alone.maximum(usual)


def likeliest(fixes: Fixes, levels: Levels, owner: Tensor, sigma: Tensor, model: OutlierModel) -> Tensor:
    """Of standard deviations ``(G, B)`` that decrease by a factor, the ones ``(B,)`` of the largest likelihood.

    Between them by the parabola through the largest and its neighbours.

    Args:
        fixes: one after the other, with the variance in units of sigma squared.
        levels: of the process noise.
        owner: ``(B,)`` numbers; rows of the same one have one standard deviation.
        sigma: that are tried.
        model: about outliers.
    """
    fit, wrong, seen = _fits(fixes, levels, owner, sigma, model)
    too_many = (wrong - _MANY * seen).clamp_min(0.0)
    total = fit - _COST * too_many + _LARGER * sigma.log()
    best = total.argmax(0).clamp(1, len(sigma) - 2)
    left, middle, right = (total.gather(0, (best + k).unsqueeze(0))[0] for k in (-1, 0, 1))
    bend = (left - 2 * middle + right).clamp_max(-1e-3)
    place = best + (0.5 * (left - right) / bend).clamp(-1.0, 1.0)
    likely: Tensor = (sigma[0] * (sigma[1] / sigma[0]) ** place).clamp_min(_LEAST_SIGMA)
    return likely


def _lowest(part: Part, begun: Levels, owner: Tensor) -> Tensor:
    """The lowest standard deviations ``(B,)`` that tracks do not rule out.

    Where what is noise and what is motion can hardly be told apart, a sigma that is too large costs far more than one
    that is too small: with it the path cuts corners, and without it the path goes through the fixes.
    """
    tried = part.sigma / _LOWER ** torch.arange(_COARSE).unsqueeze(1)
    fit, _, seen = _fits(part.fixes, begun, owner, tried, part.model.of_any_offset)
    walks, period = (begun.log_share.exp() * (begun.walk > 0)).sum(0), _period(part)
    often = torch.where(walks > 0, _MISFIT * walks, _MISFIT_STOPS * part.stops)
    misfit = torch.where(period > _LASTING[0], -_UNSURE * torch.expm1(-period / _FORGOTTEN), often)
    open_ = fit >= fit.amax(0) - _OPEN - misfit * seen
    last = (open_ * torch.arange(_COARSE).unsqueeze(1)).amax(0)
    return tried.gather(0, last.unsqueeze(0))[0].maximum(part.least)


def _period(part: Part) -> Tensor:
    """Seconds ``(B,)`` between most fixes."""
    return torch.where(part.fixes.missing, math.nan, part.fixes.elapsed).nanmedian(0).values


def _hardly_surer(part: Part, known: Smoothed, owner: Tensor) -> Tensor:
    """Tracks ``(B,)`` whose estimates are mostly hardly surer than their own fixes, or whose fixes are very rare."""
    seen = ~part.fixes.missing
    hardly = seen & (known.belief.pp > _HARDLY**2 * part.scaled.variance)
    several, every = (_summed(of.sum(0).to(part.sigma), owner) for of in (hardly, seen))
    return (several > 0.5 * every) | (_period(part) > _LASTING[0])


def _fits(
    fixes: Fixes, levels: Levels, owner: Tensor, sigma: Tensor, model: OutlierModel
) -> tuple[Tensor, Tensor, Tensor]:
    """Of standard deviations ``(G, B)`` log-likelihoods, expected outliers and numbers of fixes ``(G, B)``."""
    count, looked_at = len(sigma), _looked_at(fixes, owner)
    part = Fixes(*(x[:_STEPS, ..., looked_at] for x in fixes))
    variance = sigma[:, looked_at].square() * part.variance.unsqueeze(1)

    def repeated(x: Tensor) -> Tensor:
        return x.unsqueeze(-2).expand(*x.shape[:-1], count, x.shape[-1]).flatten(-2)

    rows = model.of_rows(lambda x: repeated(x[looked_at]))
    tried = Fixes(repeated(part.z), repeated(part.gap), variance.flatten(1), repeated(part.odds))
    every = steps(tried, Levels(*(repeated(x[:, looked_at]) for x in levels)), rows)
    log_likelihood, outlier = (
        torch.stack(x) for x in zip(*((s.log_likelihood, s.outlier) for s in every), strict=True)
    )
    seen = (~tried.missing).to(sigma)
    sums = torch.stack([log_likelihood * seen, outlier * seen, seen]).sum(1).unflatten(-1, (count, -1))
    fit, wrong, seen = sums.new_zeros(3, count, int(owner.max()) + 1).index_add(-1, owner[looked_at], sums)[..., owner]
    return fit, wrong, seen


def _looked_at(fixes: Fixes, owner: Tensor) -> Tensor:
    """Numbers of the rows from which sigma is found: those of each track with the most fixes, and all short tracks."""
    seen = (~fixes.missing[:_STEPS]).sum(0)
    chosen = []
    for i in owner.unique():
        rows = (owner == i).nonzero()[:, 0]
        most = len(rows) if i == SHORT else _ROWS
        chosen.append(rows[seen[rows].argsort(descending=True, stable=True)[:most]])
    return torch.cat(chosen)


def _rough(fixes: Fixes, owner: Tensor) -> Tensor:
    """Twice the standard deviation ``(B,)`` that third differences would have if nothing but noise was in them.

    It is in units of the usual standard deviation that the file states, if it states one.
    """
    stated = torch.where(fixes.missing, math.nan, fixes.variance).nanmedian(0).values.sqrt()
    third = _third_differences(fixes.z / stated, fixes.gap).square().mean(1).sqrt()
    most = fixes.gap.new_ones(len(owner))
    for i in owner.unique():
        own = third[:, owner == i]
        if bool((~own.isnan()).any()):
            most[owner == i] = 2 * own.nanmedian()
    return most.clamp_min(_LEAST_SIGMA * 2.0**_COARSE / 4)


def _third_differences(z: Tensor, gap: Tensor) -> Tensor:
    """What four fixes in a row have that no parabola in time has, ``(T - 3, d, B)``, as large as the noise of one."""
    time, count = gap.cumsum(0), max(len(z) - 3, 0)
    four = torch.stack([time[k : k + count] for k in range(4)])
    apart = four.unsqueeze(0) - four.unsqueeze(1)
    weight = 1 / (apart + torch.eye(4, dtype=z.dtype)[..., None, None]).prod(0)
    weight = weight / weight.square().sum(0).sqrt()
    return torch.stack([z[k : k + count] * weight[k].unsqueeze(1) for k in range(4)]).sum(0)


def fitted(parts: list[Part], owner: Tensor, *, find_sigma: bool, find_q: bool) -> list[Part]:
    """Parts with what is found of all of their fixes.

    Each round takes the levels' shares and how likely outliers are as smoothing has found them, and what the axes
    across the ground say of an outlier is told to the height, and the other way round.  The last takes the likeliest
    sigma nearby too.

    Args:
        parts: the axes; the first are those across the ground.
        owner: ``(B,)`` numbers; rows of the same one are of one track, or of tracks that are looked at together.
        find_sigma: whether to find sigma.
        find_q: whether to find the shares of the levels.
    """
    begun = [part.levels for part in parts]
    for left in reversed(range(_ROUNDS)):
        known = [two_filters(part.scaled, part.levels, part.model.of_any_offset) for part in parts]
        if find_q:
            parts = [_with_shares(part, of, owner) for part, of in zip(parts, known, strict=True)]
        parts = [_with_chain(part, of, owner) for part, of in zip(parts, known, strict=True)]
        parts = _with_evidence(parts, known, owner)
        if not left:
            hardly = [_hardly_surer(part, of, owner) for part, of in zip(parts, known, strict=True)]
            parts = [
                part._replace(lowest=part.sigma.where(of, math.nan)) for part, of in zip(parts, hardly, strict=True)
            ]
        if find_sigma and not left:
            parts = [part._replace(sigma=finer_sigma(part, owner).maximum(part.least)) for part in parts]
    if find_sigma:
        parts = [_with_lowest(part, levels, owner) for part, levels in zip(parts, begun, strict=True)]
    return parts


def _with_lowest(part: Part, begun: Levels, owner: Tensor) -> Part:
    """With the lowest sigma of the tracks whose estimates are hardly surer than their fixes."""
    rows = (~part.lowest.isnan()).nonzero()[:, 0]
    if not len(rows):
        return part
    lowest = _lowest(part._replace(levels=begun).at(rows), Levels(*(x[:, rows] for x in begun)), owner[rows])
    return part._replace(lowest=part.lowest.index_copy(0, rows, lowest))


def estimated(parts: Sequence[Part], *, smooth: bool) -> tuple[list[Smoothed], Tensor]:
    """What is known of each part, from all fixes or those before; and ``(T, B)`` probabilities of outliers."""
    if smooth:
        known = [two_filters(part.scaled, part.levels, part.model) for part in parts]
    else:  # what other axes say of an outlier, and how likely one is, is of all fixes
        unsaid = [part.fixes._replace(odds=torch.zeros_like(part.fixes.odds)) for part in parts]
        parts = [part._replace(fixes=fixes).on_line for part, fixes in zip(parts, unsaid, strict=True)]
        known = [filtered(part.scaled, part.levels, part.model) for part in parts]
    outlier = _outlier(parts, known)
    return [_near_fixes(part, of, outlier) if smooth else of for part, of in zip(parts, known, strict=True)], outlier


def _near_fixes(part: Part, known: Smoothed, outlier: Tensor) -> Smoothed:
    """With the path of the lowest sigma that a track does not rule out, past the outliers that are found.

    No fix is moved far for a noise that may not be there.  How sure that is stays as it was.
    """
    rows = (~part.lowest.isnan()).nonzero()[:, 0]
    if not len(rows):
        return known
    some = part.at(rows)
    fixes = some.fixes._replace(odds=torch.where(outlier[:, rows] > _SURELY, _DECIDED, -_DECIDED))
    path = two_filters(some._replace(fixes=fixes, sigma=some.lowest).scaled, some.levels, some.model).belief
    position, velocity = (old.index_copy(-1, rows, new) for new, old in zip(path[:2], known.belief[:2], strict=True))
    return known._replace(belief=known.belief._replace(position=position, velocity=velocity))


def _outlier(parts: Sequence[Part], known: Sequence[Smoothed]) -> Tensor:
    """Probabilities ``(T, B)`` that fixes are outliers, in position or height; 0 where there is none."""
    odds, missing = known[0].predictions.prior_outlier.logit() + known[0].evidence, parts[0].fixes.missing
    if len(parts) == 2:
        model, height = parts[1].model, known[1].evidence
        alone = torch.zeros_like(height) + model.alone
        either = torch.logaddexp(odds + _mean(height, model.beside), alone.log() + height)
        odds = torch.where(parts[1].fixes.missing, odds, either - torch.log1p(-alone))
    return torch.where(missing, 0.0, odds.sigmoid())


def _mean(evidence: Tensor, share: Tensor | float) -> Tensor:
    """Log of the mean of a factor, whose log is given, and of 1; the factor has this share."""
    share = torch.zeros_like(evidence) + share
    return torch.logaddexp(evidence + share.log(), torch.log1p(-share))


def _with_chain(part: Part, known: Smoothed, owner: Tensor) -> Part:
    """With the probabilities of an outlier after a clean fix and after an outlier that smoothing has found."""
    there = ~(part.fixes.missing[1:] | part.fixes.missing[:-1])
    begins, lasts = _rates(known.outlier[1:], known.outlier[:-1], there, owner, (DEFAULT.begins, DEFAULT.lasts))
    return part._replace(model=part.model._replace(begins=begins, lasts=lasts))


def _with_evidence(parts: Sequence[Part], known: Sequence[Smoothed], owner: Tensor) -> list[Part]:
    """Parts that know what the other says of outliers, and how often one is where the other is."""
    if len(parts) == 1:
        return list(parts)
    there, found = ~(parts[0].fixes.missing | parts[1].fixes.missing), []
    for part, own, other in zip(parts, known, reversed(known), strict=True):
        alone, beside = _rates(own.outlier, other.outlier, there, owner, (DEFAULT.alone, DEFAULT.beside))
        found.append(part._replace(model=part.model._replace(alone=alone, beside=beside)))
    told = [
        _mean(of.evidence, part.model.beside) - _mean(of.evidence, part.model.alone)
        for of, part in zip(known, found, strict=True)
    ]
    return [
        part._replace(fixes=part.fixes._replace(odds=odds)) for part, odds in zip(found, reversed(told), strict=True)
    ]


def _rates(
    wrong: Tensor, other: Tensor, there: Tensor, owner: Tensor, usual: tuple[Tensor | float, Tensor | float]
) -> tuple[Tensor, Tensor]:
    """How often fixes are outliers where another is clean, and where it is an outlier.

    Args:
        wrong: ``(T, B)`` probabilities of outliers.
        other: ``(T, B)`` those of the others.
        there: ``(T, B)`` which pairs there are.
        owner: ``(B,)`` numbers; rows of the same one have the same rates.
        usual: rates before any was seen.
    """
    seen = there.to(wrong)
    rates = [
        (worth * rate + _summed((of * wrong).sum(0), owner)) / (worth + _summed(of.sum(0), owner))
        for rate, worth, of in zip(usual, _BEFORE, (seen * (1 - other), seen * other), strict=True)
    ]
    return rates[0], rates[1]


def _with_shares(part: Part, known: Smoothed, owner: Tensor) -> Part:
    """With the shares of the levels that smoothing has found."""
    seen = (~part.fixes.missing).to(part.sigma).unsqueeze(1)
    share = _summed((seen * known.levels).sum(0), owner) + _FEW * part.levels.log_share.exp()
    return part._replace(levels=part.levels._replace(log_share=(share / share.sum(0)).log()))


def _summed(values: Tensor, owner: Tensor) -> Tensor:
    """Values ``(..., B)`` summed over all rows of the same owner, for each row."""
    every = values.new_zeros(*values.shape[:-1], int(owner.max()) + 1).index_add(-1, owner, values)
    return every[..., owner]
