"""GPB: regimes of the motion and qualities of the measurement as hypotheses of every step."""

from torchfra.filters.gpb.filter import GPB
from torchfra.filters.gpb.qualities import Qualities
from torchfra.filters.gpb.regimes import Regimes
from torchfra.filters.gpb.states import GPBInfo, GPBState

__all__ = ["GPB", "GPBInfo", "GPBState", "Qualities", "Regimes"]
