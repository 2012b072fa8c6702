"""GPB: regimes of the motion and qualities of the measurement as hypotheses of every step."""

from torchfra.filters.gpb.filter import GPB, GPBInfo, GPBState
from torchfra.filters.gpb.qualities import Qualities
from torchfra.filters.gpb.regimes import Regimes

__all__ = ["GPB", "GPBInfo", "GPBState", "Qualities", "Regimes"]
