"""The tuples that all packages share, the letters of shapes, and the vocabulary.

Shapes: ``...`` any batch, ``T`` time, ``n`` state, ``m`` measurement, ``k`` inputs of the models at a step, ``d`` the
leading state components that a sensor reads, ``p`` points of a rule, ``r`` columns of a root, ``H`` hypotheses,
``K`` motions of a bank, ``N`` targets, ``J`` measurements of a scan, ``R`` regimes, ``B`` blocks of a sensor.
Batch first, time before the vector, no trailing-one columns; SI units and radians.  A NaN in a measurement is missing
data.

Words:

- belief: a Gaussian over states; prior: before the first step; prediction: after the motion, before the measurement.
- root: a matrix ``A`` with ``P = A A^T``; the lower root is triangular.
- process noise: what the motion adds to the uncertainty of a state; root ``S_Q``.
- measurement noise: of the sensor; ``std`` per element, or ``noise``, a root ``S_R``, where elements are correlated.
- nominal: the measurement noise that the sensor states; estimated: that of a filter's noise estimate.
- whitened: in units of the measurement noise, whose covariance is then the identity.
- innovation: measured minus predicted; NIS: its normalised square; NEES: that of the estimation error.
- weight: divides the noise covariance of an element, from 1 (nominal noise) down to 0 (left out).
- fading factor: multiplies the propagated covariance ``F P F^T``.
- threshold: standard deviations from which on Huber's weights fall; gate: NIS above which a step is abnormal, or
  the region around its prediction in which a target's measurement may lie.
- outlier mode: whether a measurement is an inlier, of nominal noise, or an outlier, of larger noise.
- regime: how a target moves in a step: a motion of a bank, a level of process noise, a manoeuvre or a jump.
- filtered: given the measurements up to a step; smoothed: given later ones too; lagged: given those of a fixed lag.
- repaired: a covariance that was not positive definite and was made so; counted, never silent.
- diverged: a track whose error has passed a limit; failed: one that holds NaN or infinity; lost: one that has missed
  too many scans in a row.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple

from numpy.typing import ArrayLike
from torch import Tensor

from torchfra.linalg.batches import broadcast_shapes
from torchfra.linalg.covariance import covariance_root
from torchfra.numbers import as_numbers
from torchfra.tree import event_ranks


@event_ranks(mean=1, scale_tril=2)
class Gaussian(NamedTuple):
    """A belief: ``mean (..., n)`` and ``scale_tril (..., n, n)``, the lower root of the covariance."""

    mean: Tensor
    scale_tril: Tensor

    @property
    def covariance(self) -> Tensor:
        """``P (..., n, n) = scale_tril @ scale_tril.mT``."""
        return self.scale_tril @ self.scale_tril.mT

    @property
    def failed(self) -> Tensor:
        """``(...)`` bool, where it has NaN or infinity: ``state.belief.failed`` after a step that has failed."""
        return ~(self.mean.isfinite().all(-1) & self.scale_tril.isfinite().flatten(-2).all(-1))

    @classmethod
    def from_covariance(cls, mean: ArrayLike, covariance: ArrayLike) -> Gaussian:
        """The belief of this mean ``(..., n)`` and covariance ``(..., n, n)``, of any rank.

        What is known has variance 0.  Both may be tensors, arrays or lists.

        Raises:
            ValueError: no numbers, a covariance that is not positive semidefinite, or shapes that do not fit.

        Example:
            >>> torchfra.Gaussian.from_covariance([0.0, 5.0], [[4, 0], [0, 0]]).scale_tril
            tensor([[2., 0.],
                    [0., 0.]], dtype=torch.float64)
        """
        mean, covariance = as_numbers(mean, "mean"), as_numbers(covariance, "covariance")
        if mean.dim() < 1 or covariance.shape[-2:] != mean.shape[-1:] * 2:
            received = f"{tuple(mean.shape)} and {tuple(covariance.shape)}"
            raise ValueError(f"mean, covariance: expected (..., n) and (..., n, n), received {received}")
        return cls(mean, covariance_root(covariance).to(mean))

    @classmethod
    def from_std(cls, mean: ArrayLike, std: ArrayLike) -> Gaussian:
        """The belief of this mean ``(..., n)`` and standard deviations ``(..., n)``, or one for all components.

        The components are independent; what is known has 0.  Both may be tensors, arrays or lists.

        Raises:
            ValueError: no numbers, standard deviations below 0 or not finite, or shapes that do not fit.

        Example:
            >>> torchfra.Gaussian.from_std([0.0, 5.0], [2.0, 0.0]).scale_tril
            tensor([[2., 0.],
                    [0., 0.]], dtype=torch.float64)
        """
        mean, std = as_numbers(mean, "mean"), as_numbers(std, "std")
        if mean.dim() < 1 or (std.dim() and std.shape[-1] != mean.shape[-1]):
            received = f"{tuple(mean.shape)} and {tuple(std.shape)}"
            raise ValueError(f"mean, std: expected (..., n) and (..., n) or a number, received {received}")
        if not bool(((std >= 0) & std.isfinite()).all()):
            raise ValueError(f"std: expected finite numbers of 0 or more, received {std.tolist()}")
        batch = broadcast_shapes(mean.shape[:-1], std.shape[:-1])
        return cls(mean, std.to(mean).expand(*batch, mean.shape[-1]).diag_embed())


@event_ranks(spread=2, process_noise=2, repaired=0)
class Prediction(NamedTuple):
    """A belief propagated over one step, and its parts: ``P = spread spread^T + process_noise process_noise^T``.

    For rules with negative weights a further part is subtracted in ``belief``.
    """

    belief: Gaussian
    spread: Tensor
    """``(..., n, r)`` root of the propagated covariance, F P F^T."""
    process_noise: Tensor
    """``(..., n, r)`` root of the process noise."""
    repaired: Tensor | None = None
    """``(...)`` bool, for a rule with negative weights: the covariance was not positive definite and was repaired."""


@event_ranks(probability=1, duration=1, offset=1)
class Alarm(NamedTuple):
    """Whether a sensor is faulty now, since when, and by how much."""

    probability: Tensor
    """``(..., B)`` probability that each block of its elements is faulty; over steps without a measurement that of the
    last measurement, or its prediction by a Markov chain in continuous time."""
    duration: Tensor
    """``(..., B)`` seconds since the first of successive measurements that are more likely wrong than right; 0 at the
    first, and if the last measurement is more likely right."""
    offset: Tensor
    """``(..., m)`` measurement minus that of the estimate after it, in the measurement's units, angles wrapped; 0 where
    missing."""


@event_ranks(residual=1, spread=2, subtracted=2)
class Whitened(NamedTuple):
    """A measurement compared with its prediction, in units of the measurement noise, whose covariance is the identity.

    Values of a missing element are zero, so that it changes nothing.
    """

    residual: Tensor
    """``(..., m)`` measured minus predicted."""
    spread: Tensor
    """``(..., m, r + d)`` root of the covariance of the predicted measurement without its noise: ``[rest, H S]``."""
    reads: int
    """``d``, the number of columns of ``H S``, the last ones of ``spread``."""
    subtracted: Tensor | None = None
    """``(..., m, k)`` root of what a rule with negative weights subtracts from that covariance."""

    @property
    def slope(self) -> Tensor:
        """``H S (..., m, d)``."""
        return self.spread[..., self.spread.shape[-1] - self.reads :]

    @property
    def rest(self) -> Tensor:
        """``(..., m, r)``: root of the part that is uncorrelated with the belief."""
        return self.spread[..., : self.spread.shape[-1] - self.reads]


class Innovation(NamedTuple):
    """A measurement compared with its prediction, in the measurement's own units."""

    residual: Tensor
    """``(..., m)`` measured minus predicted, angles wrapped; 0 where missing."""
    scale_tril: Tensor
    """``(..., m, m)`` lower root of its covariance under the nominal noise."""
    nis: Tensor
    """``(...)`` normalised innovation squared, of the elements that were measured."""
    log_likelihood: Tensor
    """``(...)`` log density of the elements that were measured."""
    alarm: Alarm | None = None
    """Whether the sensor is faulty; None of filters that do not detect it."""


class Cause(IntEnum):
    """Why a track has failed."""

    NONE = 0
    """It has not failed."""
    PRIOR = 1
    """Its prior holds NaN or infinity."""
    MEASUREMENT = 2
    """A measurement is infinite."""
    INPUT = 3
    """``u`` holds NaN or infinity."""
    VALUE = 4
    """A hyperparameter of the filter is NaN, or infinitely far out of its range."""
    ARITHMETIC = 5
    """None of these: numbers have overflowed."""


@event_ranks(step=0, cause=0)
class Failure(NamedTuple):
    """When and why tracks have failed."""

    step: Tensor
    """``(...)`` the first step with NaN or infinity, counted from 0; -1 for tracks that have not failed."""
    cause: Tensor
    """``(...)`` the number of a ``Cause``."""
    values: tuple[str, ...] = ()
    """Paths of the hyperparameters that are to blame for a ``Cause.VALUE``."""

    def describe(self) -> list[str]:
        """One line for each track that has failed; of a hyperparameter it has the path."""
        failed = self.step >= 0
        each = zip(failed.nonzero().tolist(), self.step[failed].tolist(), self.cause[failed].tolist(), strict=True)
        lines = []
        for track, step, cause in each:
            names = f" {', '.join(self.values)}" if cause == Cause.VALUE and self.values else ""
            lines.append(f"track {tuple(track)}: {Cause(cause).name.lower()}{names}, step {step}")
        return lines


class Estimate(NamedTuple):
    """A whole track, filtered."""

    mean: Tensor
    """``(..., T, n)``."""
    scale_tril: Tensor
    """``(..., T, n, n)`` lower root of the covariance."""
    nis: Tensor
    """``(..., T)`` normalised innovation squared (nominal noise, measured elements)."""
    log_likelihood: Tensor
    """``(..., T)`` log density of the innovation (nominal noise, measured elements)."""
    info: Any
    """Further results of the filter, a tuple of ``(..., T, ...)`` tensors: see the filter."""
    failure: Failure | None = None
    """Steps and causes of failed tracks; None for an estimate that no filter has made."""
    past: Any = ()
    """The past for the backward pass, after ``forward(past=True)``: see ``smooth(estimate=)``."""

    @property
    def covariance(self) -> Tensor:
        """``P (..., T, n, n)``."""
        return self.scale_tril @ self.scale_tril.mT

    @property
    def failed(self) -> Tensor:
        """``(...)`` True for each track with NaN or infinity at some step; ``failure`` has the step and the cause."""
        return Gaussian(self.mean, self.scale_tril).failed.any(-1)


Fallback = Callable[[str, str], None]
"""Called with the name of a filter that has no kernel, and the reason."""


class CompileError(RuntimeError):
    """A kernel is needed and cannot be compiled: there is no compiler, or it failed."""
