"""Beliefs of states from those of what a sensor reads, and one belief for several hypotheses."""

from __future__ import annotations

from torch import Tensor

from torchfra.gaussian.mixture import moment_match
from torchfra.linalg.triangular import apply, hstack
from torchfra.types import Gaussian


def lifted(predicted: Gaussian, belief: Gaussian) -> Gaussian:
    """Beliefs of states, from the components that a sensor reads in units of their predicted root; any root."""
    mean, root = predicted
    gain = root[..., : belief.mean.shape[-1]]
    own = gain @ belief.scale_tril
    return Gaussian(mean + apply(gain, belief.mean), hstack(own, root[..., gain.shape[-1] :]))


def together(beliefs: Gaussian, log_weights: Tensor) -> Gaussian:
    """One Gaussian for hypotheses ``(2, ..., K)``."""
    mean, root = beliefs.mean.movedim(-2, 0), beliefs.scale_tril.movedim(-3, 0)
    return moment_match(Gaussian(mean.flatten(0, 1), root.flatten(0, 1)), log_weights.movedim(-1, 0).flatten(0, 1))


def log_share(log_weights: Tensor) -> Tensor:
    """The same, so that the exponentials sum to one over the first dimension."""
    return log_weights - log_weights.logsumexp(0)
