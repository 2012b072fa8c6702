"""Hypotheses: beliefs of which one is true, with their weights; merging them, and carrying them over a step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.filters.interaction import for_each_model
from torchfra.gaussian.inputs import Frame
from torchfra.gaussian.mixture import largest, matched, share_roots
from torchfra.gaussian.model import Propagated, propagate
from torchfra.gaussian.rules import Rule
from torchfra.linalg.batches import broadcast_shapes
from torchfra.linalg.safe import safe_log
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.tree import event_ranks
from torchfra.types import Gaussian

OUTLIER, MOTION, BEFORE = 0, 1, 2
"""The axes of hypotheses, all in front of the batch: whether the measurement has an outlier in any block (2, no and
yes), how the target moves (``R`` regimes, or ``K`` motions), whether the measurement before had one (2).  An axis along
which nothing differs, or over which hypotheses have been merged, has size 1, so that all shapes broadcast."""


class Posterior(NamedTuple):
    """Probabilities of hypotheses given the measurement."""

    probability: Tensor
    """``(2, R, 2, ...)``, which sum to one."""
    share: Tensor
    """``(2, R, 2, ...)`` probabilities given whether the measurement has an outlier; they sum to one for either."""
    mode: Tensor
    """``(2, 1, 1, ...)`` square roots of the probabilities of no outlier and of some."""
    log_regimes: Tensor
    """``(2, R, 1, ...)`` logs of the joint probabilities of no outlier or some, and of the regime."""
    log_likelihood: Tensor
    """``(...)`` log likelihood of the measurement."""

    @staticmethod
    def of(roots: Tensor, log_mode: Tensor) -> Posterior:
        """From square roots ``(2, R, 2, ...)`` of the shares, and logs ``(2, 1, 1, ...)`` of weights of the modes."""
        mode, log_likelihood = share_roots(log_mode)  # NaN where every hypothesis has failed
        share = roots.square()
        log_regimes = log_mode + safe_log(share.sum(BEFORE, keepdim=True)) - log_likelihood
        return Posterior((roots * mode).square(), share, mode, log_regimes, log_likelihood[0, 0])

    @property
    def some_outlier(self) -> Tensor:
        """``(...)`` probability that the measurement has an outlier in some block."""
        return self.mode[1, 0, 0].square()


@event_ranks(log_weight=0)
class Hypotheses(NamedTuple):
    """Beliefs of which one is true, with the logs of their weights, which need not sum to one."""

    belief: Gaussian
    """``mean (2, R, 2, ..., n)``; ``scale_tril`` any root."""
    log_weight: Tensor
    """``(2, R, 2, ...)``; minus infinity for a hypothesis that is ruled out, whose belief may be NaN."""

    def share_roots(self, *axes: int) -> tuple[Tensor, Tensor]:
        """Square roots of the probabilities along some axes given the others, and the log weights of those others.

        Where no hypothesis has any weight all shares are 0, with a gradient of 0.
        """
        top = largest(self.log_weight, axes, keepdim=True)
        roots = (0.5 * (self.log_weight - top)).exp()
        total = roots.square().sum(axes, keepdim=True)
        none = total == 0
        total = torch.where(none, 1.0, total)
        return roots / total.sqrt(), torch.where(none, -torch.inf, top + total.log())

    def merged(self, *axes: int, angles: Sequence[int] = (), triangular: bool = True) -> Hypotheses:
        """The hypotheses along some axes merged into one with their moments.

        Args:
            axes: the axes to merge over; they have size 1 afterwards.
            angles: components of a state that are angles, as in ``gaussian.moment_match``.
            triangular: as in ``gaussian.mixture.matched``.
        """
        roots, total = self.share_roots(*axes)
        return Hypotheses(merge(self.belief, roots, axes, angles, triangular=triangular), total)

    def of(self, regimes: Sequence[int]) -> Hypotheses:
        """The hypotheses of some regimes."""
        (mean, root), log_weight, first, count = self.belief, self.log_weight, regimes[0], len(regimes)
        if tuple(regimes) == tuple(range(first, first + count)):
            last = first + count
            return Hypotheses(Gaussian(mean[:, first:last], root[:, first:last]), log_weight[:, first:last])
        which = torch.tensor(regimes, dtype=torch.int64, device=mean.device)
        mean, root, log_weight = [x.index_select(MOTION, which) for x in (mean, root, log_weight)]
        return Hypotheses(Gaussian(mean, root), log_weight)


def taken(x: Tensor, which: Sequence[int], axis: int) -> Tensor:
    """The entries of ``x`` along an axis that have these indices."""
    if list(which) == list(range(which[0], which[0] + len(which))):
        return x.narrow(axis, which[0], len(which))
    return x.index_select(axis, torch.tensor(which, dtype=torch.int64, device=x.device))


def merge(
    belief: Gaussian, roots: Tensor, axes: Sequence[int], angles: Sequence[int] = (), *, triangular: bool = True
) -> Gaussian:
    """The beliefs of hypotheses along some axes merged into one with their moments.

    Args:
        belief: ``(2, R, 2, ..., n)``, any root.
        roots: ``(2, R, 2, ...)`` square roots of the probabilities.
        axes: the axes to merge over; they have size 1 afterwards.
        angles: components of a state that are angles, as in ``gaussian.moment_match``.
        triangular: as in ``gaussian.mixture.matched``.
    """
    batch = broadcast_shapes(belief.mean.shape[:-1], belief.scale_tril.shape[:-2], roots.shape)
    axes, first = tuple(axes), tuple(range(len(axes)))
    mean = belief.mean.expand(*batch, -1).movedim(axes, first).flatten(0, first[-1])
    root = belief.scale_tril.expand(*batch, *belief.scale_tril.shape[-2:]).movedim(axes, first).flatten(0, first[-1])
    roots = roots.expand(batch).movedim(axes, first).flatten(0, first[-1])
    mean, root = matched(Gaussian(mean, root), roots, angles, triangular=triangular)
    for axis in sorted(axes):
        mean, root = mean.unsqueeze(axis), root.unsqueeze(axis)
    return Gaussian(mean, root)


def moments(belief: Gaussian, roots: Tensor, angles: Sequence[int]) -> Gaussian:
    """The Gaussian ``(..., n)`` with the moments of all hypotheses, by square ``roots`` of their probabilities."""
    mean, root = merge(belief, roots, (OUTLIER, MOTION, BEFORE), angles)
    return Gaussian(mean[0, 0, 0], root[0, 0, 0])


def estimate(belief: Gaussian, roots: Tensor, motion: Motion) -> Gaussian:
    """``moments``, with angles in the range that the motion uses."""
    mean, root = moments(belief, roots, motion.angles)
    return Gaussian(motion.canonical(mean), root)


def propagate_motions(bank: Bank, rule: Rule, belief: Gaussian, frame: Frame) -> Propagated:
    """Carries ``S`` beliefs on axis ``MOTION`` over a step: ``K`` by the motions of a bank, all others by its first.

    Process noise that several hypotheses share has size 1 along their axes.

    Args:
        bank: the ``K`` motions.
        rule: carries a belief through them.
        belief: ``(1, S, ..., n)``.
        frame: of the step.
    """
    frame = for_each_model(frame) if frame.transition is None else frame  # a linear bank has all that it needs
    count, rank = len(bank), belief.mean.dim() - 1
    more = belief.mean.shape[MOTION] - count
    mean, spread, noise, _ = propagate(bank, rule, for_bank(belief, count), frame)  # no weight is negative

    def back(event: int, x: Tensor) -> Tensor:
        x = x.reshape((1,) * (rank + event - x.dim()) + x.shape).movedim(-1 - event, MOTION)
        if not more:
            return x
        # The first layer has the beliefs of the motions; in each other one only that by the first motion counts.
        layers = x.expand(more + 1, *x.shape[1:])
        return torch.cat([layers[:1], layers[1:, :1].transpose(0, MOTION)], MOTION)

    return Propagated(back(1, mean), back(2, spread), back(2, noise), None)


def for_bank(belief: Gaussian, count: int) -> Gaussian:
    """Beliefs ``(1, S, ...)`` as a ``Bank`` of ``count`` motions takes them: layers ``(1 + S - count, ..., count)``.

    The first layer has the beliefs of the motions, each other layer one of the rest, repeated for each motion.
    """
    mean, root = belief
    if more := mean.shape[MOTION] - count:
        mean, root = [
            torch.cat([x[:, :count], x[:, count:].transpose(0, MOTION).expand(more, count, *x.shape[2:])])
            for x in belief
        ]
    return Gaussian(mean.movedim(MOTION, -2), root.movedim(MOTION, -3))


def from_state(belief: Gaussian, log_weight: Tensor, axes: tuple[int, int], count: int = 3) -> Hypotheses:
    """The hypotheses of a state, whose tensors are ``(..., 2, K, n)`` and ``(..., 2, R)``.

    Args:
        belief: without and with an outlier, for each motion.
        log_weight: without and with an outlier, of each regime.
        axes: the axes of hypotheses that these two dimensions become.
        count: number of axes of hypotheses.
    """
    others = (None,) * (count - 2)
    mean, root = belief.mean[others].movedim((-3, -2), axes), belief.scale_tril[others].movedim((-4, -3), axes)
    return Hypotheses(Gaussian(mean, root), log_weight[others].movedim((-2, -1), axes))


def to_state(every: Hypotheses, axes: tuple[int, int], count: int = 3) -> Hypotheses:
    """The inverse of ``from_state``; all other axes must have size 1."""
    (mean, root), others = every.belief, (0,) * (count - 2)
    belief = Gaussian(mean.movedim(axes, (-3, -2))[others], root.movedim(axes, (-4, -3))[others])
    return Hypotheses(belief, every.log_weight.movedim(axes, (-2, -1))[others])


def values_first(values: Tensor, rank: int, count: int = 1) -> Tensor:
    """Values ``(..., C)`` of tracks as ``(C, ...)`` with ``rank`` dimensions after ``C``, the last for tracks.

    With ``count`` dimensions of values, all of them come first.
    """
    values = values.movedim(tuple(range(-count, 0)), tuple(range(count)))
    return values.reshape(values.shape[:count] + (1,) * (rank + count - values.dim()) + values.shape[count:])
