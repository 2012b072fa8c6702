"""Records of steps of the forward and the backward pass, and what is made of them."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

from torch import Tensor

from torchfra import tree
from torchfra.gaussian.update import density
from torchfra.linalg.safe import safe_square
from torchfra.sensors.base import MeasurementNoise
from torchfra.types import Estimate, Gaussian, Innovation

T = TypeVar("T")  # a past


class Record(NamedTuple):
    """One step; residual and root are in units of the measurement noise, of a scan in the measurement's own."""

    belief: Gaussian
    residual: Tensor | None
    """``(..., m)``; None once records of several steps are stacked."""
    root: Tensor
    """``(..., m, m)`` lower root of the residual's covariance."""
    normalised: Tensor
    """``(..., m)`` the residual divided by its root."""
    info: Any
    density: Tensor | None = None
    """``(...)`` log density of the measurement, in its own units, if it is not that of a Gaussian with this root."""
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


def scores(record: Record, log_norm: Tensor) -> tuple[Tensor, Tensor]:
    """Normalised innovation squared and log density ``(...)`` of a step, or of several that are stacked.

    ``log_norm (...)`` has the constants of the density, and the units of the measurement noise.
    """
    nis, log_density = safe_square(record.normalised).sum(-1), record.density
    return nis, log_norm + density(record.root, record.normalised) if log_density is None else log_density


def kept(record: Record, log_norm: Tensor) -> Kept:
    """The parts of a step, or of several that are stacked, that an estimate and the backward pass need."""
    return Kept(record.belief, *scores(record, log_norm), record.info, record.past)


def innovation(record: Record, noise: MeasurementNoise, *, scans: bool) -> Innovation:
    """The innovation of a step, in the units of the measurement, as that of ``scans`` is already; and its alarm."""
    residual, root = record.residual, record.root
    assert residual is not None
    if not scans:
        residual, root = noise.colour(residual.unsqueeze(-1)).squeeze(-1), noise.colour(root)
    return Innovation(residual, root, *scores(record, noise.log_norm), getattr(record.info, "alarm", None))


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

    def of_next(self) -> Past:
        """The part of the next step's past that ``retreat`` reads, here the fading factor; all else is None."""
        return self._replace(belief=None, provisional=None)  # type: ignore[arg-type]  # ``retreat`` reads no belief


def undecided(past: T) -> T:
    """The past of a step before the next measurement has decided its estimate; the same where nothing is open."""
    return tree.map_parts(lambda x: x if x.provisional is None else Past(*x.provisional), past, Past)


def decided(past: T) -> T:
    """The past of a step whose estimate no later measurement can decide."""
    return tree.map_parts(lambda x: x if x.provisional is None else x._replace(provisional=None), past, Past)
