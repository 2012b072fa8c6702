"""Records of steps of the forward and the backward pass, and the parts of them that an estimate keeps."""

from __future__ import annotations

from typing import Any, NamedTuple

from torch import Tensor

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
    """``(...)`` log density of the residual, if it is not that of a Gaussian with this root."""
    evidence: Tensor | None = None
    """``(...)`` log density of the residual under the down-weighted noise of a robust filter."""
    past: Any = None
    """The parts of the step that the backward pass needs and an estimate does not hold."""


class Kept(NamedTuple):
    """The parts of a step that an estimate holds, before ``finish``."""

    belief: Gaussian
    nis: Tensor
    log_likelihood: Tensor
    info: Any
    past: Any = None
    """``Record.past``; None unless it is to be kept."""


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
    """``(..., T, B)`` probability of ``GPB`` that each block was an outlier."""
    repaired: Tensor | None = None
    """``(..., T)`` bool, for rules with negative weights and nonlinear motions: the joint covariance of this state and
    the next was not positive definite and was repaired."""


class Past(NamedTuple):
    """The parts of a step that the backward pass needs; ``(..., T, ...)`` for a whole track."""

    belief: Gaussian
    """The filtered belief, from which the next step was predicted."""
    factor: Tensor | None
    """``(...)`` fading factor of the prediction that led to it."""
    provisional: tuple[Gaussian, Tensor] | None = None
    """Belief and factor before the next measurement, for a filter that decides a step by the next one."""
    info: Any = None
    """``Estimate.info`` of the step, for a ``retreat`` that reads it."""

    def undecided(self) -> Past:
        """The past of a step before the next measurement has decided its estimate."""
        return self if self.provisional is None else Past(*self.provisional)

    def decided(self) -> Past:
        """The past of a step whose estimate no later measurement can decide."""
        return self._replace(provisional=None)

    def of_next(self) -> Past:
        """The part of the next step's past that ``retreat`` reads, here the fading factor; all else is None."""
        return self._replace(belief=None, provisional=None)  # type: ignore[arg-type]  # ``retreat`` reads no belief
