"""The filters themselves; ``torchfra.presets`` has them ready made."""

from torchfra.filters.alphabeta import AlphaBeta
from torchfra.filters.alphabeta.bank import AlphaBetaBank, AlphaBetaInfo
from torchfra.filters.base import Filter
from torchfra.filters.considered import biased_copies, considered
from torchfra.filters.fixed_lag import FixedLag, FixedLagState
from torchfra.filters.forecast import Forecast
from torchfra.filters.fra import FRA, FRAInfo, FRAState
from torchfra.filters.gpb import GPB, GPBInfo, GPBState, Outliers, Regimes
from torchfra.filters.imm import IMM, IMMInfo, IMMState
from torchfra.filters.likely_models import LikelyModels
from torchfra.filters.protection import protection_level
from torchfra.filters.scans.jpda import JPDA
from torchfra.filters.scans.scan import JPDAInfo, JPDAState
from torchfra.filters.srckf import SRCKF, Info, State
from torchfra.steps.records import Record, Smoothed, SmoothInfo

__all__ = [
    "FRA",
    "GPB",
    "IMM",
    "JPDA",
    "SRCKF",
    "AlphaBeta",
    "AlphaBetaBank",
    "AlphaBetaInfo",
    "FRAInfo",
    "FRAState",
    "Filter",
    "FixedLag",
    "FixedLagState",
    "Forecast",
    "GPBInfo",
    "GPBState",
    "IMMInfo",
    "IMMState",
    "Info",
    "JPDAInfo",
    "JPDAState",
    "LikelyModels",
    "Outliers",
    "Record",
    "Regimes",
    "SmoothInfo",
    "Smoothed",
    "State",
    "biased_copies",
    "considered",
    "protection_level",
]
