"""The filters themselves; ``torchfra.presets`` has them ready made."""

from torchfra.filters.base import Filter
from torchfra.filters.feedback import FRA, FRAInfo, FRAState
from torchfra.filters.srckf import SRCKF, Info, State

__all__ = ["FRA", "SRCKF", "FRAInfo", "FRAState", "Filter", "Info", "State"]
