"""A bank of alpha-beta filters that switches with the manoeuvre, rejects outliers and restarts."""

from __future__ import annotations

import math
from functools import reduce
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra.filters.alphabeta import gains as design
from torchfra.filters.alphabeta.gains import Gains
from torchfra.filters.alphabeta.single import (
    Gained,
    kept,
    predicted_parts,
    scaled,
    shortened,
    started,
    three_gains,
    two_gains,
    unfolded,
    updated_parts,
)
from torchfra.filters.base import Mix
from torchfra.filters.records import Record
from torchfra.filters.soft import Soft
from torchfra.gaussian.inputs import Frame
from torchfra.hyper import Hyper, Value, one_of
from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian


class AlphaBetaBankState(NamedTuple):
    """What the bank knows after a step; ``g`` is an axis, or 1 where all decide together."""

    mean: Tensor
    root: Tensor
    """``(..., 3, d)``, see ``AlphaBetaState``."""
    used: Tensor
    """``(..., g)`` measurements that were used since the (re)start."""
    since: Tensor
    """``(..., g)`` seconds since the last of them."""
    rejected: Tensor
    """``(..., g)`` measurements rejected since then."""
    flags: Tensor
    """``(..., votes, c)`` of the last measurements, the newest first; ``c`` is an axis, or range and azimuth."""
    known: Tensor
    """``(..., g)`` how many of them there are."""
    manoeuvre: Tensor
    """``(..., g)`` 1 in a manoeuvre."""
    quiet: Tensor
    """``(..., g)`` steps since the last vote for one."""
    level: Tensor
    """``(..., g, N)`` the filter that was used last."""
    interval: Tensor
    """``(..., g)`` seconds between the last two that were used."""
    last: Tensor
    """``(..., d)`` the last measurement, used or not."""
    behind: Tensor
    """``(..., d)`` seconds since it."""
    beside: Tensor | None
    """``(..., n)`` of the fastest filter, if it runs beside."""

    @property
    def belief(self) -> Gaussian:
        """The estimate, with the steady-state covariance of the level in use."""
        return Gaussian(self.mean, unfolded(self.root, self.mean.shape[-1]))


class AlphaBetaInfo(NamedTuple):
    """Per step and track, for each axis, or once where all decide together: ``(..., T, g)``."""

    level: Tensor
    """Which filter was used, from 0 (the fastest); at a rejected step the one before."""
    vote: Tensor
    """bool: the flags voted for a manoeuvre."""
    manoeuvre: Tensor
    """bool: treated as one."""
    rejected: Tensor
    """bool: an outlier, not used."""
    restarted: Tensor
    """bool: begun anew after too many of them, or too long without one that was used."""


class _Look(NamedTuple):
    """A measurement against what was predicted."""

    ahead: list[Tensor]
    residual: Tensor
    size: Tensor
    """``(..., d)`` of the residual, in std."""
    seen: Tensor
    dt: Tensor
    since: Tensor
    std: Tensor


class _Vote(NamedTuple):
    """What the flags say."""

    raw: Tensor
    """``(..., c)`` this measurement's."""
    vote: Tensor
    manoeuvre: Tensor
    quiet: Tensor


class _Test(NamedTuple):
    """What the gates say."""

    out: Tensor
    rejected: Tensor
    restarted: Tensor
    points: Tensor
    """Measurements a restart begins with."""


class AlphaBetaBank(Soft, Gained):
    """Alpha-beta filters that share one state, of which the data choose the gains: the slow ones for straight flight.

    A residual above ``manoeuvre`` raises a flag, a majority of the last flags votes for a manoeuvre.  Without one, a
    residual beyond ``outlier`` is rejected and the track extrapolated; in one, only what is out of the target's reach
    is.  After too many rejections the filter restarts from the last two measurements.

    ``Estimate.scale_tril`` is the steady state's of the level in use for the noise of the sensor, so that it jumps
    with the level and does not know of rejections; ``nis`` and ``log_likelihood`` go with the level before.

    All choices are hard.  With a ``temperature`` they are soft, to train by: each comparison becomes a sigmoid (in
    units of its threshold), and gains are mixed.  ``f.temperature = 0`` makes a trained filter hard; restarts are so
    always.

    Args:
        motion: constant velocity, or acceleration for levels with three gains (with two it stays 0); only its
            dimensions and orders count.
        sensor: a ``Position``; its std is the unit of the thresholds.
        gains: of the levels, the fastest first, ``(N,)``; ``gamma`` is 0 for levels that take the acceleration for 0.
            ``torchfra.gains.levels`` unless given.
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
        onset: what a manoeuvre begins from: ``"shared"`` the state as it is, which the slow gains have let lag; or
            ``"fastest"`` that of the fastest filter, which then runs beside all the time.
        expect: what residuals are compared with: ``"paper"``: always the same threshold; ``"level"``: one that grows
            with what the level in use expects of its residuals.
        temperature: 0 for hard choices, above for soft ones; an attribute that may be changed at any time.
        start: see ``AlphaBeta``.
        period: see ``AlphaBeta``.

    Raises:
        ValueError: gains that are not stable or whose levels do not slow down, or an argument out of its range.

    Source: Xu et al., "multilevel combined alpha-beta filter"; our reading where its formulas are lost.  Differs: after
    rejections the gain of the velocity is divided by all of the time that has passed.  ``onset``,
    ``expect`` and the soft choices are ours.
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
        start: str = "points",
        period: Value | None = None,
    ) -> None:
        super().__init__(motion, sensor, start, period)
        gains = design.levels(motion.orders) if gains is None else gains
        count = gains.alpha.shape[-1] if gains.alpha.dim() else 0
        if count < 2 or not _stable(gains) or not bool((gains.beta.diff() < 0).all()):
            raise ValueError(f"gains: expected two or more that are stable, the fastest first, received {gains}")
        if gains.gamma is not None and motion.orders == 2:
            raise ValueError(f"gains: expected two for constant velocity, received {gains}")
        one_of(
            flag_on_reject=(flag_on_reject, ("raw", "hold")),
            detect=(detect, ("cartesian", "polar")),
            onset=(onset, ("shared", "fastest")),
            expect=(expect, ("paper", "level")),
        )
        if votes < 2 or votes % 2 or patience < 1 or converged < 3:
            said = f"an even number of 2 or more, 1 or more, 3 or more, received {votes}, {patience}, {converged}"
            raise ValueError(f"votes, patience, converged: expected {said}")
        if not longest > 0:
            raise ValueError(f"longest: expected seconds above 0, received {longest}")
        if detect == "polar" and motion.dims < 2:
            raise ValueError("detect: expected 'cartesian' on a line, received 'polar'")
        slowest = two_gains(gains.alpha[..., -1], gains.beta[..., -1])[1]
        manoeuvre = 3 * slowest.sqrt() if manoeuvre is None else torch.as_tensor(manoeuvre, dtype=torch.float64)
        outlier = 3 * manoeuvre if outlier is None else torch.as_tensor(outlier, dtype=torch.float64)
        if bool((outlier < manoeuvre).any()):
            raise ValueError(f"outlier: expected {manoeuvre.tolist()} or more, received {outlier.tolist()}")
        few = torch.linspace(0.9, 0.9 / max(count - 2, 1), count - 2, dtype=torch.float64)
        degrees = few if degrees is None else torch.as_tensor(degrees, dtype=torch.float64)
        if degrees.shape[-1:] != (count - 2,) or not bool((degrees.diff() < 0).all()):
            raise ValueError(f"degrees: expected ({count - 2},), falling, received {degrees.tolist()}")
        self.alpha = Hyper(gains.alpha, constraints.unit_interval, event_dim=1, name="alpha")
        self.beta = Hyper(gains.beta, constraints.interval(0.0, 4.0), event_dim=1, name="beta")
        self.gamma = (
            None if gains.gamma is None else Hyper(gains.gamma, constraints.nonnegative, event_dim=1, name="gamma")
        )
        self.degrees = Hyper(degrees, event_dim=1, name="degrees")
        self.manoeuvre, self.outlier = Hyper(manoeuvre, name="manoeuvre"), Hyper(outlier, name="outlier")
        self.limit, self.margin = Hyper(limit, name="limit"), Hyper(margin, constraints.nonnegative, name="margin")
        self.hysteresis = Hyper(hysteresis, constraints.interval(0.0, 1.0), name="hysteresis")
        self.dwell = Hyper(dwell, constraints.greater_than_eq(1.0), name="dwell")
        self.votes, self.patience, self.longest, self.converged = votes, patience, longest, converged
        self.flag_on_reject, self.detect, self.onset, self.expect = flag_on_reject, detect, onset, expect
        self.temperature = temperature

    def begin(self, belief: Gaussian) -> AlphaBetaBankState:
        """See ``Filter``."""
        mean, each, count = self._first(belief)
        nothing, polar = each, self.detect == "polar"
        if polar:
            nothing, count = each[..., :1], count[..., :1]
        channels = each[..., :2] if polar else each
        fastest = torch.nn.functional.pad(nothing.unsqueeze(-1) + 1, (0, self.alpha.raw.shape[-1] - 1))
        entries = each.unsqueeze(-2).expand(*each.shape[:-1], 3 if self.gamma is None else 6, -1)
        flags = channels.unsqueeze(-2).expand(*channels.shape[:-1], self.votes, -1)
        beside = mean if self.onset == "fastest" else None
        return AlphaBetaBankState(
            mean,
            entries,
            count,
            nothing,
            nothing,
            flags,
            nothing,
            nothing,
            nothing,
            fastest,
            nothing + 1,
            each,
            each,
            beside,
        )

    def advance(
        self, state: AlphaBetaBankState, frame: Frame, mix: Mix | None = None
    ) -> tuple[AlphaBetaBankState, Record]:
        """See ``Filter``: vote, test and update, in the order of the paper."""
        d, dt = self.motion.dims, frame.dt.unsqueeze(-1)
        ahead = predicted_parts(state.mean.unflatten(-1, (self.motion.orders, d)).unbind(-2), dt)
        seen = frame.seen if self.detect == "cartesian" else frame.seen.amin(-1, keepdim=True)
        residual = frame.seen * (frame.z - ahead[0])
        look = _Look(
            ahead,
            residual,
            residual.abs() / frame.measurement_noise.std,
            seen,
            dt,
            state.since + dt,
            frame.measurement_noise.std,
        )
        channels = (
            look.size if self.detect == "cartesian" else self._polar(frame.z, ahead[0], frame.measurement_noise.std)
        )
        vote = self._vote(state, look, channels)
        test = self._test(state, look, vote.manoeuvre)
        accepted = (1 - test.out) * seen
        level = self._level(state, look, channels, vote.manoeuvre)
        level = torch.lerp(state.level, level, accepted.unsqueeze(-1))
        mean, beside = self._move(state, frame, look, vote, test, level)
        level = torch.where(test.restarted.unsqueeze(-1) > 0, one_level(0, level), level)
        table, expected = self._table(residual)
        after = self._remember(state, frame, look, vote, test, accepted)
        root = scaled([of_level(level, entry) for entry in table], after.interval, frame.measurement_noise.std)
        after = after._replace(mean=mean, root=root, level=level, beside=beside)
        info = AlphaBetaInfo(
            reduce(torch.add, (i * level[..., i] for i in range(level.shape[-1]))),
            vote.vote > 0.5, vote.manoeuvre > 0.5, test.out > 0.5, test.restarted > 0,
        )  # fmt: skip
        return after, kept(after, residual, frame, of_level(state.level, expected).sqrt(), info)

    def _vote(self, state: AlphaBetaBankState, look: _Look, channels: Tensor) -> _Vote:
        """Whether this is a manoeuvre: sections on the preliminary flag and the vote of several points."""
        wide = 1.0 if self.expect == "paper" else self._wide(state.level)
        high = self.manoeuvre(channels).unsqueeze(-1) * wide
        high = high * (1 - state.manoeuvre * (1 - self.hysteresis(channels).unsqueeze(-1)))
        raw = self._above(channels / high, 1.0)
        enough = self._above(state.used, self.converged - 0.5) * self._above(state.known, self.votes - 0.5)
        votes = self._above(reduce(torch.add, state.flags.unbind(-2), raw), (self.votes + 1) / 2)
        vote = enough * self._any(votes) * look.seen
        quiet = (1 - vote) * (state.quiet + look.seen)
        lasting = self._above(self.dwell(channels).unsqueeze(-1) - quiet, 0.5)
        return _Vote(raw, vote, vote + (1 - vote) * state.manoeuvre * lasting, quiet)

    def _test(self, state: AlphaBetaBankState, look: _Look, manoeuvre: Tensor) -> _Test:
        """Whether this is an outlier: by the threshold, or in a manoeuvre by what is out of reach; and restarts."""
        run, flagged = torch.zeros_like(state.since), self._any(state.flags[..., 0, :])
        for i in range(self.votes):
            run = run + flagged
            flagged = flagged * self._any(state.flags[..., min(i + 1, self.votes - 1), :])
        reach = look.since + look.dt * run * (1 - self._above(state.rejected, 0.5))
        limit, margin, outlier = (h(reach).unsqueeze(-1) for h in (self.limit, self.margin, self.outlier))
        reached = 0.5 * limit * reach.square() / look.std + margin
        out = self._any(self._above(look.size / (manoeuvre * reached + (1 - manoeuvre) * outlier), 1.0))
        out = out * look.seen * (state.used > 1.5)  # two points start a track, whatever they are
        expired = None
        if math.isfinite(self.longest):
            expired = (look.since > self.longest).to(out) * look.seen * (state.used > 0.5)
            out = out * (1 - expired)
        rejected = state.rejected + out
        restarted = (rejected > self.patience).to(out) * (out > 0.5)
        if expired is None:
            return _Test(out, rejected, restarted, torch.full_like(out, 2.0))
        return _Test(out, rejected, torch.maximum(restarted, expired), 2 - expired)

    def _move(
        self, state: AlphaBetaBankState, frame: Frame, look: _Look, vote: _Vote, test: _Test, level: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """The mean after the step, and that of the fastest filter if it runs beside."""
        used = (1 - test.out) * frame.seen
        moved = self._updated(level, state.used, look.ahead, used * look.residual, look.since)
        speed = (test.points - 1) * (frame.z - state.last) / (state.behind + look.dt)
        anew = [frame.z, speed, *(0 * frame.z for _ in moved[2:])]
        beside = state.beside
        if beside is not None:
            fast = predicted_parts(beside.unflatten(-1, (self.motion.orders, self.motion.dims)).unbind(-2), look.dt)
            fast = self._updated(one_level(0, level), state.used, fast, used * (frame.z - fast[0]), look.since)
            onset = vote.manoeuvre * (1 - state.manoeuvre)
            moved = [x + onset * (f - x) for x, f in zip(moved, fast, strict=True)]
            beside = torch.cat([torch.where(test.restarted > 0, a, f) for a, f in zip(anew, fast, strict=True)], -1)
        return torch.cat([torch.where(test.restarted > 0, a, x) for a, x in zip(anew, moved, strict=True)], -1), beside

    def _remember(
        self, state: AlphaBetaBankState, frame: Frame, look: _Look, vote: _Vote, test: _Test, accepted: Tensor
    ) -> AlphaBetaBankState:
        """Counters, flags and the last measurement after the step; nothing of them survives a restart."""
        keep, seen = 1 - test.restarted, look.seen
        flag = vote.raw if self.flag_on_reject == "raw" else vote.raw + test.out * (vote.vote - vote.raw)
        newest, older = torch.broadcast_tensors(flag.unsqueeze(-2), state.flags[..., :-1, :])[0], state.flags
        older = older[..., :-1, :].expand(*newest.shape[:-2], -1, -1)
        pushed = torch.cat([newest[..., :1, :], older], -2)
        begun = seen * (state.used > 1.5)  # the two points that start a track vote for nothing
        return state._replace(
            used=keep * (state.used + accepted) + test.restarted * test.points,
            since=keep * look.since * (1 - accepted),
            rejected=keep * test.rejected * (1 - accepted),
            flags=keep.unsqueeze(-2) * (state.flags + begun.unsqueeze(-2) * (pushed - state.flags)),
            known=keep * (state.known + begun),
            manoeuvre=keep * (state.manoeuvre + seen * (vote.manoeuvre - state.manoeuvre)),
            quiet=keep * vote.quiet,
            interval=torch.where(
                test.restarted > 0, look.dt, state.interval + accepted * (look.since - state.interval)
            ),
            last=state.last + frame.seen * (frame.z - state.last),
            behind=(state.behind + look.dt) * (1 - frame.seen),
        )

    def _updated(
        self, level: Tensor, used: Tensor, ahead: list[Tensor], residual: Tensor, since: Tensor
    ) -> list[Tensor]:
        """What was predicted after a residual ``(..., d)``, which is 0 where there is none."""
        hypers = [self.alpha, self.beta] + ([] if self.gamma is None else [self.gamma])
        column = [of_level(level, h(residual)) for h in hypers]
        if self.gamma is not None:
            has = (self.gamma(residual) > 0).to(residual)
            column[2], ahead = column[2] / 2, [*ahead[:2], of_level(level, has) * ahead[2]]
        column = started(shortened(column, since, self.period), used)
        return updated_parts(ahead, column, since, residual)

    def _table(self, like: Tensor) -> tuple[list[Tensor], Tensor]:
        """Entries of each level's root, ``(..., N)`` each, and the variance ``(..., N)`` of its residuals."""
        alpha, beta = self.alpha(like), self.beta(like)
        entries, variance = two_gains(alpha, beta)
        if self.gamma is None:
            return entries, variance
        gamma = self.gamma(like)
        has = gamma > 0
        three, wider = three_gains(alpha, beta, torch.where(has, gamma, 0.1 * beta))
        both = zip([*entries, *[torch.zeros_like(alpha)] * 3], three, strict=True)
        return [torch.where(has, b, a) for a, b in both], torch.where(has, wider, variance)

    def _above(self, x: Tensor, threshold: float) -> Tensor:
        """1 where ``x`` is larger, else 0; between the two where choices are soft."""
        return torch.sigmoid((x - threshold) / self.heat) if self.soft else (x > threshold).to(x)

    def _any(self, flags: Tensor) -> Tensor:
        """Of channels, those that decide: each for itself, or one for all."""
        if self.detect == "cartesian":
            return flags
        none: Tensor = reduce(torch.mul, (1 - flags).split(1, -1))
        return 1 - none

    def _polar(self, z: Tensor, ahead: Tensor, std: Tensor) -> Tensor:
        """Residuals ``(..., 2)`` of range and azimuth, in std."""
        ground = ahead[..., :2].square().sum(-1)
        safe = torch.where(ground > 0, ground, 1.0).sqrt()
        cross = ahead[..., 0] * z[..., 1] - ahead[..., 1] * z[..., 0]
        dot = (ahead[..., :2] * z[..., :2]).sum(-1)
        turned = torch.atan2(cross, dot) * safe  # metres along the circle
        gap = z.square().sum(-1).sqrt() - ahead.square().sum(-1).sqrt()
        return torch.stack([gap.abs(), turned.abs()], -1) / std.mean(-1, keepdim=True)

    def _wide(self, level: Tensor) -> Tensor:
        """How much larger residuals of the level in use are than the slowest one's."""
        variance = self._table(level)[1]
        ratio: Tensor = (of_level(level, variance) / variance[..., -1:]).sqrt()
        return ratio

    def _level(self, state: AlphaBetaBankState, look: _Look, channels: Tensor, manoeuvre: Tensor) -> Tensor:
        """Shares ``(..., g, N)`` of the levels; a single 1 where choices are hard."""
        converged = self._above(state.used, self.converged - 0.5)
        degree = channels if self.detect == "cartesian" else channels.amax(-1, keepdim=True)
        degree = degree / self.manoeuvre(degree).unsqueeze(-1)
        nothing = torch.zeros_like(converged)
        over = [self._above(degree / q, 1.0) for q in self.degrees(degree).unsqueeze(-2).unbind(-1)]
        within = [b - a for a, b in pairwise([nothing, *over, nothing + 1])]
        busy = converged * manoeuvre
        shares = [busy * w + (1 - converged) * (i == 0) for i, w in enumerate(within)]
        return torch.stack(torch.broadcast_tensors(*shares, converged * (1 - manoeuvre)), -1)


def one_level(place: int, level: Tensor) -> Tensor:
    """One level, ``(N,)``."""
    return torch.eye(level.shape[-1], dtype=level.dtype, device=level.device)[place]


def of_level(level: Tensor, values: Tensor) -> Tensor:
    """Of values ``(..., N)`` that of the level ``(..., g, N)``."""
    parts = [level[..., i] * values[..., i].unsqueeze(-1) for i in range(level.shape[-1])]
    return reduce(torch.add, parts)  # many times faster than a sum over so few


def _stable(gains: Gains) -> bool:
    """Of every level; one without ``gamma`` has two gains."""
    alpha, beta, gamma = gains
    if gamma is None:
        return design.stable(gains)
    two = gamma == 0
    parts = [Gains(alpha[two], beta[two])] if bool(two.any()) else []
    parts += [Gains(alpha[~two], beta[~two], gamma[~two])] if bool((~two).any()) else []
    return all(map(design.stable, parts))
