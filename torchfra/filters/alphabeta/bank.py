"""A bank of alpha-beta filters that switches with the manoeuvre, rejects outliers and restarts."""

from __future__ import annotations

import math
from functools import reduce

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra.filters.alphabeta import gains as design
from torchfra.filters.alphabeta.axes import (
    residual_spread,
    root_ahead,
    root_rows,
    root_spreads,
    two_gain_root,
)
from torchfra.filters.alphabeta.base import record
from torchfra.filters.alphabeta.gains import Gains
from torchfra.filters.alphabeta.levels import all_stable, one_level
from torchfra.filters.alphabeta.memory import (
    AlphaBetaBankState,
    AlphaBetaInfo,
    Earlier,
    OutlierTest,
    Vote,
    remember,
)
from torchfra.filters.alphabeta.updates import Updates
from torchfra.filters.base import Mix
from torchfra.filters.records import Record
from torchfra.gaussian.inputs import Frame
from torchfra.hyper import Hyper, Value, one_of
from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian


class AlphaBetaBank(Updates):
    """Alpha-beta filters that share one state, of which the data choose the gains: the slow ones for straight flight.

    A residual above ``manoeuvre`` raises a flag, a majority of the last flags votes for a manoeuvre.  Without one, a
    residual beyond ``outlier`` is rejected and the track extrapolated; in one, only what is out of the target's reach
    is.  After too many rejections the filter restarts from the last two measurements.

    ``Estimate.scale_tril`` is that of the errors which the prior and the measurement noise of the sensor leave under
    the gains that were used: it grows while nothing is measured or used.  What a manoeuvre adds is not in it.

    All choices are hard.  With a ``temperature`` they are soft, for training: each comparison becomes a sigmoid (in
    units of its threshold), and gains are mixed.  ``f.temperature = 0`` makes a trained filter hard; restarts are
    always hard.

    Args:
        motion: constant velocity, or acceleration for levels with three gains (with two it stays 0); only its
            dimensions and orders count.
        sensor: a ``Position``; its std is the unit of the thresholds.
        gains: of the levels, the fastest first, ``(N,)``; ``gamma`` is 0 for levels that take the acceleration for 0.
            ``torchfra.filters.alphabeta.gains.levels`` unless given.
        manoeuvre: residual that raises a flag, in std; None for 3 times the slowest filter's own.
        outlier: residual that is rejected outside manoeuvres, in std; None for 3 times ``manoeuvre``.
        degrees: ``(N - 2,)`` shares of ``manoeuvre``, falling: which level a residual in a manoeuvre chooses.
        limit: largest acceleration of the target, m/s^2.
        margin: residual in std that is within reach in any case.
        hysteresis: share of ``manoeuvre`` that raises a flag while in a manoeuvre.
        dwell: steps without a vote after which a manoeuvre ends.
        votes: flags before the newest one, even.
        patience: rejections in a row after which the filter restarts with the next.
        longest: seconds without a measurement that was used after which the filter starts anew with the next one.
        converged: measurements after which it decides; before, the fastest level is used.
        flag_on_reject: which flag a rejected measurement leaves: ``"raw"`` its own, or ``"hold"`` the vote.
        detect: ``"cartesian"``: each axis for itself; ``"polar"``: range and horizontal azimuth from the origin vote,
            and all axes follow.
        onset: what a manoeuvre begins from: ``"shared"`` the state as it is, which lags after slow gains; or
            ``"fastest"`` that of the fastest filter, which then runs all the time.
        expect: what residuals are compared with: ``"paper"``: always the same threshold; ``"level"``: one that grows
            with what the level in use expects of its residuals.
        temperature: 0 for hard choices, above for soft ones; an attribute that may be changed at any time.
        initiation: position and velocity from the first two measurements, ``"two-point"``, or from the ``"prior"``.
        period: seconds between measurements that the gains are meant for: those of shorter steps are smaller; None
            for steps that hardly differ.
        confirm: whether it starts and restarts only from two measurements that a third confirms: one that the target
            reaches from them by ``limit`` and ``margin``.  Until then it starts from the newest one, at no speed, and
            goes on as it was instead of restarting.

    Raises:
        ValueError: gains that are not stable or whose levels do not slow down, or an argument out of its range.

    Source: Xu et al., "multilevel combined alpha-beta filter"; reconstructed where its formulas are lost.  Differs:
    after rejections the gain of the velocity is divided by all of the time that has passed.  ``onset``, ``expect``,
    ``confirm`` and the soft choices are additions.
    """

    def __init__(
        self,
        motion: Motion,
        sensor: Sensor,
        gains: Gains | None = None,
        *,
        manoeuvre: Value | None = None,
        outlier: Value | None = None,
        degrees: Value | None = None,
        limit: Value = 60.0,
        margin: Value = 3.0,
        hysteresis: Value = 0.5,
        dwell: Value = 3.0,
        votes: int = 2,
        patience: int = 5,
        longest: float = math.inf,
        converged: int = 5,
        flag_on_reject: str = "raw",
        detect: str = "cartesian",
        onset: str = "shared",
        expect: str = "paper",
        temperature: float = 0.0,
        initiation: str = "two-point",
        period: Value | None = None,
        confirm: bool = False,
    ) -> None:
        super().__init__(motion, sensor, initiation, period)
        self.votes, self.patience, self.longest, self.converged = votes, patience, longest, converged
        self.flag_on_reject, self.detect, self.onset, self.expect = flag_on_reject, detect, onset, expect
        self.confirm = confirm
        self._check()
        gains = design.levels(motion.orders) if gains is None else gains
        self._set_levels(gains)
        self._set_thresholds(gains, manoeuvre, outlier, degrees)
        self.limit, self.margin = Hyper(limit, name="limit"), Hyper(margin, constraints.nonnegative, name="margin")
        self.hysteresis = Hyper(hysteresis, constraints.interval(0.0, 1.0), name="hysteresis")
        self.dwell = Hyper(dwell, constraints.greater_than_eq(1.0), name="dwell")
        self.temperature = temperature

    def _check(self) -> None:
        """Checks what is neither gain nor threshold."""
        one_of(
            flag_on_reject=(self.flag_on_reject, ("raw", "hold")),
            detect=(self.detect, ("cartesian", "polar")),
            onset=(self.onset, ("shared", "fastest")),
            expect=(self.expect, ("paper", "level")),
        )
        if self.votes < 2 or self.votes % 2 or self.patience < 1 or self.converged < 3:
            raise ValueError(
                "votes, patience, converged: expected an even number of 2 or more, 1 or more, 3 or more, received "
                f"{self.votes}, {self.patience}, {self.converged}"
            )
        if not self.longest > 0:
            raise ValueError(f"longest: expected seconds above 0, received {self.longest}")
        if self.detect == "polar" and self.motion.dims < 2:
            raise ValueError("detect: expected 'cartesian' for a motion of one dimension, received 'polar'")

    def _set_levels(self, gains: Gains) -> None:
        count = gains.alpha.shape[-1] if gains.alpha.dim() else 0
        if count < 2 or not all_stable(gains) or not bool((gains.beta.diff() < 0).all()):
            raise ValueError(f"gains: expected two or more that are stable, the fastest first, received {gains}")
        if gains.gamma is not None and self.motion.orders == 2:
            raise ValueError(f"gains: expected two for constant velocity, received {gains}")
        self.alpha = Hyper(gains.alpha, constraints.unit_interval, event_dim=1, name="alpha")
        self.beta = Hyper(gains.beta, constraints.interval(0.0, 4.0), event_dim=1, name="beta")
        self.gamma = (
            None if gains.gamma is None else Hyper(gains.gamma, constraints.nonnegative, event_dim=1, name="gamma")
        )

    def _set_thresholds(
        self, gains: Gains, manoeuvre: Value | None, outlier: Value | None, degrees: Value | None
    ) -> None:
        slowest = two_gain_root(gains.alpha[..., -1], gains.beta[..., -1])[1]
        manoeuvre = 3 * slowest.sqrt() if manoeuvre is None else torch.as_tensor(manoeuvre, dtype=torch.float64)
        outlier = 3 * manoeuvre if outlier is None else torch.as_tensor(outlier, dtype=torch.float64)
        if bool((outlier < manoeuvre).any()):
            raise ValueError(f"outlier: expected {manoeuvre.tolist()} or more, received {outlier.tolist()}")
        between = gains.alpha.shape[-1] - 2
        falling = torch.linspace(0.9, 0.9 / max(between, 1), between, dtype=torch.float64)
        degrees = falling if degrees is None else torch.as_tensor(degrees, dtype=torch.float64)
        if degrees.shape[-1:] != (between,) or not bool((degrees.diff() < 0).all()):
            raise ValueError(f"degrees: expected ({between},), falling, received {degrees.tolist()}")
        self.degrees = Hyper(degrees, event_dim=1, name="degrees")
        self.manoeuvre, self.outlier = Hyper(manoeuvre, name="manoeuvre"), Hyper(outlier, name="outlier")

    def begin(self, belief: Gaussian) -> AlphaBetaBankState:
        """The state before the first measurement: nothing used, no flags, the fastest level."""
        mean, axes, count = self._first(belief)
        root = self._first_root(belief)
        polar = self.detect == "polar"
        zero, count = (axes[..., :1], count[..., :1]) if polar else (axes, count)
        channels = axes[..., :2] if polar else axes
        return AlphaBetaBankState(
            mean=mean,
            root=root,
            start=root_spreads(root),
            used=count,
            since=zero,
            rejected=zero,
            flags=channels.unsqueeze(-2).expand(*channels.shape[:-1], self.votes, -1),
            known=zero,
            manoeuvre=zero,
            quiet=zero,
            level=torch.nn.functional.pad(zero.unsqueeze(-1) + 1, (0, self.alpha.raw.shape[-1] - 1)),
            last=axes,
            since_last=axes,
            earlier=Earlier(axes, axes, axes) if self.confirm else None,
            fastest=Gaussian(mean, root) if self.onset == "fastest" else None,
        )

    def advance(
        self, state: AlphaBetaBankState, frame: Frame, mix: Mix | None = None
    ) -> tuple[AlphaBetaBankState, Record]:
        """One step, in the order of the paper: manoeuvre vote, outlier test, choice of the level, update."""
        innovation = self.innovation(state, frame)
        vote = self.manoeuvre_vote(state, innovation)
        test = self.outlier_test(state, innovation, vote.manoeuvre)
        level = self.choose_level(state, innovation, vote.manoeuvre, test.accepted)
        belief, fastest = self.update(state, innovation, vote, test, level)
        level = torch.where(test.restarted.unsqueeze(-1) > 0, one_level(0, level), level)
        after = remember(state, innovation, vote, test, self._flag_left(vote, test))
        after = after._replace(mean=belief.mean, root=belief.scale_tril, level=level, fastest=fastest)
        spread = residual_spread(root_ahead(root_rows(state.root), innovation.dt), innovation.std)
        return after, record(after, innovation.residual, frame, spread, _info(vote, test, level))

    def _flag_left(self, vote: Vote, test: OutlierTest) -> Tensor:
        """The flag that this measurement leaves in the history."""
        return vote.flag if self.flag_on_reject == "raw" else vote.flag + test.rejected * (vote.vote - vote.flag)


def _info(vote: Vote, test: OutlierTest, level: Tensor) -> AlphaBetaInfo:
    place = reduce(torch.add, (i * level[..., i] for i in range(level.shape[-1])))
    return AlphaBetaInfo(place, vote.vote > 0.5, vote.manoeuvre > 0.5, test.rejected > 0.5, test.again > 0)
