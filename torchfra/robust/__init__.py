"""Robust updates: how a filter down-weights outlying innovations.

There are two kinds.  ``Weights`` (``Huber``, ``ThreeSegment``) divide the noise covariance of each element by a weight
from 1 (nominal noise) down to 0 (left out), followed by the plain update.  ``HuberScore`` and ``HuberRegression`` are
other updates.
"""

from torchfra.robust.base import Corrected, Robust
from torchfra.robust.regression import HuberRegression
from torchfra.robust.score import HuberScore
from torchfra.robust.weights import Huber, ThreeSegment, Weights

__all__ = [
    "Corrected",
    "Huber",
    "HuberRegression",
    "HuberScore",
    "Robust",
    "ThreeSegment",
    "Weights",
]
