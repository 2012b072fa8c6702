"""What GPB knows after a step, and what it tells of it."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from torchfra.tree import Late
from torchfra.types import Gaussian


class GPBState(NamedTuple):
    """What GPB knows after a step.

    Over steps without any measurement ``clean``, ``dirty`` and ``outlier`` are of the last one that had some.
    """

    belief: Gaussian
    """All hypotheses together."""
    settled: Gaussian
    """Of the step before, now that its hypotheses have met the measurement of this one, if there is any."""
    clean: Gaussian
    """``(..., K)`` for each motion, if no block was an outlier."""
    dirty: Gaussian
    """``(..., K)`` for each motion, if one was."""
    log_weights: Tensor
    """``(..., 2, R)`` logs of the probabilities of clean and dirty, and of the regimes."""
    outlier: Tensor
    """``(..., B)`` of each block that it was an outlier, if the step was dirty."""


class GPBInfo(NamedTuple):
    """Per step and track."""

    filtered: Gaussian
    """``mean (..., T, n)`` and ``scale_tril``: what was known at the step itself."""
    settled: Gaussian
    """The same, with the step's hypotheses weighed by the next step's measurement; as filtered where there is none."""
    regimes: Tensor
    """``(..., T, R)`` probabilities of the regimes."""
    outlier: Tensor
    """``(..., T, B)`` of each block that it is an outlier; 0 where nothing is measured in a step.  Of a block that is
    missing among others it is what its Markov chain says."""


class Shares(NamedTuple):
    """What the mixed belief of each motion is made of, ``(2, ..., K)``."""

    own: Tensor
    """Of its own."""
    common: Tensor
    """Of the one that regimes drawn anew share."""
    origin: Tensor
    """Of the share that each motion has in that one."""


class Step(NamedTuple):
    """What one step knows: about itself, and now for good about the one before."""

    settled: Late
    regimes: Tensor
    outlier: Tensor
