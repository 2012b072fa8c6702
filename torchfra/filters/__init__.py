"""The filters themselves; ``torchfra.presets`` has them ready made."""

from typing import TYPE_CHECKING

from torchfra.loading import when_named

if TYPE_CHECKING:  # isort: off
    from torchfra.filters.alphabeta import AlphaBeta as AlphaBeta
    from torchfra.filters.alphabeta.bank import AlphaBetaBank as AlphaBetaBank, AlphaBetaInfo as AlphaBetaInfo
    from torchfra.filters.base import Filter as Filter
    from torchfra.filters.biases import biased_copies as biased_copies, considered as considered
    from torchfra.filters.fixed_lag import FixedLag as FixedLag, FixedLagState as FixedLagState
    from torchfra.filters.forecast import Forecast as Forecast
    from torchfra.filters.fra import FRA as FRA, FRAInfo as FRAInfo, FRAState as FRAState
    from torchfra.filters.gpb import (
        GPB as GPB,
        GPBInfo as GPBInfo,
        GPBState as GPBState,
        Outliers as Outliers,
        Regimes as Regimes,
    )
    from torchfra.filters.imm import IMM as IMM, IMMInfo as IMMInfo
    from torchfra.filters.interaction import IMMState as IMMState
    from torchfra.filters.likely_models import LikelyModels as LikelyModels
    from torchfra.filters.protection import protection_level as protection_level
    from torchfra.filters.scans.jpda import JPDA as JPDA
    from torchfra.filters.scans.scan import JPDAInfo as JPDAInfo, JPDAState as JPDAState
    from torchfra.filters.srckf import SRCKF as SRCKF, Info as Info, State as State
    from torchfra.steps.records import Record as Record, Smoothed as Smoothed, SmoothInfo as SmoothInfo
else:
    __all__, __getattr__, __dir__ = when_named(__name__, {
        "filters.alphabeta": "AlphaBeta",
        "filters.alphabeta.bank": "AlphaBetaBank AlphaBetaInfo",
        "filters.base": "Filter",
        "filters.biases": "biased_copies considered",
        "filters.fixed_lag": "FixedLag FixedLagState",
        "filters.forecast": "Forecast",
        "filters.fra": "FRA FRAInfo FRAState",
        "filters.gpb": "GPB GPBInfo GPBState Outliers Regimes",
        "filters.imm": "IMM IMMInfo",
        "filters.interaction": "IMMState",
        "filters.likely_models": "LikelyModels",
        "filters.protection": "protection_level",
        "filters.scans.jpda": "JPDA",
        "filters.scans.scan": "JPDAInfo JPDAState",
        "filters.srckf": "SRCKF Info State",
        "steps.records": "Record Smoothed SmoothInfo",
    })  # fmt: skip
