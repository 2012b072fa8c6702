"""Two-filter smoothing: a filter that runs forward and one that runs backward, combined at every step."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.cleaning.ladder import (
    DEFAULT,
    Belief,
    Fixes,
    Levels,
    OutlierModel,
    Predictions,
    corrected,
    filter_forward,
    merged,
    steps,
    switched,
)


class Smoothed(NamedTuple):
    """What all fixes say of every step."""

    belief: Belief
    """``(T, B)`` behind the axes."""
    levels: Tensor
    """``(T, J, B)`` probabilities of the levels of the steps that led there."""
    outlier: Tensor
    """``(T, B)`` probability that the fix is one; 0 where there is none."""
    predictions: Predictions
    """What the filter said."""
    evidence: Tensor
    """``(T, B)`` log of how much likelier this fix is as an outlier."""


def two_filters(fixes: Fixes, levels: Levels, model: OutlierModel = DEFAULT) -> Smoothed:
    """Smoothed estimates: the filter runs forward and, on the same fixes in reverse, backward, in one batch.

    A motion at constant velocity that white noise disturbs is the same in either direction, and so is the chain of
    levels.  So the filter that runs backward gives the likelihood of all later fixes for each level.

    Source: Fraser & Potter (1969) for two filters; Helmick, Blair & Hoffman (1995) for those of interacting models.
    """
    doubled = Levels(*(torch.cat([x, x], -1) for x in levels))
    every = filter_forward(
        Fixes(*(torch.cat(x, -1) for x in zip(fixes, fixes.backwards(), strict=True))),
        doubled,
        model.of_rows(lambda x: torch.cat([x, x])),
    )
    count = fixes.z.shape[-1]
    predictions = Predictions(Belief(*(x[..., :count] for x in every.belief)), *(x[..., :count] for x in every[1:]))
    later = Belief(*(x[..., count:].flip(-3) for x in every.belief))
    later = later._replace(velocity=-later.velocity, pv=-later.pv)
    log_later = every.log_weights[..., count:].flip(0)
    later, log_later = switched(later, log_later, levels.chain, fixes.elapsed)
    belief, log_fit = _product(predictions.belief, later)
    log_weights = predictions.log_weights + log_later - levels.log_share + log_fit
    return updated(belief, log_weights, fixes, model, predictions)


def filtered(fixes: Fixes, levels: Levels, model: OutlierModel = DEFAULT) -> Smoothed:
    """What the fixes up to each step say of it."""
    every = list(steps(fixes, levels, model))
    predictions = Predictions(
        Belief(*(torch.stack(x, -3) for x in zip(*(step.prediction for step in every), strict=True))),
        *(torch.stack(x) for x in zip(*(step[1:5] for step in every), strict=True)),
    )
    known = Belief(*(torch.stack(x, -4).flatten(-3, -2) for x in zip(*(step.known for step in every), strict=True)))
    log_weights = torch.stack([step.log_weights for step in every])  # (T, 2, J, B)
    whole, _ = merged(log_weights.flatten(1, 2), known, 1)
    odds = log_weights.logsumexp(2).diff(dim=1).squeeze(1) - predictions.prior_outlier.logit()
    outlier, evidence = (torch.where(fixes.missing, 0.0, x) for x in (predictions.outlier, odds))
    return Smoothed(whole, log_weights.exp().sum(1), outlier, predictions, evidence - fixes.odds)


def updated(
    belief: Belief, log_weights: Tensor, fixes: Fixes, model: OutlierModel, predictions: Predictions
) -> Smoothed:
    """Every step, updated by its own fix.

    Args:
        belief: ``(T, J, B)`` behind the axes, without that fix.
        log_weights: ``(T, J, B)`` of the levels.
        fixes: all of them.
        model: how likely outliers are.
        predictions: what the filter said.
    """
    missing = fixes.missing.unsqueeze(1)
    z = fixes.z.movedim(1, 0).unsqueeze(2)
    clean, log_density = corrected(belief, z, fixes.variance.unsqueeze(1), missing, model)
    share = torch.stack([1 - predictions.prior_outlier, predictions.prior_outlier]).log().unsqueeze(2)
    fit = (log_weights + log_density).logsumexp(2)
    share[1] = share[1] + fixes.odds.unsqueeze(1)
    joint = (log_weights + log_density + share).movedim(0, 1)  # (T, 2, J, B)
    joint = joint - joint.flatten(1, 2).logsumexp(1)[:, None, None]
    both = Belief(*(torch.stack(x, -3) for x in zip(clean, belief, strict=True)))
    whole, _ = merged(joint.flatten(1, 2), Belief(*(x.flatten(-3, -2) for x in both)), 1)
    outlier = torch.where(fixes.missing, 0.0, joint[:, 1].exp().sum(1))
    return Smoothed(whole, joint.exp().sum(1), outlier, predictions, fit[1] - fit[0])


def _product(a: Belief, b: Belief) -> tuple[Belief, Tensor]:
    """Two beliefs of the same state from different data as one, and the log of how well they agree."""
    pp, pv, vv = a.pp + b.pp, a.pv + b.pv, a.vv + b.vv
    det = pp * vv - pv.square()
    ep, ev, d = b.position - a.position, b.velocity - a.velocity, len(a.position)
    far = (vv * ep.square() - 2 * pv * ep * ev + pp * ev.square()).sum(0) / det
    gpp, gpv = (a.pp * vv - a.pv * pv) / det, (a.pv * pp - a.pp * pv) / det
    gvp, gvv = (a.pv * vv - a.vv * pv) / det, (a.vv * pp - a.pv * pv) / det
    joint = Belief(
        a.position + gpp * ep + gpv * ev, a.velocity + gvp * ep + gvv * ev,
        gpp * b.pp + gpv * b.pv, gpp * b.pv + gpv * b.vv, gvp * b.pv + gvv * b.vv,
    )  # fmt: skip
    return joint, -0.5 * (far + d * det.log())
