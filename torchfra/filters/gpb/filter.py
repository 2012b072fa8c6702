"""GPB: every step as a mixture of hypotheses, merged by generalised pseudo-Bayes."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra import tree
from torchfra.filters.base import Mix
from torchfra.filters.gpb.qualities import Corrected, Qualities
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
    log_weights: Tensor
    """``(..., 2, R, R)`` logs of the probabilities of clean and dirty, of the regime, and of the next one."""
    outlier: Tensor
    """``(..., B)`` of each block that it was an outlier, if the step was dirty."""


class GPBInfo(NamedTuple):
    """Per step and track."""

    filtered: Gaussian
    """``mean (..., T, n)`` and ``scale_tril``: what was known at the step itself."""
    settled: Gaussian
    """The same, with the step's hypotheses weighed by the next measurement; the last step is as filtered."""
    regimes: Tensor
    """``(..., T, R)`` probabilities of the regimes."""
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

    def begin(self, belief: Gaussian) -> GPBState:
        """The state of a belief: as it is, and widened, for every motion."""
        mean, poor = belief.mean, self.poor(belief.mean)
        log_start = torch.stack([torch.log1p(-poor), poor.log()], -1)
        # A chain that has been in each regime with equal odds and is in one of the first now.
        first = self.regimes.first(mean).log().unsqueeze(-2)
        count = first.shape[-1]
        log_weights = log_start[..., None, None] + (first - first.new_tensor(count).log()).unsqueeze(-3)
        log_weights = log_weights.expand(*mean.shape[:-1], 2, count, count)
        every = repeated(belief, len(self.motion))
        widened = every._replace(scale_tril=self.start(mean).sqrt()[..., None, None, None] * every.scale_tril)
        outlier = mean.new_zeros(*mean.shape[:-1], len(self.qualities.blocks))
        return GPBState(belief, belief, every, widened, log_weights, outlier)

    def advance(self, state: GPBState, frame: Frame, mix: Mix | None = None) -> tuple[GPBState, Record]:
        """One step: every regime ahead, every quality of the measurement, and what is left of them merged."""
        before = tree.stack([state.clean, state.dirty], 0)  # (2, ..., K)
        pairs = state.log_weights.movedim(-3, 0)  # (2, ..., R, R)
        mixed, shares = self.interact(before, pairs)
        measured = frame.seen.sum(-1, keepdim=True) > 0
        log_ahead = self.regimes.possible(pairs.logsumexp(-2), measured).movedim(-1, 0)  # (R, 2, ...)
        parts = propagate(self.motion, self.motion_rule, mixed, for_each_model(frame))
        predicted = self.regimes.predictions(*parts[:3], self.motion.position)  # (R, 2, ..., n)
        seen = Gaussian(*self.read(predicted))
        log_quality, prior = self.qualities.ahead(state.outlier)
        both = self.qualities(seen, lambda x: self.compare(x, frame), prior, 1 - frame.seen)
        joint = log_quality.unsqueeze(1) + log_ahead + torch.stack([x.log_density for x in both])
        joint = torch.where(joint.isnan(), -torch.inf, joint)  # (2, R, 2, ...): now, regime, before
        total = joint.flatten(0, 2).logsumexp(0)
        joint = joint - total
        after, log_motions = self.merge(predicted, both, joint)
        belief = together(after, log_motions)
        settled = together(before, self.hindsight(joint, shares))
        outlier = (joint[1].exp().unsqueeze(-1) * both[1].outlier).sum((0, 1))
        by_regime = joint.logsumexp(2).movedim(1, -1)  # (2, ..., R)
        dirty = by_regime[1].logsumexp(-1, keepdim=True).exp()
        pairs = self.regimes.ahead(by_regime).movedim(0, -3)
        new = GPBState(belief, settled, *tree.unbind(after, 2), pairs, outlier / dirty)
        info = _Step(settled, by_regime.exp().sum(0), outlier)
        whitened = self.compare(self.expected(seen, log_ahead), frame)
        root, normalised = innovation(whitened)
        return new, Record(belief, whitened.residual, root, normalised, info, total)

    def read(self, predicted: Gaussian) -> tuple[Tensor, Tensor]:
        """Of states, what the sensor reads."""
        d = self.sensor.reads
        return predicted.mean[..., :d], predicted.scale_tril[..., :d, :d]

    def expected(self, seen: Gaussian, log_ahead: Tensor) -> Gaussian:
        """One prediction for all hypotheses ``(R, 2, ...)``."""
        flat = log_ahead.flatten(0, 1)
        return moment_match(Gaussian(*(x.flatten(0, 1) for x in seen)), flat - flat.logsumexp(0))

    def interact(self, before: Gaussian, pairs: Tensor) -> tuple[Gaussian, Tensor | None]:
        """The motions mixed, and ``(2, ..., K, K)`` logs of the share of each ``[was, now]``."""
        if len(self.motion) == 1:
            return before, None
        members = self.regimes.members
        rows = torch.stack([pairs[..., was, :].logsumexp(-2) for was in members], -2)
        joint = torch.stack([rows[..., now].logsumexp(-1) for now in members], -1)
        shares = joint - joint.logsumexp(-2, keepdim=True)
        first = repeated(Gaussian(*models_first(before)), len(members))
        return moment_match(first, shares.movedim(-2, 0)), shares

    def merge(self, predicted: Gaussian, both: tuple[Corrected, Corrected], joint: Tensor) -> tuple[Gaussian, Tensor]:
        """Of clean and dirty, and of each motion, what is left ``(2, ..., K)``, and its log weight."""
        after, weights = [], []
        for now, corrected in enumerate(both):
            mean, root = lifted(predicted, corrected.belief)
            for members in self.regimes.members:
                own = joint[now, members].flatten(0, 1)
                weights.append(own.logsumexp(0))
                beliefs = Gaussian(mean[members].flatten(0, 1), root[members].flatten(0, 1))
                after.append(moment_match(beliefs, own - weights[-1]))
        count = len(self.motion)
        merged = [tree.stack(after[i : i + count], 0) for i in (0, count)]
        stacked = tree.stack([Gaussian(x.mean.movedim(0, -2), x.scale_tril.movedim(0, -3)) for x in merged], 0)
        return stacked, torch.stack(weights).unflatten(0, (2, count)).movedim(1, -1)

    def hindsight(self, joint: Tensor, shares: Tensor | None) -> Tensor:
        """Log weights ``(2, ..., K)`` of the beliefs before a step, now that it is measured."""
        was = joint.logsumexp(0)  # (R, 2, ...)
        if shares is None:
            return was.logsumexp(0).unsqueeze(-1)
        now = torch.stack([was[members].logsumexp(0) for members in self.regimes.members], -1)
        return (shares + now.unsqueeze(-2)).logsumexp(-1)

    def finish(self, state: GPBState, belief: Gaussian, info: _Step) -> tuple[Gaussian, GPBInfo]:
        """Each step's settled estimate comes with the next."""
        last = info.regimes.dim() - 2

        def one_later(steps: Tensor, end: Tensor) -> Tensor:
            return torch.cat([steps.narrow(last, 1, steps.shape[last] - 1), end.unsqueeze(last)], last)

        settled = tree.map_tensors(one_later, info.settled, state.belief)
        return settled if self.lag else belief, GPBInfo(belief, settled, info.regimes, info.outlier)


class _Step(NamedTuple):
    settled: Gaussian
    regimes: Tensor
    outlier: Tensor


def lifted(predicted: Gaussian, belief: Gaussian) -> Gaussian:
    """Beliefs of states, from the components that a sensor reads in units of their predicted root; any root."""
    mean, root = predicted
    gain = root[..., : belief.mean.shape[-1]]
    own = gain @ belief.scale_tril
    return Gaussian(mean + apply(gain, belief.mean), torch.cat([own, root[..., gain.shape[-1] :]], -1))


def together(beliefs: Gaussian, log_weights: Tensor) -> Gaussian:
    """One Gaussian for hypotheses ``(2, ..., K)``."""
    mean, root = beliefs.mean.movedim(-2, 0), beliefs.scale_tril.movedim(-3, 0)
    return moment_match(Gaussian(mean.flatten(0, 1), root.flatten(0, 1)), log_weights.movedim(-1, 0).flatten(0, 1))
