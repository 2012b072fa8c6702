"""The way back of GPB: what comes later as a measurement of every hypothesis before."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfra import tree
from torchfra.filters.gpb.merging import together
from torchfra.filters.gpb.qualities import entry
from torchfra.filters.gpb.regimes import Regimes, in_front
from torchfra.filters.gpb.states import GPBState
from torchfra.filters.hindsight import inside
from torchfra.filters.interaction import for_each_model, held
from torchfra.filters.smoothing import BackwardStep, Told
from torchfra.filters.tracks import GaussianFilter
from torchfra.gaussian.future import Future, future
from torchfra.gaussian.mixture import log_sum, matched, repeated, shared, without_failed
from torchfra.gaussian.model import Carried, adapted
from torchfra.motion.base import Motion
from torchfra.types import Gaussian


class GPBPast(NamedTuple):
    """What the way back needs of a step; ``(..., T, ...)`` of a whole track.

    Over steps without any measurement ``clean``, ``dirty`` and ``outlier`` are of the last one that had some.
    """

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
    measured: Tensor
    """``(...)`` 1 where there was any, else 0."""

    def beliefs(self) -> Gaussian:
        """``(2, ..., K)``."""
        both: Gaussian = tree.stack([self.clean, self.dirty], 0)
        return both

    def told(self, regimes: Regimes, motion: Motion) -> Told:
        """All hypotheses together, and the probabilities of regimes and outliers."""
        log_weights = self.log_weights.movedim(-2, 0)
        weights = log_weights.exp()
        outlier = weights[1].sum(-1, keepdim=True) * self.measured.unsqueeze(-1) * self.outlier
        roots = (0.5 * regimes.of_motion(log_weights)).exp()
        return Told(together(self.beliefs(), roots, motion), weights.sum(0), outlier)


class WayBack(GaussianFilter[GPBState]):
    """The part of ``GPB`` that smooths."""

    keeps_past = True
    regimes: Regimes

    def check_smooths_several(self) -> None:
        """Raises a ``NotImplementedError``: there is no smoother over several sensors."""
        raise NotImplementedError(
            f"{type(self).__name__}: hypotheses of outliers are of one sensor on the way back; smooth several with "
            "presets.srckf or fra, or a bank of motions around them"
        )

    def past(self, belief: Gaussian, info: Any, state: Any, steps: GPBPast) -> GPBPast:  # type: ignore[override]
        """What is known of all hypotheses after each step."""
        return steps

    def fresh(self, past: GPBPast) -> GPBPast:  # type: ignore[override]
        """The same: nothing is decided later."""
        return past

    decided = fresh  # type: ignore[assignment]

    def needed_ahead(self, past: GPBPast) -> GPBPast:  # type: ignore[override]
        """How far the measurement was, if there was any."""
        return GPBPast(None, None, None, None, past.far, past.measured)  # type: ignore[arg-type]  # nothing reads the others

    def last(self, past: GPBPast) -> tuple[GPBPast, Told]:  # type: ignore[override]
        """The last step, which no later measurement speaks of."""
        return past, past.told(self.regimes, self.motion)

    def smooth_step(self, step: BackwardStep, after: GPBPast) -> tuple[GPBPast, Told]:  # type: ignore[override]
        """One step back, of all hypotheses."""
        if after.outlier.dim() > step.past.outlier.dim():
            several: tuple[GPBPast, Told] = tree.stack(
                [self.smooth_step(step, x) for x in tree.unbind(after, len(after.outlier))], 0
            )
            return several
        before = _smooth_step(self, step, after)
        return before, before.told(self.regimes, self.motion)


def _smooth_step(f: Any, step: BackwardStep, after: GPBPast) -> GPBPast:
    """One step back: hypotheses of the step before (2 qualities, K motions) meet those of the step (R regimes, 2).

    As in ``torchfra.filters.hindsight``: what comes later is the measurement that makes of a prediction its smoothed
    belief, here for each quality and motion of the step.  Beliefs of the regimes of one motion have been merged, so
    that of those later measurements tell what their Markov chain passes on.

    Args:
        f: the filter.
        step: two ``GPBPast``, and the frame between them.
        after: smoothed.
    """
    past, carried, frame = step.past, step.carried, step.frame
    regimes, before, far = f.regimes, past.beliefs(), step.ahead.far
    prior, of_carried = (_prior(f, x, step.ahead, frame.dt) for x in (past, carried))  # (now, was, ..., R was, R now)
    log_weights, measured = carried.log_weights.movedim(-2, 0), step.ahead.measured > 0
    mixed, _, _ = f.interact(carried.beliefs(), log_weights, frame.dt, measured)
    frame = adapted(for_each_model(frame), mixed.mean)  # as the filter has adapted it
    predicted = _predicted(f, f.carry(mixed, frame, None), far.movedim(-1, 0), log_sum(of_carried, -2))
    ahead = _of_regimes(f, f.carry(_each_motion(before), frame, None), far.movedim(-1, 0))
    later = _each_regime(regimes, future(predicted, after.beliefs(), f.motion.difference))
    each, fit = later.told(ahead, f.motion.difference)  # (R, now, motion was, was, ...)

    fit = without_failed(fit).movedim(2, -1)  # (R, now, was, ..., motion was)
    fit = regimes.of_each(fit, -1).movedim(0, -1)  # (now, was, ..., regime was, regime now)
    joint = prior + fit
    total = log_sum(log_sum(joint, -2), 1)[:, None, ..., None, :]
    none = total == -torch.inf  # nothing leads there
    joint = without_failed(torch.where(none, -torch.inf, joint - torch.where(none, 0.0, total)))
    joint = joint + after.log_weights.movedim(-2, 0)[:, None, ..., None, :]
    log_weights = log_sum(log_sum(joint, -1), 0)  # (was, ..., R)
    share = regimes.of_motion(joint.transpose(-1, -2)).movedim((-2, -1), (0, 2))  # (R, now, motion was, was, ...)
    told = matched(Gaussian(*(x.flatten(0, 1) for x in each)), shared(share.flatten(0, 1))[0])
    told = Gaussian(told.mean.movedim(0, -2), told.scale_tril.movedim(0, -3))
    clean, dirty = tree.unbind(inside(before, told), 2)
    smoothed: GPBPast = past._replace(clean=clean, dirty=dirty, log_weights=log_weights.movedim(0, -2))
    return smoothed


def _prior(f: Any, past: GPBPast, ahead: GPBPast, dt: Tensor) -> Tensor:
    """Logs ``(2, 2, ..., R, R)`` of the probabilities of two steps: quality now and before, regime before and now."""
    log_weights, measured = past.log_weights.movedim(-2, 0), ahead.measured > 0
    joint = log_weights.unsqueeze(-1) + held(f.regimes.transition(log_weights, measured), dt)
    joint = f.regimes.rarer(joint.movedim(-1, 0), ahead.far.movedim(-1, 0).unsqueeze(-1)).movedim(0, -1)
    log_quality, _ = f.qualities.ahead(past.outlier, measured)
    together: Tensor = log_quality[..., None, None] + joint
    return together


def _predicted(f: Any, ahead: Carried, far: Tensor, log_weights: Tensor) -> Gaussian:
    """Predictions ``(2, ..., K)`` for each quality and motion of a step, merged over all that leads there.

    Args:
        f: the filter.
        ahead: ``(2, ..., K)`` mixed beliefs carried by each motion, from each quality before.
        far: ``(2, ...)``: see ``GPBPast``.
        log_weights: ``(2, 2, ..., R)`` logs of the probabilities of both qualities and of the regime.
    """
    regimes, first = f.regimes, f.regimes.level_count
    levels = regimes.predictions(*ahead[:3])
    agile = entry(levels, regimes.agile)
    jumped, others = regimes.jumped(agile, far, f.motion.position), regimes.motions - 1
    share = log_weights.movedim(-1, 1)  # (now, R, was, ...)

    own = (torch.cat([x[:first], jump]).flatten(0, 1).unsqueeze(1) for x, jump in zip(levels, jumped, strict=True))
    share_own = torch.cat([share[:, :first], share[:, first + others :]], 1).movedim(0, 2).flatten(0, 1)
    merged = matched(Gaussian(*own), shared(share_own)[0], f.motion.angles)  # (now, ...)
    if not others:
        return Gaussian(merged.mean.unsqueeze(-2), merged.scale_tril.unsqueeze(-3))
    other = Gaussian(*(x[first:].transpose(0, 1).unsqueeze(1) for x in levels))  # (was, 1, motion, ...)
    share_others = share[:, first : first + others].movedim(2, 0)
    mean, root = matched(other, shared(share_others)[0], f.motion.angles)  # (now, motion, ...)
    return Gaussian(
        torch.cat([merged.mean.unsqueeze(-2), mean.movedim(1, -2)], -2),
        torch.cat([merged.scale_tril.unsqueeze(-3), root.movedim(1, -3)], -3),
    )


def _each_motion(beliefs: Gaussian) -> Gaussian:
    """Beliefs ``(2, ..., K)`` before every motion, ``(K, 2, ..., K)``."""
    mean, root = beliefs
    return repeated(Gaussian(mean.movedim(-2, 0), root.movedim(-3, 0)), mean.shape[-2])


def _of_regimes(f: Any, ahead: Carried, far: Tensor) -> Carried:
    """Beliefs ``(K, 2, ..., K)`` carried by every motion, as every regime carries them, ``(R, 1, K, 2, ...)``.

    These are the parts of ``Regimes.predictions`` and ``Regimes.jumped``; process noise that is the same for all
    motions before stays one.
    """
    regimes, rank = f.regimes, ahead.mean.dim() - 2  # of dimensions (motion was, was, ...)

    def of_each(x: Tensor, event: int) -> Tensor:
        x = regimes.of_each(x, x.dim() - 1 - event).movedim(-1 - event, 0)
        return x.reshape(x.shape[:1] + (1,) * (rank + 1 + event - x.dim()) + x.shape[1:])

    mean, spread, noise = of_each(ahead.mean, 1), of_each(ahead.spread, 2), of_each(ahead.process_noise, 2)
    levels = in_front(regimes.levels(ahead.mean).sqrt(), rank)
    jumps = regimes.widths(ahead.mean, far)
    jumps = jumps.reshape(jumps.shape[:1] + (1,) * (rank + 1 - jumps.dim()) + jumps.shape[1:])
    others = regimes.motions - 1
    every = levels.new_ones(others, *levels.shape[1:]), levels[-1:].expand(len(jumps), *levels.shape[1:])
    level = torch.cat([levels, *every])
    wide = torch.cat([jumps.new_ones(regimes.level_count + others, *jumps.shape[1:]), jumps])
    there = torch.zeros_like(ahead.mean[(0,) * (rank + 1)])
    there[f.motion.position] = 1.0
    widened = (1 + (wide.unsqueeze(-1) - 1) * there).unsqueeze(-1)
    spread, noise = widened * spread, widened * level[..., None, None] * noise
    return Carried(mean.unsqueeze(1), spread.unsqueeze(1), noise.unsqueeze(1), None)


def _each_regime(regimes: Regimes, later: Future) -> Future:
    """What comes later, of every motion ``(2, ..., K)``, for every regime, ``(R, 2, 1, 1, ...)``."""

    def of_regime(rank: int, x: Tensor) -> Tensor:
        x = regimes.of_each(x, x.dim() - 1 - rank).movedim(-1 - rank, 0)
        return x.unsqueeze(2).unsqueeze(2)

    each: Future = tree.map_ranked(of_regime, later)
    return each
