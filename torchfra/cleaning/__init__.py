"""Cleans recorded tracks: a smoothed path, how sure it is, and what every fix was: an outlier, a manoeuvre or usual."""

from torchfra.cleaning.cleaned import Cleaned, Found, Segment

__all__ = ["Cleaned", "Found", "Segment"]
