"""Constant-gain filters."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Any

from torchfra import register
from torchfra.filters.alphabeta.bank import AlphaBetaBank
from torchfra.filters.alphabeta.gains import Gains
from torchfra.hyper import Value
from torchfra.motion.base import Motion
from torchfra.presets.learning import with_learning
from torchfra.sensors.base import Sensor

__all__ = ["alphabeta"]

_PAPER: dict[str, Any] = {"margin": 3.0, "hysteresis": 0.5, "dwell": 3.0, "onset": "shared", "confirm": False}
_TUNED: dict[str, Any] = {
    "manoeuvre": 3.5, "outlier": 18.0, "margin": 6.0, "hysteresis": 0.7, "dwell": 20.0, "level_shares": [0.25],
    "onset": "fastest", "confirm": True,
}  # fmt: skip
"""Defaults for levels of three gains, tuned on ``scenarios.level_then_weave``."""


@register.filter("alphabeta", words="switching constant gains", constant_gains=True)
def alphabeta(
    motion: Motion, sensor: Sensor, *, gains: Gains | None = None, manoeuvre: Value | None = None,
    outlier: Value | None = None, level_shares: Value | Sequence[float] | None = None, max_acceleration: Value = 60.0,
    margin: Value | None = None, hysteresis: Value | None = None, dwell: Value | None = None, votes: int = 2,
    patience: int = 5, max_gap: float = math.inf, warmup: int = 5, flag_on_reject: str = "raw",
    detect: str = "cartesian", onset: str | None = None, temperature: float = 0.0,
    initiation: str = "two-point", period: Value | None = None, confirm: bool | None = None,
    learn: Collection[str] = (),
) -> AlphaBetaBank:  # fmt: skip
    """Alpha-beta filters that switch with manoeuvres: the least computation of all presets.

    Source: Xu et al.; Kalata (1984) for the gains.

    With a motion of constant velocity it is the paper's.  With constant acceleration and without ``gains`` the fast
    levels have three gains, which extrapolate a manoeuvre over outliers, and the defaults are those in brackets.  All
    keywords but ``learn`` are those of ``filters.AlphaBetaBank``.

    Args:
        motion: constant velocity or constant acceleration.
        sensor: a ``Position``.
        gains: of the levels, the fastest first; ``torchfra.filters.alphabeta.gains.levels`` if None.
        manoeuvre: residual that raises a flag, in std; 3 times the slowest filter's own if None (3.5).
        outlier: residual that is rejected outside manoeuvres, in std; 3 times ``manoeuvre`` if None (18).
        level_shares: shares of ``manoeuvre`` that choose the level in a manoeuvre; evenly from 0.9 down if None
            (0.25).
        max_acceleration: largest acceleration of the target, m/s^2.
        margin: residual that is never rejected in a manoeuvre, in std; 3 if None (6).
        hysteresis: share of ``manoeuvre`` that raises a flag while in a manoeuvre; 0.5 if None (0.7).
        dwell: steps without a vote after which a manoeuvre ends; 3 if None (20).
        votes: flags before the newest one, even.
        patience: rejections in a row after which the filter restarts.
        max_gap: seconds without a used measurement after which the filter restarts.
        warmup: measurements before the first decision.
        flag_on_reject: flag of a rejected measurement: ``"raw"`` its own, or ``"hold"`` the vote.
        detect: in ``"cartesian"`` or ``"polar"`` coordinates.
        onset: a manoeuvre begins from the ``"shared"`` state or the ``"fastest"`` filter's; shared if None (fastest).
        temperature: 0 for hard choices, above for soft ones, to train by.
        initiation: from two measurements, ``"two-point"``, or the ``"prior"``.
        period: seconds between measurements for which the gains are designed.
        confirm: whether a start or restart needs a third measurement that fits; no if None (yes).
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.
    """
    chosen = {"manoeuvre": manoeuvre, "outlier": outlier, "level_shares": level_shares, "margin": margin,
              "hysteresis": hysteresis, "dwell": dwell, "onset": onset, "confirm": confirm}  # fmt: skip
    defaults = _TUNED if motion.orders == 3 and gains is None else _PAPER
    thresholds = defaults | {name: value for name, value in chosen.items() if value is not None}
    f = AlphaBetaBank(
        motion, sensor, gains, max_acceleration=max_acceleration, votes=votes, patience=patience, max_gap=max_gap,
        warmup=warmup, flag_on_reject=flag_on_reject, detect=detect, temperature=temperature,
        initiation=initiation, period=period, **thresholds,
    )  # fmt: skip
    return with_learning(f, learn)
