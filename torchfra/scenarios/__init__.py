"""Experiments: a motion, a sensor, a prior, and tracks."""

from torchfra.scenarios.adsb import adsb_models, adsb_turns
from torchfra.scenarios.as_stated import as_stated
from torchfra.scenarios.base import Scenario, Tracks, of_tracks
from torchfra.scenarios.bearings import bearings_manoeuvre, bearings_outliers
from torchfra.scenarios.bounds import Bound, bound
from torchfra.scenarios.clutter import clutter_crossing, clutter_straight, noise_change
from torchfra.scenarios.clutter_many import clutter_many
from torchfra.scenarios.growth import growth
from torchfra.scenarios.harbour import Harbour, harbour
from torchfra.scenarios.law import Law
from torchfra.scenarios.ranges import ranges_outliers
from torchfra.scenarios.recorded import recorded
from torchfra.scenarios.recorded_ranges import recorded_ranges
from torchfra.scenarios.reentry import reentry
from torchfra.scenarios.weave import level_then_weave

__all__ = [
    "Bound",
    "Harbour",
    "Law",
    "Scenario",
    "Tracks",
    "adsb_models",
    "adsb_turns",
    "as_stated",
    "bearings_manoeuvre",
    "bearings_outliers",
    "bound",
    "clutter_crossing",
    "clutter_many",
    "clutter_straight",
    "growth",
    "harbour",
    "level_then_weave",
    "noise_change",
    "of_tracks",
    "ranges_outliers",
    "recorded",
    "recorded_ranges",
    "reentry",
]
