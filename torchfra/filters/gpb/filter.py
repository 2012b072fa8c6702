"""GPB: every step as a mixture of hypotheses, merged by generalised pseudo-Bayes."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra import tree
from torchfra.filters.base import Mix
from torchfra.filters.gpb.qualities import Qualities
from torchfra.filters.gpb.regimes import Regimes
from torchfra.filters.imm import for_each_model, models_first, repeated
from torchfra.filters.records import Record
from torchfra.filters.tracks import GaussianFilter
from torchfra.gaussian.cubature import third_degree
from torchfra.gaussian.inputs import Frame
from torchfra.gaussian.mixture import moment_match
from torchfra.gaussian.model import propagate
from torchfra.gaussian.rules import Rule
from torchfra.gaussian.update import innovation
from torchfra.hyper import Hyper, Value, one_of
from torchfra.linalg.triangular import apply
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian


class GPBState(NamedTuple):
    """What GPB knows after a step."""

    belief: Gaussian
    """All hypotheses together."""
    settled: Gaussian
    """Of the step before, now that its hypotheses have met a measurement."""
    clean: Gaussian
    """``(..., K)`` for each motion, if no block was an outlier."""
    dirty: Gaussian
    """``(..., K)`` for each motion, if one was."""
    log_ahead: Tensor
    """``(..., 2, K, R)`` logs of the probabilities of clean and dirty, of the motion, and of the next regime."""
    outlier: Tensor
    """``(..., B)`` of each block that it was an outlier, if the step was dirty."""


class GPBInfo(NamedTuple):
    """Per step and track."""

    filtered: Gaussian
    """``mean (..., T, n)`` and ``scale_tril``: what was known at the step itself."""
    settled: Gaussian
    """The same, with the step's hypotheses weighed by the next measurement; the last step is as filtered."""
    motions: Tensor
    """``(..., T, K)`` probabilities of the motions."""
    regimes: Tensor
    """``(..., T, R)`` of the regimes."""
    outlier: Tensor
    """``(..., T, B)`` of each block that it is an outlier."""


class GPB(GaussianFilter):
    """Generalised pseudo-Bayes over regimes of the motion and qualities of the measurement."""

    def __init__(
        self,
        motion: Motion,
        sensor: Sensor,
        *,
        regimes: Regimes,
        qualities: Qualities,
        transition: Value | None = None,
        initial: Value | None = None,
        poor: Value = 0.1,
        start: Value = 1000.0,
        lag: int = 0,
        rule: Callable[[int], Rule] = third_degree,
    ) -> None:
        super().__init__(motion if isinstance(motion, Bank) else Bank([motion]), sensor, rule)
        one_of(lag=(lag, (0, 1)))
        self.regimes, self.qualities, self.lag = regimes, qualities, lag
        self.poor = Hyper(poor, constraints.unit_interval, name="poor")
        self.start = Hyper(start, name="start")
        count = len(self.motion)
        if count > 1:
            initial = torch.full((count,), 1 / count) if initial is None else initial
            transition, initial = (torch.as_tensor(x, dtype=torch.float64) for x in (transition, initial))
            self.transition = Hyper(transition, constraints.simplex, event_dim=2, name="transition")
            self.initial = Hyper(initial, constraints.simplex, event_dim=1, name="initial")

    def begin(self, belief: Gaussian) -> GPBState:
        """The state of a belief: the same for clean and dirty, and for every motion."""
        mean, count = belief.mean, len(self.motion)
        poor = self.poor(mean)
        quality = torch.stack([torch.log1p(-poor), poor.log()], -1)[..., None, None]
        motion = (self.initial(mean).log() if count > 1 else mean.new_zeros(1))[..., None, :, None]
        log_ahead = quality + motion + self.regimes.first(mean).log()[..., None, None, :]
        log_ahead = log_ahead.expand(*mean.shape[:-1], *log_ahead.shape[-3:])
        every = repeated(belief, count)
        widened = every._replace(scale_tril=self.start(mean).sqrt()[..., None, None, None] * every.scale_tril)
        outlier = mean.new_zeros(*mean.shape[:-1], len(self.qualities.blocks))
        return GPBState(belief, belief, every, widened, log_ahead, outlier)

    def advance(self, state: GPBState, frame: Frame, mix: Mix | None = None) -> tuple[GPBState, Record]:
        """One step: regimes ahead, qualities of the measurement, and the mixture of both merged."""
        each = for_each_model(frame)
        before = tree.stack([state.clean, state.dirty], 0)  # (2, ..., K)
        log_before = state.log_ahead.movedim(-3, 0)
        mixed, log_ahead, shares = self.interact(before, log_before)
        measured = frame.seen.sum(-1, keepdim=True) > 0
        log_ahead = self.regimes.possible(log_ahead, measured).movedim(-1, 0)  # (R, 2, ..., K)
        predicted = self.regimes.predictions(*propagate(self.motion, self.motion_rule, mixed, each)[:3], self.motion.position)
        log_quality, log_blocks = self.qualities.prior(state.outlier)
        seen = self.seen(predicted)

        clean = self.qualities.clean(seen, lambda x: self.compare(x, each))
        dirty = self.qualities.dirty(seen, lambda x: self.compare(x, each), log_blocks, each.seen)
        log_density = torch.stack([clean.log_density, dirty.log_density])
        joint = log_quality.unsqueeze(1) + log_ahead + log_density  # (2, R, 2, ..., K): now, regime, before
        joint = torch.where(joint.isnan(), -torch.inf, joint)
        total = joint.movedim(-1, 0).flatten(0, 3).logsumexp(0)
        joint = joint - total.unsqueeze(-1)
        log_now = joint.flatten(1, 2).logsumexp(1)  # (2, ..., K)
        after = [
            moment_match(flat(lifted(predicted, c.belief)), (joint[h] - log_now[h]).flatten(0, 1))
            for h, c in enumerate((clean, dirty))
        ]
        belief = together(tree.stack(after, 0), log_now)
        log_was = joint.flatten(0, 1).logsumexp(0)  # (2, ..., K)
        if shares is not None:
            log_was = (shares + log_was.unsqueeze(-2)).logsumexp(-1)
        settled = together(before, log_was)
        outlier = (joint[1].exp().unsqueeze(-1) * dirty.outlier).flatten(0, 1).sum(0).sum(-2)
        share_dirty = log_now[1].logsumexp(-1, keepdim=True).exp()
        by_regime = joint.logsumexp(2).movedim(1, -1)  # (2, ..., K, R)
        log_next = self.regimes.ahead(by_regime).movedim(0, -3)
        new = GPBState(belief, settled, *after, log_next, outlier / share_dirty)
        info = _Step(settled, log_now.exp().sum(0), by_regime.exp().sum(0).sum(-2), outlier)
        merged = together(seen.__class__(seen.mean.flatten(0, 1), seen.scale_tril.flatten(0, 1)), log_ahead.flatten(0, 1) - log_ahead.movedim(-1, 0).flatten(0, 2).logsumexp(0).unsqueeze(-1))
        whitened = self.compare(merged, frame)
        root, normalised = innovation(whitened)
        return new, Record(belief, whitened.residual, root, normalised, info, total)

    def seen(self, predicted: Gaussian) -> Gaussian:
        d = self.sensor.reads
        return Gaussian(predicted.mean[..., :d], predicted.scale_tril[..., :d, :d])

    def interact(self, before: Gaussian, log_before: Tensor) -> tuple[Gaussian, Tensor, Tensor | None]:
        if len(self.motion) == 1:
            return before, log_before, None
        matrix = self.transition(log_before).log()  # (..., K, K)
        log_motion = log_before.logsumexp(-1)  # (2, ..., K)
        joint = log_motion.unsqueeze(-1) + matrix  # (2, ..., was, now)
        ahead = joint.logsumexp(-2)
        shares = joint - ahead.unsqueeze(-2)
        given = (log_before - log_motion.unsqueeze(-1)).unsqueeze(-2)  # (2, ..., was, 1, R)
        regimes = (joint.unsqueeze(-1) + given).logsumexp(-3)  # (2, ..., now, R)
        mean, root = models_first(before)
        count = len(self.motion)
        mixed = moment_match(repeated(Gaussian(mean, root), count), shares.movedim(-2, 0))
        return mixed, regimes, shares

    def finish(self, state: GPBState, belief: Gaussian, info: _Step) -> tuple[Gaussian, GPBInfo]:
        last = info.motions.dim() - 2

        def one_later(steps: Tensor, end: Tensor) -> Tensor:
            return torch.cat([steps.narrow(last, 1, steps.shape[last] - 1), end.unsqueeze(last)], last)

        settled = tree.map_tensors(one_later, info.settled, state.belief)
        final = settled if self.lag else belief
        return final, GPBInfo(belief, settled, info.motions, info.regimes, info.outlier)


class _Step(NamedTuple):
    settled: Gaussian
    motions: Tensor
    regimes: Tensor
    outlier: Tensor


def lifted(predicted: Gaussian, belief: Gaussian) -> Gaussian:
    """Beliefs of states, from the components that a sensor reads in units of their predicted root; any root."""
    mean, root = predicted
    d = belief.mean.shape[-1]
    gain = root[..., :d]
    return Gaussian(mean + apply(gain, belief.mean), torch.cat([gain @ belief.scale_tril, root[..., d:]], -1))


def flat(beliefs: Gaussian) -> Gaussian:
    return Gaussian(*(x.flatten(0, 1) for x in beliefs))


def together(beliefs: Gaussian, log_weights: Tensor) -> Gaussian:
    """One Gaussian for hypotheses ``(H, ..., K)``."""
    mean, root = beliefs
    mean, root = mean.movedim(-2, 0).flatten(0, 1), root.movedim(-3, 0).flatten(0, 1)
    return moment_match(Gaussian(mean, root), log_weights.movedim(-1, 0).flatten(0, 1))
