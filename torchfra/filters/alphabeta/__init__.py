"""Constant-gain filters: design of gains, a single filter, and a bank that switches."""

from torchfra.filters.alphabeta.axes import AlphaBeta, AlphaBetaState
from torchfra.filters.alphabeta.bank import AlphaBetaBank, AlphaBetaBankState, AlphaBetaInfo
from torchfra.filters.alphabeta.gains import Gains

__all__ = [
    "AlphaBeta",
    "AlphaBetaBank",
    "AlphaBetaBankState",
    "AlphaBetaInfo",
    "AlphaBetaState",
    "Gains",
]
