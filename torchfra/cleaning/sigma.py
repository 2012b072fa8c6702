"""The standard deviation of fixes, by the likelihood of their tracks."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchfra.cleaning.circles import IN_A_ROW, off_circles, off_lines
from torchfra.cleaning.closed_form import Fixes, Levels, steps
from torchfra.cleaning.parts import SHORT, Part, summed
from torchfra.cleaning.process_noise import LONGEST, with_levels_of_walks
from torchfra.cleaning.two_filters import Smoothed
from torchfra.numbers import as_tensor
from torchfra.tree import map_tensors

_LEAST_SIGMA = 1e-4
"""Least standard deviation that is tried, m: fixes that repeat have none."""
_COARSE = 8
"""Number of standard deviations that are tried at first, each half of the one before."""
_FINE = 1.2
"""Ratio of those that are tried later."""
_PRIOR_EXPONENT = 8.0
"""Exponent of the prior of sigma: with 0 it is found a fifth too small for flights every 10 s."""
_HARDLY = 0.6
"""Share of the standard deviation of its fix above which an estimate is hardly more certain."""
_PAUSES = 0.05
"""Share of the fixes that come after a pause from which on a track counts as one of rare fixes."""
_HALVINGS = 0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 9.0, 14.0
"""Numbers of halvings of sigma for the lower ones that are tried."""
_OPEN = 3.0
"""Log-likelihood by which a track may be less likely with a lower sigma that it does not rule out."""
_MISFIT_OF_WALKS, _MISFIT_OF_STOPS = 0.2, 0.17
"""The same for each of its fixes: where levels of a random walk, of a few sizes only, are certain; and where there are
no such levels though targets may stop between fixes."""
_MISFIT, _FORGOTTEN = 0.28, 7200.0
"""The same for each fix where the time between fixes exceeds the duration of any level; and the correlation time of the
velocity, s."""
_CHANGED = 18000.0
"""Seconds between fixes from which on a track with levels of a random walk hardly determines these."""
_HOME = 43200.0
"""Seconds between fixes from which on targets may have returned: then motion is as white as noise."""
_STEPS, _ROWS = 200, 2
"""Steps of a row, and rows of a track, from which sigma is estimated."""
_OVER_CIRCLES, _OVER_LINES, _STRETCHES = 1.3, 4.0, 20
"""Largest ratios of sigma to the residuals of circles and of lines, and the fewest stretches of fixes for these."""
_STRAIGHT = 0.2
"""Share of the stretches along a street that has no corner there, whatever the time between fixes: the straightest."""


def first_sigma(part: Part, owner: Tensor) -> Tensor:
    """Standard deviations ``(B,)`` of the largest likelihood on a coarse grid below what third differences allow."""
    halves = 2.0 ** torch.arange(_COARSE).unsqueeze(1)
    return _of_largest_likelihood(part, owner, _largest_sigma(part.fixes, owner) / halves)


def finer_sigma(part: Part, owner: Tensor) -> Tensor:
    """Standard deviations ``(B,)`` of the largest likelihood near those of the part."""
    factors = _FINE ** torch.arange(2, -3, -1, dtype=part.sigma.dtype).unsqueeze(1)
    return _of_largest_likelihood(part, owner, factors * part.sigma)


def _of_largest_likelihood(part: Part, owner: Tensor, tried: Tensor) -> Tensor:
    """Of standard deviations ``tried (G, B)``, those ``(B,)`` of the largest likelihood.

    The prior of sigma decides where noise and motion cannot be distinguished: for noise.
    """
    log_likelihood, _ = _likelihoods(part, part.levels, owner, tried)
    return _likeliest(tried, log_likelihood + _PRIOR_EXPONENT * tried.log()).minimum(part.most)


def _likeliest(sigma: Tensor, log_likelihood: Tensor) -> Tensor:
    """Of standard deviations ``(G, B)`` that decrease by a factor, those ``(B,)`` of the largest likelihood ``(G, B)``.

    They are interpolated by the parabola through the largest and its neighbours.
    """
    best = log_likelihood.argmax(0).clamp(1, len(sigma) - 2)
    left, middle, right = (log_likelihood.gather(0, (best + k).unsqueeze(0))[0] for k in (-1, 0, 1))
    bend = (left - 2 * middle + right).clamp_max(-1e-3)  # where likelihoods are level, a parabola has no top
    place = best + (0.5 * (left - right) / bend).clamp(-1.0, 1.0)
    likely: Tensor = (sigma[0] * (sigma[1] / sigma[0]) ** place).clamp_min(_LEAST_SIGMA)
    return likely


def little_gained(part: Part, known: Smoothed, owner: Tensor) -> Tensor:
    """Whether most estimates of a track ``(B,)`` are hardly more certain than their own fixes, or its fixes are rare.

    Fixes in bursts are rare too.
    """
    measured = ~part.fixes.missing
    hardly = measured & (known.belief.pp > _HARDLY**2 * part.scaled.variance)
    several, pauses, every = (
        summed(of.sum(0).to(part.sigma), owner) for of in (hardly, part.fixes.after_pause, measured)
    )
    return (several > 0.5 * every) | (pauses > _PAUSES * every) | (part.fixes.period > LONGEST)


def lowest_sigma(part: Part, owner: Tensor) -> Tensor:
    """The lowest standard deviations ``(B,)`` that tracks do not rule out.

    Where noise and motion can hardly be distinguished, too large a sigma costs far more than too small a one: with the
    former the path cuts corners, with the latter it goes through the fixes.  A kind that may keep a slow course between
    rare fixes may also keep none: its likelihood is computed with levels of a random walk too.

    Args:
        part: with the prior levels.
        owner: ``(B,)`` numbers; rows of the same one have one standard deviation.
    """
    tried = part.sigma / 2.0 ** as_tensor(_HALVINGS, part.sigma).unsqueeze(1)
    several, asked = [part.levels], [torch.ones_like(part.fixes.period, dtype=torch.bool)]
    slow = (part.fixes.period > LONGEST) & (part.levels.walk == 0).all(0)
    if slow.any():
        several.append(with_levels_of_walks(part.levels, as_tensor(part.model.least_offset), part.fixes.period))
        asked.append(slow)
    fits, least = [], []
    for levels, rows in zip(several, asked, strict=True):
        log_likelihood, count = _likelihoods(part, levels, owner, tried)
        fits.append(log_likelihood.where(rows, -torch.inf))  # what is tried of some tracks changes no others
        least.append(-_OPEN - _misfit(levels, part) * count)
    fit = torch.stack(fits)
    open_ = (fit >= fit.amax((0, 1)) + torch.stack(least)).any(0)
    last = (open_ * torch.arange(len(tried)).unsqueeze(1)).amax(0)
    return tried.gather(0, last.unsqueeze(0))[0].maximum(part.least)


def _misfit(levels: Levels, part: Part) -> Tensor:
    """Log-likelihood ``(B,)`` by which each fix may be less likely with a lower sigma that is not ruled out."""
    walks, period = (levels.log_share.exp() * (levels.walk > 0)).sum(0), part.fixes.period
    often = torch.where(walks > 0, _MISFIT_OF_WALKS * walks, _MISFIT_OF_STOPS * part.stops)
    forgotten = torch.where(walks > 0, (period / _CHANGED) ** 4, period / _FORGOTTEN)
    misfit = torch.where(period > LONGEST, -_MISFIT * torch.expm1(-forgotten), often)
    return torch.where(period >= _HOME, torch.inf, misfit)


def _likelihoods(part: Part, levels: Levels, owner: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor]:
    """Log-likelihoods and numbers of fixes ``(G, B)`` for standard deviations ``(G, B)``."""
    count, chosen = len(sigma), _rows_for_sigma(part.fixes, owner)

    def repeated(x: Tensor) -> Tensor:
        """Values ``(..., B)`` for each of the standard deviations, ``(..., G B)``."""
        return x[..., chosen].unsqueeze(-2).expand(*x.shape[:-1], count, len(chosen)).flatten(-2)

    first = map_tensors(lambda x: x[:_STEPS], part.fixes)
    tried, levels, model = map_tensors(repeated, (first, levels, part.model.independent_offsets))
    tried = tried._replace(variance=tried.variance * sigma[:, chosen].flatten().square())
    every = steps(tried, levels, model)
    log_likelihood = torch.stack([step.log_likelihood for step in every])  # 0 where there is no fix
    sums = torch.stack([log_likelihood, (~tried.missing).to(sigma)]).sum(1).unflatten(-1, (count, -1))
    by_owner = sums.new_zeros(2, count, int(owner.max()) + 1).index_add(-1, owner[chosen], sums)
    fit, number = by_owner[..., owner]
    return fit, number


def _rows_for_sigma(fixes: Fixes, owner: Tensor) -> Tensor:
    """Rows from which sigma is estimated: those of each track with the most fixes, and those of all short tracks."""
    count = (~fixes.missing[:_STEPS]).sum(0)
    chosen = []
    for i in owner.unique():
        rows = (owner == i).nonzero()[:, 0]
        most = len(rows) if i == SHORT else _ROWS
        chosen.append(rows[count[rows].argsort(descending=True, stable=True)[:most]])
    return torch.cat(chosen)


def _largest_sigma(fixes: Fixes, owner: Tensor) -> Tensor:
    """Twice the standard deviation ``(B,)`` of fixes whose third differences are nothing but noise.

    It is in units of the usual standard deviation that the file states, if it states one.
    """
    third = _third_differences(_in_usual(fixes), fixes.gap).square().mean(1).sqrt()
    most = 2 * _quantile(third, owner).nan_to_num(0.5)
    return most.clamp_min(_LEAST_SIGMA * 2.0**_COARSE / 4)


def most_by_shapes(part: Part, owner: Tensor) -> Tensor:
    """The largest sigma ``(B,)`` of tracks that circle, or go along lines; infinite where fixes are rare.

    A target that circles with a few fixes per turn looks like noise about a straight line to levels of process noise,
    which model no turns; so does one that stops and goes, but noise is the same along its course and across.
    """
    fixes = part.fixes
    most = torch.full_like(fixes.gap[0], math.inf)
    if fixes.z.shape[1] != 2 or len(fixes.z) < IN_A_ROW:
        return most
    rows = _rows_for_sigma(fixes, owner)
    some = Fixes(*(x[:_STEPS, ..., rows] for x in fixes))
    often, alike = some.period <= LONGEST, (some.variance == 1).all(0)
    several = [
        (off_circles(_in_usual(some), some.gap), often, 0.5, _OVER_CIRCLES),
        (off_lines(_in_usual(some)), often & part.stops[rows] & alike, _STRAIGHT, _OVER_LINES),
    ]
    for off, asked, share, ratio in several:
        off = off.where(asked, math.nan)
        enough = summed((~off.isnan()).sum(0), owner[rows]) >= _STRETCHES
        for i, usual in zip(owner[rows][enough], _quantile(off, owner[rows], share)[enough], strict=True):
            most[owner == i] = most[owner == i].clamp_max(ratio * usual)
    return most


def _in_usual(fixes: Fixes) -> Tensor:
    """Fixes ``(T, d, B)`` in units of the usual standard deviation that the file states, if it states one."""
    return fixes.z / torch.where(fixes.missing, math.nan, fixes.variance).nanmedian(0).values.sqrt()


def _quantile(values: Tensor, owner: Tensor, share: float = 0.5) -> Tensor:
    """The quantile ``(B,)`` of values ``(T, B)`` over all rows of the same ``owner (B,)``; NaN where there are none."""
    quantiles = values.new_full(owner.shape, math.nan)
    for i in owner.unique() if len(values) else []:
        quantiles[owner == i] = values[:, owner == i].flatten().nanquantile(share, interpolation="lower")
    return quantiles


def _third_differences(z: Tensor, gap: Tensor) -> Tensor:
    """Third differences ``(T - 3, d, B)`` of fixes, scaled to the noise of one: 0 for a parabola in time."""
    time, count = gap.cumsum(0), max(len(z) - 3, 0)
    four = torch.stack([time[k : k + count] for k in range(4)])
    apart = four.unsqueeze(0) - four.unsqueeze(1)
    weight = 1 / (apart + torch.eye(4, dtype=z.dtype)[..., None, None]).prod(0)
    weight = weight / weight.square().sum(0).sqrt()
    return torch.stack([z[k : k + count] * weight[k].unsqueeze(1) for k in range(4)]).sum(0)
