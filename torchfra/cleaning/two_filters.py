"""Two-filter smoothing: a filter that runs forward and one that runs backward, combined at every step."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.cleaning.closed_form import (
    DEFAULT,
    Belief,
    Fixes,
    Levels,
    OutlierModel,
    Predictions,
    corrected,
    merged,
    predictions_of,
    steps,
    switched,
)
from torchfra.tree import map_tensors

_BEGUN = 3
"""Fixes after which a filter is sure of where a target is and where it goes."""
_ENOUGH = 8
"""Fixes before and after a jump: fewer are a burst of outliers that a track begins or ends with."""
_RARE = 300.0
"""Seconds without a fix in which a target that is elsewhere has gone there: tracks with such gaps have no jumps."""


class Smoothed(NamedTuple):
    """The smoothed estimates of every step."""

    belief: Belief
    """``(T, B)``; the axes come first."""
    levels: Tensor
    """``(T, J, B)`` probabilities of the levels up to each step."""
    outlier: Tensor
    """``(T, B)`` probability that the fix is an outlier; 0 where there is none."""
    predictions: Predictions
    """Those of the forward filter; where that was lost, those of the backward filter."""
    evidence: Tensor
    """``(T, B)`` log likelihood ratio of outlier and inlier, for this fix."""


def two_filters(fixes: Fixes, levels: Levels, model: OutlierModel = DEFAULT) -> Smoothed:
    """Smoothed estimates: the filter runs forward and, on the same fixes in reverse, backward, in one batch.

    A motion at constant velocity that white noise disturbs is the same in either direction, and so is the chain of
    levels.  So the filter that runs backward gives the likelihood of all later fixes for each level.  Where the two
    contradict each other, one is lost, and the other is believed alone, or each on its side of a jump: see ``_lost``.

    Source: Fraser & Potter (1969) for two filters; Helmick, Blair & Hoffman (1995) for those of interacting models.
    """
    reverse, chain, count = fixes.backwards(), levels.chain, fixes.z.shape[-1]
    doubled = map_tensors(lambda x, y: torch.cat([x, y], -1), (fixes, levels, model), (reverse, levels, model))
    every = predictions_of(steps(*doubled))
    forward = map_tensors(lambda x: x[..., :count], every)
    backward = _in_order_of_time(map_tensors(lambda x: x[..., count:], every))
    # The levels before and after a step change in the shorter of its two gaps: over a long one all become one Gaussian.
    gap = torch.minimum(fixes.elapsed, reverse.elapsed.flip(0))
    belief, log_weights = switched(backward.belief, backward.log_weights, chain, *chain.shares(gap))
    later = Predictions(belief, log_weights, *backward[2:])
    belief, log_fit = _product(forward.belief, later.belief)
    both = Predictions(belief, forward.log_weights + log_weights - levels.log_share + log_fit, *forward[2:])
    after_pause = fixes.after_pause & _begun(reverse).flip(0)
    before_pause = reverse.after_pause.flip(0) & _begun(fixes)
    for pause, over, beside in ((after_pause, forward, backward), (before_pause, backward, forward)):
        if pause.any():
            both = _where(pause, _beside_pause(over, beside), both)
    difference = _difference(*(merged(of.log_weights, of.belief, 1)[0] for of in (forward, later)))
    lost, lost_later = _lost(difference, both.log_weights.logsumexp(1), forward, backward, fixes, model)
    both = _where(lost, later, _where(lost_later, forward, both))
    return updated(both.belief, both.log_weights, fixes, model, _where(lost, later, forward))


def _beside_pause(over: Predictions, beside: Predictions) -> Predictions:
    """The product of both filters for a fix next to a pause, with the levels of the fix's own side.

    The level of a pause explains how far the target went in all of it, and is mostly a low one.  It has no information
    on the level next to the pause: a target that rests for an hour may turn just before and after.

    Args:
        over: predictions from the fixes beyond the pause.
        beside: predictions from the fixes on the other side.
    """
    whole, _ = merged(beside.log_weights, beside.belief, 1)
    _, log_fit = _product(over.belief, _of_any_level(whole))
    common, agree = merged(over.log_weights + log_fit, over.belief, 1)
    belief, log_fit = _product(_of_any_level(common), beside.belief)
    log_weights = (beside.log_weights + log_fit).log_softmax(1) + agree.unsqueeze(1)
    return Predictions(belief, log_weights, *beside[2:])


def _begun(fixes: Fixes) -> Tensor:
    """Whether ``(T, B)`` a filter has had enough fixes for a velocity since it began or since a pause."""
    before = (~fixes.missing).long().cumsum(0) - 1
    return before - torch.where(fixes.after_pause, before, 0).cummax(0).values >= _BEGUN


def _of_any_level(belief: Belief) -> Belief:
    """A belief that is the same for all levels."""
    return Belief(*(x.unsqueeze(-2) for x in belief))


def filtered(fixes: Fixes, levels: Levels, model: OutlierModel = DEFAULT) -> Smoothed:
    """Filtered estimates: each from the fixes up to its step."""
    every = list(steps(fixes, levels, model))
    predictions = predictions_of(every)
    after = [step.filtered for step in every]
    belief = Belief(*(torch.stack(x, -4).flatten(-3, -2) for x in zip(*(of.belief for of in after), strict=True)))
    log_weights = torch.stack([of.log_weights for of in after])  # (T, 2, J, B)
    mixed, _ = merged(log_weights.flatten(1, 2), belief, 1)
    odds = log_weights.logsumexp(2).diff(dim=1).squeeze(1) - predictions.prior_outlier.logit()
    outlier, evidence = (torch.where(fixes.missing, 0.0, x) for x in (predictions.outlier, odds))
    return Smoothed(mixed, log_weights.exp().sum(1), outlier, predictions, evidence - fixes.log_odds)


def updated(
    belief: Belief, log_weights: Tensor, fixes: Fixes, model: OutlierModel, predictions: Predictions
) -> Smoothed:
    """Every step, updated by its own fix.

    Args:
        belief: ``(T, J, B)`` from all other fixes; the axes come first.
        log_weights: ``(T, J, B)`` of the levels.
        fixes: of these steps.
        model: how likely outliers are.
        predictions: those of the filter.
    """
    missing = fixes.missing.unsqueeze(1)
    z = fixes.z.movedim(1, 0).unsqueeze(2)
    inlier, log_density = corrected(belief, z, fixes.variance.unsqueeze(1), missing, model)
    share = torch.stack([1 - predictions.prior_outlier, predictions.prior_outlier]).log().unsqueeze(2)
    fit = (log_weights + log_density).logsumexp(2)
    share[1] = share[1] + fixes.log_odds.unsqueeze(1)
    joint = (log_weights + log_density + share).movedim(0, 1)  # (T, 2, J, B)
    joint = joint - joint.flatten(1, 2).logsumexp(1)[:, None, None]
    both = Belief(*(torch.stack(x, -3) for x in zip(inlier, belief, strict=True)))
    mixed, _ = merged(joint.flatten(1, 2), Belief(*(x.flatten(-3, -2) for x in both)), 1)
    outlier = torch.where(fixes.missing, 0.0, joint[:, 1].exp().sum(1))
    return Smoothed(mixed, joint.exp().sum(1), outlier, predictions, fit[1] - fit[0])


def _lost(
    difference: Belief, agree: Tensor, forward: Predictions, backward: Predictions, fixes: Fixes, model: OutlierModel
) -> tuple[Tensor, Tensor]:
    """Where one of two filters follows something else than the target, as the burst of outliers that it began with.

    There their predictions differ as an outlier differs from an inlier, whichever the level; or, next to that, one
    takes the fix for an outlier and the other does not.  Of each such stretch that filter is lost by which the fixes
    are less likely.  Where the target itself jumps or turns back at once, the first filter is right
    until then and the second from then on.  So the first is believed up to the step that makes the fixes likeliest and
    the second after it, if that beats either alone by more than it is rare.  Both sides have three steps of the
    stretch, or one has two if there are five, or else the last outlier of a burst would be a jump.  A jump shows too
    where what the filters say is not far apart: see ``_jumps``.

    A filter that begins is sure of nothing, so that it contradicts the other as it does thereafter; and two that agree
    for a fix or two between stretches do so by chance.  To be lost, or to change, is as rare as two outliers apart.

    Args:
        difference: ``(T, B)`` prediction of the second minus that of the first.
        agree: ``(T, B)`` log of the density of both predictions for one state.
        forward: predictions of the first.
        backward: predictions of the second.
        fixes: all of them.
        model: how likely outliers are, and how large.

    Returns:
        ``(T, B)`` where the first is lost, and where the second is.
    """
    ep, ev, pp, _, vv = difference
    squares = [x.square().mean(0) for x in (ep, ev)]
    wide = [(model.least_size * v).maximum(square) for v, square in zip((pp, vv), squares, strict=True)]
    rare = 2 * (torch.zeros_like(pp[0]) + model.after_inlier).log()
    log_lost = rare - 0.5 * len(ep) * sum(x / v + v.log() for x, v in zip(squares, wide, strict=True))
    measured = (~fixes.missing).long()
    before = measured.cumsum(0) - measured
    fewer = before.minimum(measured.sum(0) - measured - before)
    sure, enough = fewer >= _BEGUN, fewer >= _ENOUGH
    first, last = sure.long().argmax(0), len(sure) - 1 - sure.flip(0).long().argmax(0)
    nearest = torch.arange(len(sure)).unsqueeze(1).clamp(first, last)
    contradict = _joined(((agree < log_lost) & sure).gather(0, nearest), measured)
    either = contradict | ((forward.outlier > 0.5) != (backward.outlier > 0.5))
    lost = either & (_largest(contradict.long(), _numbers(either)) > 0)
    gain = forward.log_likelihood - backward.log_likelihood
    believed = _believed(gain, lost, rare.where(enough, -torch.inf))
    until, since = _jumps(gain, lost, enough & (fixes.elapsed <= _RARE).all(0), rare)
    return (lost & ~believed) | since, (lost & believed) | until


def _jumps(gain: Tensor, lost: Tensor, may: Tensor, rare: Tensor) -> tuple[Tensor, Tensor]:
    """Where a target jumps or turns back at once, with the steps at which the filter from the other side is still lost.

    All fixes are as likely by the first filter as by the second.  If the first is believed before a step and the second
    from that step on, they are likelier by minus the sum of ``gain`` from there on.  A jump is where this is the
    largest of all steps around it where it is positive, and larger than a jump is rare.

    Args:
        gain: ``(T, B)``, the log of how much likelier each fix is by the first than by the second.
        lost: ``(T, B)``, what is decided already.
        may: ``(T, B)``, where there may be jumps.
        rare: ``(B,)``, the log of how probable a jump is.

    Returns:
        ``(T, B)`` the steps before jumps, where the second is lost, and those from them on, where the first is.
    """
    likelier = -gain.flip(0).cumsum(0).flip(0)
    around = likelier > 0
    number, step = _numbers(around), torch.arange(len(gain)).unsqueeze(1)
    most = _largest(likelier.where(around & may, -torch.inf), number)
    decided = _largest((around & lost).long(), number) > 0
    jumps = (likelier == most) & (most > -rare) & ~decided
    at = _largest(torch.where(jumps, step, -1), number)
    near = around & (at >= 0)
    return near & (step < at), near & (step >= at)


def _numbers(inside: Tensor) -> Tensor:
    """Numbers of stretches ``(T, B)``: steps inside one have its number, steps outside that of the last before them."""
    return (inside & ~torch.cat([torch.zeros_like(inside[:1]), inside[:-1]])).long().cumsum(0)


def _largest(x: Tensor, number: Tensor) -> Tensor:
    """The largest value ``(T, B)`` of all steps of the same number."""
    most = x.new_empty(len(x) + 1, *x.shape[1:])  # numbers of one step are 0 or 1
    return most.scatter_reduce(0, number, x, "amax", include_self=False).gather(0, number)


def _joined(inside: Tensor, measured: Tensor) -> Tensor:
    """Joins stretches ``(T, B)`` with fewer fixes between them than make a filter sure; ``measured`` is 1 at fixes."""
    count = measured.cumsum(0)
    since = torch.where(inside, count, -_BEGUN).cummax(0).values
    until = torch.where(inside, count - measured, len(measured) + _BEGUN).flip(0).cummin(0).values.flip(0)
    return until - since < _BEGUN


def _believed(gain: Tensor, lost: Tensor, rare: Tensor) -> Tensor:
    """Where the first of two filters is believed: in each stretch everywhere, nowhere, or up to the likeliest step.

    Args:
        gain: ``(T, B)``, the log of how much likelier each fix is by the first than by the second.
        lost: ``(T, B)``, the stretches.
        rare: ``(B,)`` or ``(T, B)``, the log of how probable a change from the first to the second is in a stretch.

    Returns:
        ``(T, B)``; outside the stretches it has no meaning.
    """
    step, none = torch.arange(len(lost)).unsqueeze(1), torch.zeros_like(lost[:1])
    begins, ends = lost & ~torch.cat([none, lost[:-1]]), lost & ~torch.cat([lost[1:], none])
    stretch = begins.long().cumsum(0)
    gain = gain * lost
    total = gain.cumsum(0)
    base = torch.zeros_like(total).scatter_add(0, stretch, (total - gain) * begins).gather(0, stretch)
    some, count = none.expand(_BEGUN, -1), len(lost)
    around = torch.cat([some, lost, some, none])
    b3, b2, b1, _, _, a2, a3, a4 = (around[i : i + count] for i in range(8))
    short = (b2 & ~b3 & a2 & ~a3) | (b1 & ~b2 & a3 & ~a4)  # a stretch of five steps has three on one side
    inside = lost & ((b2 & a3) | short)
    prior = torch.where(ends, 0.0, torch.where(inside, rare, -torch.inf))
    likelier = total - base + prior  # than by the second alone
    most = _largest(likelier, stretch)
    return step <= _largest(torch.where((likelier == most) & (most >= 0), step, -1), stretch)


def _in_order_of_time(x: Predictions) -> Predictions:
    """Predictions of a filter that ran backward, in the order of time."""
    (position, velocity, pp, pv, vv), *rest = map_tensors(lambda x: x.flip(-3 if x.dim() > 2 else 0), x)
    return Predictions(Belief(position, -velocity, pp, -pv, vv), *rest)


def _where(chosen: Tensor, one: Predictions, other: Predictions) -> Predictions:
    """Those of one filter at some steps ``(T, B)``, and of the other elsewhere."""
    level = chosen.unsqueeze(1)
    return map_tensors(lambda x, y: torch.where(chosen if x.dim() == 2 else level, x, y), one, other)


def _difference(a: Belief, b: Belief) -> Belief:
    """The difference of two beliefs from different data."""
    return Belief(b.position - a.position, b.velocity - a.velocity, a.pp + b.pp, a.pv + b.pv, a.vv + b.vv)


def _product(a: Belief, b: Belief) -> tuple[Belief, Tensor]:
    """The product of two beliefs of one state from different data, and the log of its integral, but for a constant."""
    ep, ev, pp, pv, vv = _difference(a, b)
    det, d = pp * vv - pv.square(), len(ep)
    nis = (vv * ep.square() - 2 * pv * ep * ev + pp * ev.square()).sum(0) / det
    gpp, gpv = (a.pp * vv - a.pv * pv) / det, (a.pv * pp - a.pp * pv) / det
    gvp, gvv = (a.pv * vv - a.vv * pv) / det, (a.vv * pp - a.pv * pv) / det
    joint = Belief(
        a.position + gpp * ep + gpv * ev, a.velocity + gvp * ep + gvv * ev,
        gpp * b.pp + gpv * b.pv, gpp * b.pv + gpv * b.vv, gvp * b.pv + gvv * b.vv,
    )  # fmt: skip
    return joint, -0.5 * (nis + d * det.log())
