"""Records of steps, forwards and backwards, and what an estimate keeps of them."""

from __future__ import annotations

from typing import Any, NamedTuple

from torch import Tensor

from torchfra.gaussian.update import density
from torchfra.linalg.safe import safe_square
from torchfra.types import Estimate, Gaussian


class Record(NamedTuple):
    """One step; innovations in units of the measurement noise."""

    belief: Gaussian
    residual: Tensor | None
    """``(..., m)``; None once records of several steps are stacked."""
    root: Tensor
    """``(..., m, m)`` lower root of the residual's covariance."""
    normalised: Tensor
    """``(..., m)`` the residual divided by its root."""
    info: Any
    density: Tensor | None = None
    """``(...)`` log density of the residual, where it is not that of a Gaussian with this root."""
    evidence: Tensor | None = None
    """``(...)`` log density of the residual under the noise that the filter has assumed after down-weighting it."""
    past: Any = None
    """What the backward pass needs of the step, where an estimate does not hold it."""


class Kept(NamedTuple):
    """What an estimate holds of a step, before ``finish``."""

    belief: Gaussian
    nis: Tensor
    log_likelihood: Tensor
    info: Any
    past: Any = None
    """What smoothing needs of the step; None unless it was asked for."""


class Smoothed(NamedTuple):
    """Smoothed estimate of one step."""

    belief: Gaussian
    probabilities: Tensor | None = None
    outlier: Tensor | None = None
    repaired: Tensor | None = None


class SmoothInfo(NamedTuple):
    """``Estimate.info`` of a smoother."""

    filtered: Estimate
    """The filtered estimate."""
    probabilities: Tensor | None = None
    """``(..., T, K)`` of the models of a bank, or ``(..., T, R)`` of the regimes of ``GPB``."""
    outlier: Tensor | None = None
    """``(..., T, B)`` of each block of ``GPB`` that it was an outlier."""
    repaired: Tensor | None = None
    """``(..., T)`` bool, of rules with negative weights and motions that are not linear: the joint covariance of this
    state and the next was not positive definite and was repaired."""


class Past(NamedTuple):
    """What the backward pass needs of a step; ``(..., T, ...)`` of a whole track."""

    belief: Gaussian
    """The filtered belief, from which the next step was predicted."""
    factor: Tensor | None
    """``(...)`` fading factor of the prediction that led to it."""
    fresh: tuple[Gaussian, Tensor] | None = None
    """Both as of the step itself, of a filter that decides a step by the next one."""
    info: Any = None
    """``Estimate.info`` of the step, for a ``retreat`` that reads it."""


def scores(normalised: Tensor, root: Tensor, log_norm: Tensor, log_density: Tensor | None) -> tuple[Tensor, Tensor]:
    """Normalised innovation squared and log density ``(...)``, constants and the units of the noise included."""
    nis = safe_square(normalised).sum(-1)
    return nis, log_norm + (density(root, normalised) if log_density is None else log_density)
