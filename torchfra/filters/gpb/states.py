"""What GPB knows after a step, and what it says of it."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from torchfra.tree import Late
from torchfra.types import Alarm, Gaussian


class GPBState(NamedTuple):
    """What GPB knows after a step.

    Over steps without any measurement ``outlier`` and the first dimension of ``hypotheses`` and ``log_weights`` are of
    the last one that had some.
    """

    belief: Gaussian
    """All hypotheses together."""
    lagged: Gaussian
    """Of the step before, now that its hypotheses have met the measurement of this one, if there is any."""
    hypotheses: Gaussian
    """``(..., 2, K)`` without and with an outlier in the measurement, for each motion."""
    log_weights: Tensor
    """``(..., 2, R)`` logs of the probabilities of that, and of the regimes."""
    outlier: Tensor
    """``(..., B)`` probability of each block that it was an outlier, if any was."""
    lasted: Tensor
    """``(..., B)`` seconds, as in ``Alarm``."""
    forgotten: Tensor | None = None
    """``(...)`` how far the last measurement says nothing of outliers any more, where they have durations: from 0 at a
    measurement to 1, as before the first."""


class GPBInfo(NamedTuple):
    """Per step and track."""

    filtered: Gaussian
    """``mean (..., T, n)`` and ``scale_tril``: what was known at the step itself."""
    lagged: Gaussian
    """The same, with the step's hypotheses weighed by the next step's measurement; as filtered where there is none."""
    regimes: Tensor
    """``(..., T, R)`` probabilities of the regimes."""
    outlier: Tensor
    """``(..., T, B)`` of each block that it is an outlier; 0 where nothing is measured in a step.  Of a block that is
    missing among others it is what its Markov chain says."""
    alarm: Alarm
    """Whether the sensor is faulty now, since when, and by how much."""


class Step(NamedTuple):
    """What one step says: of itself, and now for good of the one before."""

    lagged: Late
    regimes: Tensor
    outlier: Tensor
    alarm: Alarm


class GPBPast(NamedTuple):
    """What smoothing needs of a step; ``(..., T, ...)`` of a whole track."""

    hypotheses: Gaussian
    """As in ``GPBState``."""
    log_weights: Tensor
    """As in ``GPBState``."""
    outlier: Tensor
    """As in ``GPBState``."""
    nis: Tensor
    """``(..., 2)`` normalised innovation squared per element of the agile level, without and with an outlier before."""
    measured: Tensor
    """``(...)`` 1 where anything was, else 0."""
    forgotten: Tensor | None = None
    """As in ``GPBState``."""
