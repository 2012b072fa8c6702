"""Constant-gain filters."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, TypedDict

from typing_extensions import Unpack

from torchfra.filters.alphabeta.bank import AlphaBetaBank
from torchfra.filters.alphabeta.gains import Gains
from torchfra.hyper import Value
from torchfra.motion.base import Motion
from torchfra.presets.preset import preset
from torchfra.sensors.base import Sensor

_PAPER: dict[str, Any] = {"margin": 3.0, "hysteresis": 0.5, "dwell": 3.0, "onset": "shared", "confirm": False}
_TUNED: dict[str, Any] = {
    "manoeuvre": 3.5, "outlier": 18.0, "margin": 6.0, "hysteresis": 0.7, "dwell": 20.0, "level_shares": [0.25],
    "onset": "fastest", "confirm": True,
}  # fmt: skip
"""Defaults for levels of three gains, tuned on ``scenarios.level_then_weave``."""


class LevelsOptions(TypedDict, total=False):
    """Of the bank of levels: ``filters.AlphaBetaBank``; defaults for levels of three gains are in brackets.

    gains: of the levels, the fastest first; ``torchfra.filters.alphabeta.gains.levels`` if not given.
    manoeuvre: residual that raises a flag, in std; 3 times the slowest filter's own if not given (3.5).
    outlier: residual that is rejected outside manoeuvres, in std; 3 times ``manoeuvre`` if not given (18).
    level_shares: shares of ``manoeuvre`` that choose the level in a manoeuvre; evenly from 0.9 down if not given
        (0.25).
    max_acceleration: largest acceleration of the target, m/s^2; 60 if not given.
    margin: residual that is never rejected in a manoeuvre, in std; 3 if not given (6).
    hysteresis: share of ``manoeuvre`` that raises a flag while in a manoeuvre; 0.5 if not given (0.7).
    dwell: steps without a vote after which a manoeuvre ends; 3 if not given (20).
    max_gap: seconds without a used measurement after which the filter restarts; never if not given.
    detect: in ``"cartesian"`` (if not given) or ``"polar"`` coordinates.
    onset: a manoeuvre begins from the ``"shared"`` state (if not given) or the ``"fastest"`` filter's (fastest).
    temperature: 0, if not given, for hard choices, above for soft ones, to train by.
    period: seconds between measurements for which the gains are designed.
    confirm: whether a start or restart needs a third measurement that fits; no if not given (yes).
    """

    gains: Gains | None
    manoeuvre: Value | None
    outlier: Value | None
    level_shares: Value | Sequence[float] | None
    max_acceleration: Value
    margin: Value | None
    hysteresis: Value | None
    dwell: Value | None
    max_gap: float
    detect: str
    onset: str | None
    temperature: float
    period: Value | None
    confirm: bool | None


@preset("alphabeta", LevelsOptions, words="switching constant gains", constant_gains=True)
def alphabeta(
    motion: Motion, sensor: Sensor, *, learn: Collection[str] = (), **options: Unpack[LevelsOptions]
) -> AlphaBetaBank:
    """Alpha-beta filters that switch with manoeuvres: the least computation of all presets.

    Source: Xu et al.; Kalata (1984) for the gains.

    With a motion of constant velocity it is the paper's.  With constant acceleration and without ``gains`` the fast
    levels have three gains, which extrapolate a manoeuvre over outliers, and the defaults are those in brackets.

    Args:
        motion: constant velocity or constant acceleration.
        sensor: a ``Position``.
        **options
    """
    given = {name: value for name, value in options.items() if value is not None}
    defaults = _TUNED if motion.orders == 3 and "gains" not in given else _PAPER
    return AlphaBetaBank(motion, sensor, **defaults | given)
