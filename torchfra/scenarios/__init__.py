"""The experiments: a motion, a sensor, a prior and the tracks to go with them."""

from torchfra.scenarios.base import Scenario, Tracks
from torchfra.scenarios.bearings import bearings_manoeuvre, bearings_outliers
from torchfra.scenarios.recorded import recorded

__all__ = ["Scenario", "Tracks", "bearings_manoeuvre", "bearings_outliers", "recorded"]
