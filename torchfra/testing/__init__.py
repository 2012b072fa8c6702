"""Checks of a filter, or of a motion, a sensor or a weight of your own, for every property that filters have."""

from torchfra.testing.battery import Outcome, Report, check_filter
from torchfra.testing.case import CHECKS, Case
from torchfra.testing.models import ModelReport, check_model

__all__ = ["CHECKS", "Case", "ModelReport", "Outcome", "Report", "check_filter", "check_model"]
