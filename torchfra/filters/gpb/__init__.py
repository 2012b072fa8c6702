"""GPB: in every step, regimes of the motion and outliers of the measurement are hypotheses."""

from torchfra.filters.gpb.filter import GPB
from torchfra.filters.gpb.noise import LearnedNoise
from torchfra.filters.gpb.outliers import Outliers
from torchfra.filters.gpb.regimes import Regimes
from torchfra.filters.gpb.states import GPBInfo, GPBState

__all__ = ["GPB", "GPBInfo", "GPBState", "LearnedNoise", "Outliers", "Regimes"]
