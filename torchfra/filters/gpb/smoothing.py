"""Smoothing by GPB: what comes later is a measurement of every hypothesis before."""

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
    carry,
    estimate,
    from_state,
    models_last,
    to_state,
)
from torchfra.filters.gpb.states import GPBPast
from torchfra.filters.interaction import for_each_model
from torchfra.filters.model_smoothing import inside
from torchfra.filters.records import Smoothed
from torchfra.gaussian.future import future
from torchfra.gaussian.inputs import BackwardStep
from torchfra.gaussian.mixture import log_sum, without_failed
from torchfra.gaussian.model import adapted
from torchfra.types import Gaussian

MOTION_BEFORE, AXES = 3, 4
"""One more axis of hypotheses: the motion or the regime of the step before."""


def smoothed(f: Any, past: GPBPast) -> Smoothed:
    """All hypotheses together, and the probabilities of regimes and outliers."""
    belief, log_weight = from_state(past.hypotheses, past.log_weights, (BEFORE, MOTION))
    roots = (0.5 * f.regimes.log_by_motion(log_weight)).exp()
    weights = past.log_weights.exp()
    outlier = weights[..., 1, :].sum(-1, keepdim=True) * past.measured.unsqueeze(-1) * past.outlier
    return Smoothed(estimate(belief, roots, f.motion), weights.sum(-2), outlier)


def retreat(f: Any, step: BackwardStep, after: GPBPast) -> GPBPast:
    """One step back: hypotheses of the step before meet those of the step.

    As in ``filters.model_smoothing``: what comes later is the measurement that makes of a prediction its smoothed
    belief, here for each motion of the step with and without an outlier in it.  Beliefs of the regimes of one motion
    have been merged, so that later measurements say of those what their Markov chain passes on.

    Args:
        f: the filter.
        step: two ``GPBPast``, and the frame between them.
        after: smoothed.
    """
    regimes, difference, frame, measured = f.regimes, f.motion.difference, step.frame, step.next.measured > 0
    nis = step.next.nis.movedim(-1, 0)[None, None, :, None]
    before = from_state(step.past.hypotheses, step.past.log_weights, (BEFORE, MOTION_BEFORE), AXES)
    later = from_state(after.hypotheses, after.log_weights, (OUTLIER, MOTION), AXES)
    prior, prior_of_carried = (_prior(f, x, nis, frame.dt, measured) for x in (step.past, step.carried))

    # What comes later, as the measurement that has made of each prediction what it is known to be now.
    carried = from_state(step.carried.hypotheses, step.carried.log_weights, (BEFORE, MOTION), AXES)
    mixed, _ = f.mix(carried.belief, regimes.moves(carried.log_weight, frame.dt, measured))
    frame = adapted(for_each_model(frame), models_last(mixed).mean)  # as the filter has adapted it
    predicted = regimes.predictions(carry(f.bank, f.motion_rule, mixed, frame), nis, f.motion.position)
    to_step = Hypotheses(predicted, log_sum(prior_of_carried, MOTION_BEFORE).unsqueeze(MOTION_BEFORE))
    news = future(regimes.merged(to_step, f.motion.angles).belief, later.belief, difference)
    news = tree.map_tensors(regimes.of_motions, news)  # (2, R, 1, 1, ...)

    # Every motion before, carried by every regime, meets it.
    every = Gaussian(*(x.expand(x.shape[0], regimes.motions, *x.shape[2:]) for x in before.belief))
    ahead = regimes.carried(carry(f.bank, f.motion_rule, every, frame), nis, f.motion.position)
    each, fit = news.update(ahead, difference)  # (2, R, 2, K, ...)
    joint = prior + regimes.of_motions(without_failed(fit), MOTION_BEFORE)  # (2, R, 2, R, ...)
    total = log_sum(log_sum(joint, MOTION_BEFORE), BEFORE)[:, :, None, None]
    none = total == -torch.inf  # nothing leads there
    joint = without_failed(torch.where(none, -torch.inf, joint - torch.where(none, 0.0, total))) + later.log_weight
    updated = Hypotheses(each, regimes.log_by_motion(joint, MOTION_BEFORE)).merged(OUTLIER, MOTION).belief
    log_weight = log_sum(log_sum(joint, MOTION), OUTLIER)[None, None]
    now = Hypotheses(inside(before.belief, updated), log_weight)
    hypotheses, log_weights = to_state(now, (BEFORE, MOTION_BEFORE), AXES)
    result: GPBPast = step.past._replace(hypotheses=hypotheses, log_weights=log_weights)
    return result


def _prior(f: Any, past: GPBPast, nis: Tensor, dt: Tensor, measured: Tensor) -> Tensor:
    """Logs ``(2, R, 2, R, ...)`` of the probabilities of two steps: outliers and regimes, now and before."""
    log_weight = past.log_weights.movedim((-2, -1), (0, 1))  # (2, R, ...)
    regime = log_weight + f.regimes.transition(log_weight.transpose(0, 1), dt, measured)
    log_mode, _ = f.outliers.ahead(past.outlier, f.outliers.forgotten(past.forgotten, dt), measured)
    pairs: Tensor = log_mode.unsqueeze(MOTION_BEFORE) + f.regimes.rarer(regime.unsqueeze(0), nis)
    return pairs
