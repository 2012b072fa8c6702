"""What smoothing says."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from torchfra.filters.records import Smoothed
from torchfra.gaussian.inputs import BackwardStep as BackwardStep
from torchfra.types import Estimate

Told = Smoothed


class SmoothInfo(NamedTuple):
    """What a smoother says besides its beliefs."""

    filtered: Estimate
    """What the filter said on its way forward."""
    probabilities: Tensor | None = None
    """``(..., T, K)`` of the models of a bank, or ``(..., T, R)`` of the regimes of ``GPB``."""
    outlier: Tensor | None = None
    """``(..., T, B)`` of each block of ``GPB`` that it was an outlier."""
    repaired: Tensor | None = None
    """``(..., T)`` bool, of rules with negative weights and motions that are not linear: the joint covariance of this
    state and the next was not positive definite and was repaired."""
