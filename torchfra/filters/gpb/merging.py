"""Beliefs of states from those of what a sensor reads, and one belief for several hypotheses."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchfra.filters.gpb.regimes import Regimes
from torchfra.gaussian.mixture import matched, moment_match, shared
from torchfra.linalg.triangular import apply, hstack
from torchfra.motion.base import Motion
from torchfra.types import Gaussian


def lifted(predicted: Gaussian, belief: Gaussian) -> Gaussian:
    """Beliefs of states, from the components that a sensor reads in units of their predicted root; any root."""
    mean, root = predicted
    gain = root[..., : belief.mean.shape[-1]]
    own = gain @ belief.scale_tril
    return Gaussian(mean + apply(gain, belief.mean), hstack(own, root[..., gain.shape[-1] :]))


def merged(regimes: Regimes, beliefs: Gaussian, joint: Tensor, angles: Sequence[int]) -> tuple[Gaussian, Tensor]:
    """What is left of hypotheses ``(2, R, 2, ...)``, now, regime and before: for clean and dirty, ``(2, ..., K)``.

    ``angles`` are components of a state, as in ``moment_match``.
    """
    every = [x.movedim(0, 2) for x in (*beliefs, joint)]  # (R, before, now, ...)
    first, end = regimes.count, regimes.count + regimes.motions - 1
    own = every if regimes.motions == 1 else [torch.cat([x[:first], x[end:]]) for x in every]
    mean, root, weight = (x.flatten(0, 1) for x in own)
    shares, log_own = shared(weight)
    one = matched(Gaussian(mean, root), shares, angles)
    if regimes.motions == 1:
        return Gaussian(one.mean.unsqueeze(-2), one.scale_tril.unsqueeze(-3)), log_own.unsqueeze(-1)
    mean, root, weight = (x[first:end].transpose(0, 1) for x in every)  # (before, others, now, ...)
    shares, log_others = shared(weight)
    rest = matched(Gaussian(mean, root), shares, angles)
    after = Gaussian(
        torch.cat([one.mean.unsqueeze(-2), rest.mean.movedim(0, -2)], -2),
        torch.cat([one.scale_tril.unsqueeze(-3), rest.scale_tril.movedim(0, -3)], -3),
    )
    return after, torch.cat([log_own.unsqueeze(-1), log_others.movedim(0, -1)], -1)


def together(beliefs: Gaussian, log_weights: Tensor, motion: Motion) -> Gaussian:
    """One Gaussian for hypotheses ``(2, ..., K)`` of states of a motion."""
    mean, root = beliefs.mean.movedim(-2, 0), beliefs.scale_tril.movedim(-3, 0)
    flat = Gaussian(mean.flatten(0, 1), root.flatten(0, 1))
    belief = moment_match(flat, log_weights.movedim(-1, 0).flatten(0, 1), motion.angles)
    return belief._replace(mean=motion.canonical(belief.mean))
