"""The measurement side: how a filter down-weights outlying innovations.

Two kinds.  ``Weights`` (``Huber``, ``ThreeSegment``) divide the noise of each element by a weight from 1 (trusted) down
to 0 (left out), and the update stays what it was.  ``HuberScore`` and ``HuberRegression`` make an update of their own.
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
