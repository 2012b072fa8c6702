"""The way back of GPB: what comes later as a measurement of every hypothesis before."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfra import tree
from torchfra.filters.gpb.merging import together
from torchfra.filters.gpb.regimes import Regimes, in_front
from torchfra.filters.hindsight import inside
from torchfra.filters.imm import for_each_model
from torchfra.filters.smoothing import Told, Turn
from torchfra.filters.tracks import GaussianFilter
from torchfra.gaussian.future import Future, future
from torchfra.gaussian.mixture import moment_match, repeated, without_failed
from torchfra.gaussian.model import Carried
from torchfra.linalg.triangular import hstack, tria
from torchfra.types import Gaussian


class GPBPast(NamedTuple):
    """What the way back needs of a step; ``(..., T, ...)`` of a whole track."""

    clean: Gaussian
    """``(..., K)`` for each motion, if no block was an outlier."""
    dirty: Gaussian
    """``(..., K)`` for each motion, if one was."""
    log_weights: Tensor
    """``(..., 2, R)`` logs of the probabilities of clean and dirty, and of the regimes."""
    outlier: Tensor
    """``(..., B)`` of each block that it was an outlier, if the step was dirty."""
    far: Tensor
    """``(..., 2)`` how far the measurement was from what the clean and the dirty belief before predicted: of jumps."""

    def beliefs(self) -> Gaussian:
        """``(2, ..., K)``."""
        both: Gaussian = tree.stack([self.clean, self.dirty], 0)
        return both

    def told(self, regimes: Regimes) -> Told:
        """All hypotheses together, and the probabilities of regimes and outliers."""
        log_weights = self.log_weights.movedim(-2, 0)
        weights = log_weights.exp()
        outlier = weights[1].sum(-1, keepdim=True) * self.outlier
        return Told(together(self.beliefs(), regimes.of_motion(log_weights)), weights.sum(0), outlier)


class WayBack(GaussianFilter):
    """The part of ``GPB`` that smooths."""

    keeps_past, kernels_back = True, False
    regimes: Regimes

    def past(self, belief: Gaussian, info: Any, state: Any, steps: GPBPast) -> GPBPast:  # type: ignore[override]
        """What is known of all hypotheses after each step."""
        return steps

    def fresh(self, past: GPBPast) -> GPBPast:  # type: ignore[override]
        """The same: nothing is decided later."""
        return past

    decided = fresh  # type: ignore[assignment]

    def last(self, past: GPBPast) -> tuple[GPBPast, Told]:  # type: ignore[override]
        """The last step, which no later measurement speaks of."""
        return past, past.told(self.regimes)

    def retreat(self, turn: Turn, after: GPBPast) -> tuple[GPBPast, Told]:  # type: ignore[override]
        """One step back, of all hypotheses."""
        if after.outlier.dim() > turn.past.outlier.dim():
            several: tuple[GPBPast, Told] = tree.stack(
                [self.retreat(turn, x) for x in tree.unbind(after, len(after.outlier))], 0
            )
            return several
        before = _retreat(self, turn, after)
        return before, before.told(self.regimes)


def _retreat(f: Any, turn: Turn, after: GPBPast) -> GPBPast:
    """One step back: hypotheses of the step before (2 qualities, K motions) meet those of the step (R regimes, 2).

    As in ``torchfra.filters.hindsight``: what comes later is the measurement that makes of a prediction its smoothed
    belief, here for each quality and motion of the step.  Beliefs of the regimes of one motion have been merged, so
    that of those later measurements tell what their Markov chain passes on.

    Args:
        f: the filter.
        turn: two ``GPBPast``, and the frame between them.
        after: smoothed.
    """
    past, frame = turn.past, turn.frame
    regimes, before = f.regimes, past.beliefs()
    prior = _prior(f, past, turn.ahead.far)  # (now, was, ..., regime was, regime now)
    ahead = _of_regimes(f, f.carry(_each_motion(before), for_each_model(frame), None), turn.ahead.far)
    towards = regimes.of_motion(prior.transpose(-1, -2)).movedim(-2, 1).movedim(-1, 3)  # (now, R, was, motion was, ...)
    later = future(_predicted(regimes, ahead, towards), after.beliefs())
    each, fit = _each_regime(regimes, later).told(tree.map_ranked(lambda rank, x: x.unsqueeze(1), ahead))

    fit = without_failed(fit).movedim(3, -1)  # (R, now, was, ..., motion was)
    fit = regimes.of_each(fit, -1).movedim(0, -1)  # (now, was, ..., regime was, regime now)
    joint = prior + fit
    joint = without_failed(joint - joint.logsumexp((1, -2), keepdim=True))
    joint = joint + after.log_weights.movedim(-2, 0)[:, None, ..., None, :]
    log_weights = joint.logsumexp((0, -1))  # (was, ..., R)
    share = regimes.of_motion(joint.transpose(-1, -2)).movedim(-2, 0).movedim(-1, 3)  # (R, now, was, motion was, ...)
    share = share - share.logsumexp((0, 1), keepdim=True)
    told = moment_match(Gaussian(*(x.flatten(0, 1) for x in each)), share.flatten(0, 1))  # (was, motion was, ...)
    told = Gaussian(told.mean.movedim(1, -2), told.scale_tril.movedim(1, -3))
    clean, dirty = tree.unbind(inside(before, told), 2)
    return GPBPast(clean, dirty, log_weights.movedim(0, -2), past.outlier, past.far)


def _prior(f: Any, past: GPBPast, far: Tensor) -> Tensor:
    """Logs ``(2, 2, ..., R, R)`` of the probabilities of two steps: quality now and before, regime before and now."""
    log_weights = past.log_weights.movedim(-2, 0)
    joint = log_weights.unsqueeze(-1) + f.regimes.transition(log_weights)
    joint = f.regimes.rarer(joint.movedim(-1, 0), far.movedim(-1, 0).unsqueeze(-1)).movedim(0, -1)
    log_quality, _ = f.qualities.ahead(past.outlier)
    together: Tensor = log_quality[..., None, None] + joint
    return together


def _each_motion(beliefs: Gaussian) -> Gaussian:
    """Beliefs ``(2, ..., K)`` before every motion, ``(2, K, ..., K)``."""
    mean, root = beliefs
    return repeated(Gaussian(mean.movedim(-2, 1), root.movedim(-3, 1)), mean.shape[-2])


def _of_regimes(f: Any, ahead: Carried, far: Tensor) -> Carried:
    """Beliefs carried by every motion, ``(2, K, ..., K)``, as every regime carries them, ``(R, 2, K, ...)``.

    These are the parts of ``Regimes.predictions`` and ``Regimes.jumped``; process noise that is the same for all that
    came before stays one.
    """
    regimes, rank = f.regimes, ahead.mean.dim() - 2
    mean, spread, noise = (
        regimes.of_each(x.reshape((1,) * (rank + 1 + event - x.dim()) + x.shape).movedim(-1 - event, 0), 0)
        for x, event in ((ahead.mean, 1), (ahead.spread, 2), (ahead.process_noise, 2))
    )
    levels = in_front(regimes.levels(ahead.mean).sqrt(), rank)
    jumps = regimes.widths(ahead.mean, far.movedim(-1, 0)).unsqueeze(2)  # (J, was, 1, ...)
    batch = torch.broadcast_shapes(levels.shape[1:], jumps.shape[1:])
    levels, jumps = levels.expand(-1, *batch), jumps.expand(-1, *batch)
    one = torch.ones_like(levels[:1])
    level = torch.cat([levels, *[one] * (regimes.motions - 1), *[levels[-1:]] * len(jumps)]).unsqueeze(-1)
    jump = torch.cat([*[one] * (len(level) - len(jumps)), jumps]).unsqueeze(-1)
    there = torch.zeros_like(ahead.mean[(0,) * (rank + 1)])
    there[f.motion.position] = 1.0
    widened = 1 + (jump - 1) * there
    return Carried(mean, widened.unsqueeze(-1) * spread, (widened * level).unsqueeze(-1) * noise, None)


def _predicted(regimes: Regimes, ahead: Carried, log_weights: Tensor) -> Gaussian:
    """Predictions ``(2, ..., K)`` for each quality and motion of a step, merged over all that leads there.

    Args:
        regimes: of the motion.
        ahead: ``(R, 2, K, ...)`` of each regime, from each quality and motion before.
        log_weights: ``(2, R, 2, K, ...)`` logs of the probabilities.
    """
    first, jumps = regimes.count, regimes.count + regimes.motions - 1
    every = *(x.unsqueeze(0) for x in ahead[:3]), log_weights
    own = [torch.cat([x[:, :first], x[:, jumps:]], 1).movedim(0, 3).flatten(0, 1).unsqueeze(3) for x in every]
    groups = [_merged(*own)]
    if regimes.motions > 1:
        groups.append(_merged(*(x[:, first:jumps].movedim((2, 3), (0, 1)) for x in every)))
    mean, root = (torch.cat(parts, 1) for parts in zip(*groups, strict=True))  # (now, K, ...)
    return Gaussian(mean.movedim(1, -2), root.movedim(1, -3))


def _merged(mean: Tensor, spread: Tensor, noise: Tensor, log_weights: Tensor) -> Gaussian:
    """Beliefs carried ahead merged over the first two dimensions, of which the second may be one for their noise."""
    log_weights = log_weights - log_weights.logsumexp((0, 1))
    middle, root = moment_match(Gaussian(mean.flatten(0, 1), spread.flatten(0, 1)), log_weights.flatten(0, 1))
    if noise.shape[1] < log_weights.shape[1]:
        log_weights = log_weights.logsumexp(1, keepdim=True)
    noise = noise.expand(log_weights.shape[0], *noise.shape[1:])
    none = torch.zeros_like(noise[..., 0]).flatten(0, 1)
    added = moment_match(Gaussian(none, noise.flatten(0, 1)), log_weights.flatten(0, 1)).scale_tril
    return Gaussian(middle, tria(hstack(root, added)))


def _each_regime(regimes: Regimes, later: Future) -> Future:
    """What comes later, of every motion ``(2, ..., K)``, for every regime, ``(R, 2, 1, 1, ...)``."""

    def of_regime(rank: int, x: Tensor) -> Tensor:
        x = regimes.of_each(x, x.dim() - 1 - rank).movedim(-1 - rank, 0)
        return x.unsqueeze(2).unsqueeze(2)

    each: Future = tree.map_ranked(of_regime, later)
    return each
