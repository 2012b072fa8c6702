"""Try a filter, or a motion, a sensor or a weight of your own, on everything that filters promise."""

from torchfra.testing.battery import Outcome, Report, check_filter
from torchfra.testing.case import CHECKS, Case

__all__ = ["CHECKS", "Case", "Outcome", "Report", "check_filter"]
