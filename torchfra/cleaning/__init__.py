"""Cleans recorded tracks: a smoothed path, how sure it is, and what every fix was: an outlier, a manoeuvre or usual."""

from torchfra.cleaning.cleaned import Cleaned, Found, Segment
from torchfra.cleaning.core import DEFAULT, check_settings, clean_tracks
from torchfra.cleaning.flags import GATE

__all__ = ["DEFAULT", "GATE", "Cleaned", "Found", "Segment", "check_settings", "clean_tracks"]
