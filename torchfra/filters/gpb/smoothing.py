"""Smoothing by GPB: all later measurements together act as one measurement of every hypothesis before."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchfra import tree
from torchfra.filters.gpb.hypotheses import (
    BEFORE,
    MOTION,
    OUTLIER,
    Hypotheses,
    estimate,
    for_bank,
    from_state,
    propagate_motions,
    to_state,
)
from torchfra.filters.gpb.outliers import Outliers
from torchfra.filters.gpb.regimes import Regimes, Surprise
from torchfra.filters.gpb.states import GPBPast
from torchfra.filters.model_smoothing import unwhitened
from torchfra.gaussian.future import future
from torchfra.gaussian.inputs import BackwardStep
from torchfra.gaussian.mixture import log_sum, without_failed
from torchfra.gaussian.model import Propagated, adapted
from torchfra.steps.records import Smoothed
from torchfra.types import Gaussian

MOTION_BEFORE, AXES = 3, 4
"""One more axis of hypotheses, the motion or the regime of the step before, and how many axes there are with it."""


def smoothed(f: Any, past: GPBPast) -> Smoothed:
    """The estimate of all hypotheses, and the probabilities of regimes and outliers."""
    belief, log_weight = from_state(past.hypotheses, past.log_weights, (BEFORE, MOTION))
    roots = (0.5 * f.regimes.log_by_belief(log_weight)).exp()
    weights = past.log_weights.exp()
    outlier = weights[..., 1, :].sum(-1, keepdim=True) * past.measured.unsqueeze(-1) * past.outlier
    return Smoothed(estimate(belief, roots, f.motion), weights.sum(-2), outlier)


def retreat(f: Any, step: BackwardStep, after: GPBPast) -> GPBPast:
    """One step of the backward pass, over all pairs of a hypothesis before the step and one after it.

    As in ``filters.model_smoothing``, all later measurements together act as the measurement that turns a prediction
    into its smoothed belief, here for each belief after the step, with and without an outlier.  Several regimes have
    been merged into one belief, so later measurements reach those regimes through their Markov chain alone.

    Args:
        f: the filter.
        step: two ``GPBPast``, and the frame between them.
        after: the smoothed ``GPBPast`` after the step.
    """
    regimes, difference, frame, measured = f.regimes, f.motion.difference, step.frame, step.next.measured > 0
    surprise = Surprise(*(x.movedim(-1, 0)[None, None, :, None] for x in step.next.surprise))
    before = from_state(step.past.hypotheses, step.past.log_weights, (BEFORE, MOTION_BEFORE), AXES)
    later = from_state(after.hypotheses, after.log_weights, (OUTLIER, MOTION), AXES)
    seconds, since = regimes.counted(step.past.unmeasured, frame.dt), step.past.unmeasured + frame.dt
    prior = _prior(regimes, f.outliers, step.past, step.next, surprise, frame.dt, seconds)

    # All later measurements, as the one measurement that turns each prediction into its smoothed belief.
    source = from_state(step.source.hypotheses, step.source.log_weights, (BEFORE, MOTION), AXES)
    mixed, _ = f.mix(source.belief, regimes.switch(source.log_weight, seconds, measured))
    # Shift and process noise are those of the forward pass.
    frame = adapted(frame, for_bank(mixed, len(f.bank)).mean)
    rows = f.outlying_rows(step.next.widening).unsqueeze(MOTION_BEFORE)

    def predicted(belief: Gaussian) -> Propagated:
        propagated = propagate_motions(f.bank, f.motion_rule, belief, frame)
        parts: Propagated = regimes.predicted_parts(propagated, surprise.nis, f.motion, since)
        return parts._replace(spread=rows * parts.spread, process_noise=rows * parts.process_noise)

    posterior = step.next.posterior.movedim((-3, -2, -1), (0, 1, 2)).unsqueeze(MOTION_BEFORE)
    # Merged as after the step: what led to a jump and what did not predict different places.
    measurement = future(regimes.merged_parts(predicted(mixed), posterior, f.motion.angles), later.belief, difference)
    measurement = tree.map_tensors(regimes.per_merged, measurement)  # (2, R, 1, 1, ...)

    # The belief of every motion before, propagated by every regime, is updated by it.
    every = Gaussian(*(x.expand(x.shape[0], regimes.beliefs, *x.shape[2:]) for x in before.belief))
    each, fit = measurement.update(predicted(every), difference)  # (2, R, 2, K, ...)
    joint = prior + regimes.per_merged(without_failed(fit), MOTION_BEFORE)  # (2, R, 2, R, ...)
    total = log_sum(log_sum(joint, MOTION_BEFORE), BEFORE)[:, :, None, None]
    none = total == -torch.inf  # no hypothesis before leads to this one
    joint = without_failed(torch.where(none, -torch.inf, joint - torch.where(none, 0.0, total))) + later.log_weight
    updated = Hypotheses(each, regimes.log_by_belief(joint, MOTION_BEFORE)).merged(OUTLIER, MOTION).belief
    log_weight = log_sum(log_sum(joint, MOTION), OUTLIER)[None, None]
    now = Hypotheses(unwhitened(before.belief, updated), log_weight)
    hypotheses, log_weights = to_state(now, (BEFORE, MOTION_BEFORE), AXES)
    result: GPBPast = step.past._replace(hypotheses=hypotheses, log_weights=log_weights)
    return result


def _prior(
    regimes: Regimes, outliers: Outliers, past: GPBPast, after: GPBPast, surprise: Surprise, dt: Tensor, seconds: Tensor
) -> Tensor:
    """Logs ``(2, R, 2, R, ...)`` of the joint probabilities of outliers and regimes, now and in the step before.

    No belief holds the offset that outliers may have in both steps, so its likelihood ratio is a factor here.
    """
    measured = after.measured > 0
    log_weight = past.log_weights.movedim((-2, -1), (0, 1))  # (2, R, ...)
    regime = log_weight + regimes.transition(log_weight.transpose(0, 1), seconds, measured)
    unreliable = outliers.unreliable_next(past.outlier, past.unreliable)
    log_mode, _ = outliers.predict(past.outlier, unreliable, outliers.relaxation(past.relaxation, dt), measured)
    if after.log_same_offset is not None:
        same_offset = after.log_same_offset.movedim(-1, 0)
        none = torch.zeros_like(same_offset)
        log_mode = log_mode + torch.stack([torch.stack([none, none], 1), torch.stack([none, same_offset], 1)])
    rarity, given = after.rarity.movedim((-2, -1), (0, 1)).unsqueeze(1), surprise.given.squeeze(MOTION_BEFORE)
    log_mode = log_mode + regimes.given_back(rarity, given)
    pairs: Tensor = log_mode.unsqueeze(MOTION_BEFORE) + regimes.penalised(regime.unsqueeze(0), surprise)
    return pairs
