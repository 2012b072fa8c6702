"""Tracking in a loop: times in, estimates out, in whatever order measurements come."""

from torchfra.stream.merging import Merged, merge
from torchfra.stream.tracker import Report, Tracker
from torchfra.stream.window import At

__all__ = ["At", "Merged", "Report", "Tracker", "merge"]
