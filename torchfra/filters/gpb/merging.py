"""Beliefs of states from those of what a sensor reads, and one belief for several hypotheses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.filters.gpb.regimes import Regimes
from torchfra.gaussian.mixture import matched, shared
from torchfra.gaussian.model import canonical
from torchfra.linalg.triangular import apply, hstack
from torchfra.motion.base import Motion
from torchfra.types import Gaussian


def lifted(predicted: Gaussian, belief: Gaussian) -> Gaussian:
    """Beliefs of states, from the components that a sensor reads in units of their predicted root; any root."""
    mean, root = predicted
    gain = root[..., : belief.mean.shape[-1]]
    own = gain @ belief.scale_tril
    return Gaussian(mean + apply(gain, belief.mean), hstack(own, root[..., gain.shape[-1] :]))


def shares(log_weights: Tensor) -> tuple[Tensor, Tensor]:
    """As ``shared``, but all shares are 0 where no hypothesis has any weight."""
    roots, total = shared(log_weights)
    return torch.where(total == -torch.inf, 0.0, roots), total


class Merged(NamedTuple):
    """What is left of the hypotheses of a step."""

    belief: Gaussian
    """``(2, ..., K)`` for clean and dirty, and each motion."""
    log_weights: Tensor
    """``(2, ..., K)``."""
    roots: Tensor
    """``(R, 2, 2, ...)``, regime, before and now: square roots of what share each hypothesis has in one of these."""


def merged(regimes: Regimes, beliefs: Gaussian, joint: Tensor, angles: Sequence[int]) -> Merged:
    """Hypotheses ``(2, R, 2, ...)``, now, regime and before, of logs of weights ``joint``, for each now and motion.

    ``angles`` are components of a state, as in ``moment_match``.
    """
    every = [x.movedim(0, 2) for x in (*beliefs, joint)]  # (R, before, now, ...)
    first, end = regimes.level_count, regimes.level_count + regimes.motions - 1
    own = every if regimes.motions == 1 else [torch.cat([x[:first], x[end:]]) for x in every]
    mean, root, weight = (x.flatten(0, 1) for x in own)
    roots, log_own = shares(weight)
    one = matched(Gaussian(mean, root), roots, angles)
    roots = roots.unflatten(0, own[2].shape[:2])
    if regimes.motions == 1:
        belief = Gaussian(one.mean.unsqueeze(-2), one.scale_tril.unsqueeze(-3))
        return Merged(belief, log_own.unsqueeze(-1), roots)
    mean, root, weight = (x[first:end].transpose(0, 1) for x in every)  # (before, others, now, ...)
    roots_others, log_others = shares(weight)
    rest = matched(Gaussian(mean, root), roots_others, angles)
    after = Gaussian(
        torch.cat([one.mean.unsqueeze(-2), rest.mean.movedim(0, -2)], -2),
        torch.cat([one.scale_tril.unsqueeze(-3), rest.scale_tril.movedim(0, -3)], -3),
    )
    log_weights = torch.cat([log_own.unsqueeze(-1), log_others.movedim(0, -1)], -1)
    return Merged(after, log_weights, torch.cat([roots[:first], roots_others.transpose(0, 1), roots[first:]]))


def together(beliefs: Gaussian, roots: Tensor, motion: Motion) -> Gaussian:
    """One Gaussian for hypotheses ``(2, ..., K)`` of states of a motion, by square roots of their weights."""
    mean, root = beliefs.mean.movedim(-2, 0), beliefs.scale_tril.movedim(-3, 0)
    flat = Gaussian(mean.flatten(0, 1), root.flatten(0, 1))
    belief = matched(flat, roots.movedim(-1, 0).flatten(0, 1), motion.angles)
    return canonical(motion, belief)
