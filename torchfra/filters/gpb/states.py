"""State, info and past of GPB."""

from __future__ import annotations

from typing import Any, NamedTuple

from torch import Tensor

from torchfra.filters.gpb.noise import NoiseScale
from torchfra.filters.gpb.regimes import Surprise
from torchfra.tree import Late
from torchfra.types import Alarm, Gaussian


class LastMeasurement(NamedTuple):
    """The measurement of a step, with which the next one is compared."""

    z: Tensor
    """``(..., m)``; 0 where missing."""
    measured: Tensor
    """``(..., m)`` 1 where measured and 0 where missing."""


class GPBState(NamedTuple):
    """State of GPB after a step.

    Over steps without any measurement, ``outlier`` and the first dimension of ``hypotheses`` and ``log_weights`` refer
    to the last step that had one.
    """

    belief: Gaussian
    """The estimate: the Gaussian with the moments of all hypotheses."""
    lagged: Gaussian
    """The one-step smoothed estimate of the step before: smoothed by the measurement of this step, if it has one."""
    hypotheses: Gaussian
    """``(..., 2, S)`` beliefs without and with an outlier in the measurement: each motion's, then separate levels'."""
    log_weights: Tensor
    """``(..., 2, R)`` logs of the joint probabilities of no outlier or some, and of the regime."""
    outlier: Tensor
    """``(..., B)`` probability that each block was an outlier, given that some block was."""
    unreliable: Tensor
    """``(..., 2, B)`` probability that each block's device is unreliable, without and with an outlier."""
    duration: Tensor
    """``(..., B)`` seconds, as in ``Alarm``."""
    doubt: Tensor
    """``(...)`` 1 until the first measurement, which may show that the prior is off, then halved by each; with targets
    whose first measurement is uncertain its mean."""
    widening: Tensor
    """``(...)`` factor of ``GPB.widening`` at the first measurement; 1 before, and from the fourth on."""
    unmeasured: Tensor
    """``(...)`` seconds since the last measurement; since the first step before there is one."""
    relaxation: Tensor | None = None
    """``(...)`` how far the Markov chain of outliers has returned to its stationary distribution since the last
    measurement: 0 at a measurement, 1 before the first.  None where outliers have no durations."""
    last: LastMeasurement | None = None
    """The measurement of the step; None without ``same_offset``."""
    noise: NoiseScale | None = None
    """What is known of the scale of each block's measurement noise; None where it is taken as stated."""


class GPBInfo(NamedTuple):
    """Per step and track."""

    filtered: Gaussian
    """``mean (..., T, n)`` and ``scale_tril``: the filtered estimate."""
    lagged: Gaussian
    """The one-step smoothed estimate, in the same shapes; it equals ``filtered`` where no step follows."""
    probabilities: Tensor
    """``(..., T, R)`` probabilities of the regimes: ``GPB.regime_names``."""
    outlier: Tensor
    """``(..., T, B)`` probability that each block is an outlier; 0 in a step without any measurement.  For a block that
    is missing among others it is the prediction of its Markov chain."""
    alarm: Alarm
    """Whether the sensor is faulty now, since when, and by how much."""
    noise: Tensor
    """``(..., T, B)`` learned variances of each block's measurement noise after the step, as multiples of the stated
    ones; 1 where the noise is taken as stated."""


class Step(NamedTuple):
    """The info of one step; ``lagged`` is of the step before."""

    lagged: Late
    probabilities: Tensor
    outlier: Tensor
    alarm: Alarm
    noise: Tensor


class GPBPast(NamedTuple):
    """The past of a step for the backward pass; ``(..., T, ...)`` for a whole track."""

    hypotheses: Gaussian
    """See ``GPBState``."""
    log_weights: Tensor
    """See ``GPBState``."""
    outlier: Tensor
    """See ``GPBState``."""
    unreliable: Tensor
    """See ``GPBState``."""
    surprise: Surprise
    """``(..., 2)`` how far the measurement was from its prediction, without and with an outlier in the one before."""
    widening: Tensor
    """``(...)`` factor on the covariance of an outlying prior: see ``GPB.widening``."""
    rarity: Tensor
    """``(..., 2, 2)`` logs of factors on the probabilities of outliers now and before: see ``GPB.outlying_rarity``."""
    measured: Tensor
    """``(...)`` 1 where the step has a measurement, else 0."""
    posterior: Tensor
    """``(..., 2, R, 2)`` logs of the probabilities of hypotheses: an outlier now, the regime, an outlier before."""
    unmeasured: Tensor
    """See ``GPBState``."""
    relaxation: Tensor | None = None
    """See ``GPBState``."""
    log_same_offset: Tensor | None = None
    """``(..., R)`` log likelihood ratio of outliers after an outlier, with and without ``same_offset``."""

    def of_next(self) -> GPBPast:
        """As in ``records.Past``: of the next step all that is no belief and not what is merged from it."""
        none: Any = None  # ``retreat`` reads no others
        kept = self.surprise, self.widening, self.rarity, self.measured, self.posterior
        return GPBPast(none, none, none, none, *kept, none, None, self.log_same_offset)
