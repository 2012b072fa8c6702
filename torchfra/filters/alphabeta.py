"""Filters of constant gains: one alpha-beta(-gamma) filter, and a bank of them that switches with the manoeuvre."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra import gains as design
from torchfra.filters.base import Filter, Mix, Record
from torchfra.filters.frames import Frame
from torchfra.gains import Gains
from torchfra.hyper import Hyper, Value
from torchfra.linalg import is_traced
from torchfra.motion import ConstantAcceleration, ConstantVelocity, Motion
from torchfra.sensors import Position, Sensor
from torchfra.types import Gaussian


class AlphaBetaState(NamedTuple):
    """What one filter knows after a step."""

    mean: Tensor
    """``(..., n)``."""
    root: Tensor
    """``(..., p, d)`` the entries of the covariance's root that are not zero, for each axis."""
    used: Tensor
    """``(..., d)`` measurements that were used."""
    since: Tensor
    """``(..., d)`` seconds since the last of them."""

    @property
    def belief(self) -> Gaussian:
        """The estimate, with the steady-state covariance of its gains."""
        return Gaussian(self.mean, _whole(self.root, self.mean.shape[-1]))


class _Gained(Filter):
    """Abstract: a filter of positions, axis by axis."""

    def __init__(self, motion: Motion, sensor: Sensor, start: str) -> None:
        if not isinstance(sensor, Position) or sensor.std is None:
            raise ValueError(f"sensor: expected a Position with a std, received {type(sensor).__name__}")
        if not isinstance(motion, ConstantVelocity | ConstantAcceleration) or motion.dims != sensor.size:
            raise ValueError(
                f"motion: expected constant velocity or acceleration in {sensor.size} dimensions, received {motion}"
            )
        if start not in ("points", "prior"):
            raise ValueError(f"start: expected 'points' or 'prior', received {start!r}")
        super().__init__(motion, sensor)
        self.start = start

    def _first(self, belief: Gaussian) -> tuple[Tensor, Tensor, Tensor]:
        """Mean to start from, zeros ``(..., d)``, and the measurements it counts for."""
        d = self.motion.dims
        nothing = torch.zeros_like(belief.mean[..., :d])
        if self.start == "prior":
            return belief.mean, nothing, nothing + 2
        zeros = [nothing] * (self.motion.orders - 1)
        return torch.cat([belief.mean[..., :d], *zeros], -1), nothing, nothing

    def finish(self, state: Any, belief: Gaussian, info: Any) -> tuple[Gaussian, Any]:
        """See ``Filter``."""
        return Gaussian(belief.mean, _whole(belief.scale_tril, belief.mean.shape[-1])), info


class AlphaBeta(_Gained):
    """Alpha-beta filter, or alpha-beta-gamma with a motion of constant acceleration.

    The first two measurements make position and velocity.  ``Estimate.scale_tril`` is the steady state's for the noise
    of the sensor, whatever the track has seen so far; velocities follow the time step.

    Args:
        motion: constant velocity (two gains) or acceleration (three; with two the acceleration stays 0); only its
            dimensions and orders count.
        sensor: a ``Position``.
        gains: ``torchfra.gains``.
        expanding: use the gains of a least-squares line until they have fallen to ``gains`` (two gains only).
        start: ``"points"`` from the first two measurements, or ``"prior"``.

    Raises:
        ValueError: gains that are not stable, or a motion or a sensor of another kind.

    Source: Kalata (1984); Bar-Shalom, Li & Kirubarajan (2001), section 6.5.
    """

    def __init__(
        self, motion: Motion, sensor: Sensor, gains: Gains, *, expanding: bool = False, start: str = "points"
    ) -> None:
        super().__init__(motion, sensor, start)
        if (gains.gamma is not None and motion.orders == 2) or not design.stable(gains):
            raise ValueError(f"gains: expected stable ones, at most {motion.orders}, received {gains}")
        if expanding and gains.gamma is not None:
            raise ValueError("expanding: expected two gains, received three")
        self.alpha = Hyper(gains.alpha, constraints.unit_interval, name="alpha")
        self.beta = Hyper(gains.beta, constraints.interval(0.0, 4.0), name="beta")
        self.gamma = None if gains.gamma is None else Hyper(gains.gamma, constraints.nonnegative, name="gamma")
        self.expanding = expanding

    def begin(self, belief: Gaussian) -> AlphaBetaState:
        """See ``Filter``."""
        mean, nothing, count = self._first(belief)
        k = self.motion.orders
        return AlphaBetaState(
            mean, nothing.unsqueeze(-2).expand(*nothing.shape[:-1], k * (k + 1) // 2, -1), count, nothing
        )

    def advance(self, state: AlphaBetaState, frame: Frame, mix: Mix | None = None) -> tuple[AlphaBetaState, Record]:
        """See ``Filter``."""
        d, k = self.motion.dims, self.motion.orders
        dt, since = frame.dt.unsqueeze(-1), state.since + frame.dt.unsqueeze(-1)
        parts = state.mean.unflatten(-1, (k, d)).unbind(-2)
        ahead = _ahead(parts, dt)
        residual = frame.seen * (frame.z - ahead[0])
        alpha, beta = (h().to(residual).unsqueeze(-1) for h in (self.alpha, self.beta))
        column = [alpha, beta] + ([] if self.gamma is None else [self.gamma().to(residual).unsqueeze(-1) / 2])
        entries, variance = _pair(alpha, beta) if self.gamma is None else _triple(alpha, beta, 2 * column[2])
        root, spread = _scaled(entries, dt, frame.noise.std), variance.sqrt()
        if self.expanding:
            line = design.expanding_memory(state.used + 1)
            column = [torch.maximum(*pair) for pair in zip(column, line[:2], strict=True)]
        column = _started(column, state.used)
        moved = _moved(ahead, column, since, residual)
        used, since = state.used + frame.seen, since * (1 - frame.seen)
        state = AlphaBetaState(torch.cat(moved, -1), root, used, since)
        return state, _record(state, residual, frame, spread, None)


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
    last: Tensor
    """``(..., d)`` the last measurement, used or not."""
    behind: Tensor
    """``(..., d)`` seconds since it."""
    beside: Tensor | None
    """``(..., n)`` of the fastest filter, if it runs beside."""

    @property
    def belief(self) -> Gaussian:
        """The estimate, with the steady-state covariance of the level in use."""
        return Gaussian(self.mean, _whole(self.root, self.mean.shape[-1]))


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


class AlphaBetaBank(_Gained):
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

    Raises:
        ValueError: gains that are not stable or whose levels do not slow down, or an argument out of its range.

    Source: Xu et al., "multilevel combined alpha-beta filter"; our reading where its formulas are lost.  Differs: after
    rejections the gain of the velocity is divided by all of the time that has passed.  ``onset``,
    ``expect`` and the soft choices are ours.
    """

    kernel_numbers = ("heat",)

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
    ) -> None:
        super().__init__(motion, sensor, start)
        gains = design.levels(motion.orders) if gains is None else gains
        count = gains.alpha.shape[-1] if gains.alpha.dim() else 0
        if count < 2 or not _stable(gains) or not bool((gains.beta.diff() < 0).all()):
            raise ValueError(f"gains: expected two or more that are stable, the fastest first, received {gains}")
        if gains.gamma is not None and motion.orders == 2:
            raise ValueError(f"gains: expected two for constant velocity, received {gains}")
        for name, value, known in (
            ("flag_on_reject", flag_on_reject, ("raw", "hold")),
            ("detect", detect, ("cartesian", "polar")),
            ("onset", onset, ("shared", "fastest")),
            ("expect", expect, ("paper", "level")),
        ):
            if value not in known:
                raise ValueError(f"{name}: expected one of {known}, received {value!r}")
        if votes < 2 or votes % 2 or patience < 1 or converged < 3:
            said = f"an even number of 2 or more, 1 or more, 3 or more, received {votes}, {patience}, {converged}"
            raise ValueError(f"votes, patience, converged: expected {said}")
        if not longest > 0:
            raise ValueError(f"longest: expected seconds above 0, received {longest}")
        if detect == "polar" and motion.dims < 2:
            raise ValueError("detect: expected 'cartesian' on a line, received 'polar'")
        slowest = _pair(gains.alpha[..., -1], gains.beta[..., -1])[1]
        manoeuvre = 3 * slowest.sqrt() if manoeuvre is None else torch.as_tensor(manoeuvre, dtype=torch.float64)
        outlier = 3 * manoeuvre if outlier is None else torch.as_tensor(outlier, dtype=torch.float64)
        if bool((outlier < manoeuvre).any()):
            raise ValueError(f"outlier: expected {manoeuvre.tolist()} or more, received {outlier.tolist()}")
        few = torch.linspace(0.9, 0.9 / max(count - 2, 1), count - 2, dtype=torch.float64)
        degrees = few if degrees is None else torch.as_tensor(degrees, dtype=torch.float64)
        if degrees.shape[-1:] != (count - 2,) or not bool((degrees.diff() < 0).all()):
            raise ValueError(f"degrees: expected ({count - 2},), falling, received {degrees.tolist()}")
        self.alpha = Hyper(gains.alpha, constraints.unit_interval, event=1, name="alpha")
        self.beta = Hyper(gains.beta, constraints.interval(0.0, 4.0), event=1, name="beta")
        self.gamma = None if gains.gamma is None else Hyper(gains.gamma, constraints.nonnegative, event=1, name="gamma")
        self.degrees = Hyper(degrees, event=1, name="degrees")
        self.manoeuvre, self.outlier = Hyper(manoeuvre, name="manoeuvre"), Hyper(outlier, name="outlier")
        self.limit, self.margin = Hyper(limit, name="limit"), Hyper(margin, constraints.nonnegative, name="margin")
        self.hysteresis = Hyper(hysteresis, constraints.interval(0.0, 1.0), name="hysteresis")
        self.dwell = Hyper(dwell, constraints.greater_than_eq(1.0), name="dwell")
        self.votes, self.patience, self.longest, self.converged = votes, patience, longest, converged
        self.flag_on_reject, self.detect, self.onset, self.expect = flag_on_reject, detect, onset, expect
        self.temperature = temperature

    @property
    def temperature(self) -> float:
        """0 for hard choices, above for soft ones."""
        return self.heat

    @temperature.setter
    def temperature(self, value: float) -> None:
        if not value >= 0:
            raise ValueError(f"temperature: expected 0 or more, received {value}")
        self.heat, self.soft = float(value), value > 0

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
            mean, entries, count, nothing, nothing, flags, nothing, nothing, nothing, fastest, each, each, beside
        )

    def advance(
        self, state: AlphaBetaBankState, frame: Frame, mix: Mix | None = None
    ) -> tuple[AlphaBetaBankState, Record]:
        """See ``Filter``: tests, vote and update, in the order of the paper."""
        d, std = self.motion.dims, frame.noise.std
        dt = frame.dt.unsqueeze(-1)
        parts = state.mean.unflatten(-1, (self.motion.orders, d)).unbind(-2)
        predicted, since = _ahead(parts, dt), state.since + dt
        ahead = predicted[0]
        residual = frame.seen * (frame.z - ahead)
        seen = frame.seen if self.detect == "cartesian" else frame.seen.amin(-1, keepdim=True)
        size = residual.abs() / std
        converged = self._above(state.used, self.converged - 0.5)

        # What counts as large, and the vote.
        wide = 1.0 if self.expect == "paper" else self._wide(state.level)
        high = self.manoeuvre().to(size).unsqueeze(-1) * wide
        high = high * (1 - state.manoeuvre * (1 - self.hysteresis().to(size).unsqueeze(-1)))
        channels = size if self.detect == "cartesian" else self._polar(frame.z, ahead, std)
        raw = self._above(channels / high, 1.0)
        enough = converged * self._above(state.known, self.votes - 0.5)
        votes = self._above(reduce(torch.add, state.flags.unbind(-2), raw), (self.votes + 1) / 2)
        vote = enough * self._any(votes) * seen
        quiet = (1 - vote) * (state.quiet + seen)
        lasting = self._above(self.dwell().to(size).unsqueeze(-1) - quiet, 0.5)
        manoeuvre = vote + (1 - vote) * state.manoeuvre * lasting

        # What is out of reach.
        run, flagged = torch.zeros_like(state.since), self._any(state.flags[..., 0, :])
        for i in range(self.votes):
            run = run + flagged
            flagged = flagged * self._any(state.flags[..., min(i + 1, self.votes - 1), :])
        reach = since + dt * run * (1 - self._above(state.rejected, 0.5))
        limit, margin = (h().to(size).unsqueeze(-1) for h in (self.limit, self.margin))
        reached = 0.5 * limit * reach.square() / std + margin
        out = self._above(size / (manoeuvre * reached + (1 - manoeuvre) * self.outlier().to(size).unsqueeze(-1)), 1.0)
        out = self._any(out) * seen * (state.used > 1.5)  # two points start a track, whatever they are
        expired = None
        if math.isfinite(self.longest):
            expired = (since > self.longest).to(size) * seen * (state.used > 0.5)
            out = out * (1 - expired)
        rejected = state.rejected + out
        restarted = (rejected > self.patience).to(size) * (out > 0.5)
        restarted = restarted if expired is None else torch.maximum(restarted, expired)
        points = 2 if expired is None else 2 - expired  # that it starts from

        # The level, and the update.
        degree = self._largest(channels) / self.manoeuvre().to(size).unsqueeze(-1)
        level = self._level(converged, manoeuvre, degree)
        accepted = (1 - out) * seen
        level = torch.lerp(state.level, level, accepted.unsqueeze(-1))
        used, gone = (1 - out) * frame.seen, state.behind + dt
        moved = self._updated(level, state.used, predicted, used * residual, since)
        anew = [frame.z, (points - 1) * (frame.z - state.last) / gone, *(0 * frame.z for _ in moved[2:])]
        beside = state.beside
        if beside is not None:
            fast = _ahead(beside.unflatten(-1, (self.motion.orders, d)).unbind(-2), dt)
            fast = self._updated(_only(0, level), state.used, fast, used * (frame.z - fast[0]), since)
            onset = manoeuvre * (1 - state.manoeuvre)
            moved = [x + onset * (f - x) for x, f in zip(moved, fast, strict=True)]
            beside = torch.cat([torch.where(restarted > 0, a, f) for a, f in zip(anew, fast, strict=True)], -1)
        moved = [torch.where(restarted > 0, a, x) for a, x in zip(anew, moved, strict=True)]

        keep = 1 - restarted
        flag = raw if self.flag_on_reject == "raw" else raw + out * (vote - raw)
        pushed = torch.cat([flag.unsqueeze(-2), state.flags[..., :-1, :]], -2)
        there = seen.unsqueeze(-2)
        level = torch.where(restarted.unsqueeze(-1) > 0, _only(0, level), level)
        table, expected = self._table(size)
        after = AlphaBetaBankState(
            torch.cat(moved, -1),
            _scaled([_chosen(level, entry) for entry in table], dt, std),
            keep * (state.used + accepted) + restarted * points,
            keep * since * (1 - accepted),
            keep * rejected * (1 - accepted),
            keep.unsqueeze(-2) * (state.flags + there * (pushed - state.flags)),
            keep * (state.known + seen),
            keep * (state.manoeuvre + seen * (manoeuvre - state.manoeuvre)),
            keep * quiet,
            level,
            state.last + frame.seen * (frame.z - state.last),
            gone * (1 - frame.seen),
            beside,
        )
        spread = _chosen(state.level, expected).sqrt()
        info = AlphaBetaInfo(
            reduce(torch.add, (i * level[..., i] for i in range(level.shape[-1]))),
            vote > 0.5, manoeuvre > 0.5, out > 0.5, restarted > 0,
        )  # fmt: skip
        return after, _record(after, residual, frame, spread, info)

    def _updated(
        self, level: Tensor, used: Tensor, ahead: list[Tensor], residual: Tensor, since: Tensor
    ) -> list[Tensor]:
        """What was predicted after a residual ``(..., d)``, which is 0 where there is none."""
        hypers = [self.alpha, self.beta] + ([] if self.gamma is None else [self.gamma])
        column = [_chosen(level, h().to(residual)) for h in hypers]
        if self.gamma is not None:
            has = (self.gamma().to(residual) > 0).to(residual)
            column[2], ahead = column[2] / 2, [*ahead[:2], _chosen(level, has) * ahead[2]]
        return _moved(ahead, _started(column, used), since, residual)

    def _table(self, like: Tensor) -> tuple[list[Tensor], Tensor]:
        """Entries of each level's root, ``(..., N)`` each, and the variance ``(..., N)`` of its residuals."""
        alpha, beta = self.alpha().to(like), self.beta().to(like)
        entries, variance = _pair(alpha, beta)
        if self.gamma is None:
            return entries, variance
        gamma = self.gamma().to(like)
        has = gamma > 0
        three, wider = _triple(alpha, beta, torch.where(has, gamma, 0.1 * beta))
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

    def _largest(self, channels: Tensor) -> Tensor:
        return channels if self.detect == "cartesian" else channels.amax(-1, keepdim=True)

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
        ratio: Tensor = (_chosen(level, variance) / variance[..., -1:]).sqrt()
        return ratio

    def _level(self, converged: Tensor, manoeuvre: Tensor, degree: Tensor) -> Tensor:
        """Shares ``(..., g, N)`` of the levels; a single 1 where choices are hard."""
        nothing = torch.zeros_like(converged)
        over = [self._above(degree / q, 1.0) for q in self.degrees().to(degree).unsqueeze(-2).unbind(-1)]
        steps = [nothing, *over, nothing + 1]
        within = [b - a for a, b in pairwise(steps)]
        busy = converged * manoeuvre
        return torch.stack([busy * w + (1 - converged) * (i == 0) for i, w in enumerate(within)]
                           + [converged * (1 - manoeuvre)], -1)  # fmt: skip


def _stable(gains: Gains) -> bool:
    """Of every level; one without ``gamma`` has two gains."""
    alpha, beta, gamma = gains
    if gamma is None:
        return design.stable(gains)
    two = gamma == 0
    parts = [Gains(alpha[two], beta[two])] if bool(two.any()) else []
    parts += [Gains(alpha[~two], beta[~two], gamma[~two])] if bool((~two).any()) else []
    return all(map(design.stable, parts))


def _ahead(parts: tuple[Tensor, ...], dt: Tensor) -> list[Tensor]:
    """Position, velocity(, acceleration) after ``dt``."""
    if len(parts) == 2:
        return [parts[0] + dt * parts[1], parts[1]]
    p, v, a = parts
    return [p + dt * v + dt**2 / 2 * a, v + dt * a, a]


def _moved(ahead: list[Tensor], column: list[Tensor], since: Tensor, residual: Tensor) -> list[Tensor]:
    """What was predicted after a residual; what has no gain is 0."""
    moved = [x + g / since**i * residual for i, (x, g) in enumerate(zip(ahead, column, strict=False))]
    return moved + [torch.zeros_like(residual) for _ in ahead[len(column) :]]


def _started(column: list[Tensor], count: Tensor) -> list[Tensor]:
    """Gains of the first measurement (a position), of the second (a velocity), and then as they are."""
    first = [1.0] + [0.0] * (len(column) - 1)
    second = [1.0, 1.0] + [0.0] * (len(column) - 2)
    return [
        torch.where(count < 0.5, a, torch.where(count < 1.5, b, gain))
        for a, b, gain in zip(first, second, column, strict=True)
    ]


def _only(place: int, level: Tensor) -> Tensor:
    """One level, ``(N,)``."""
    return torch.eye(level.shape[-1], dtype=level.dtype, device=level.device)[place]


def _chosen(level: Tensor, values: Tensor) -> Tensor:
    """Of values ``(..., N)`` that of the level ``(..., g, N)``."""
    parts = [level[..., i] * values[..., i].unsqueeze(-1) for i in range(level.shape[-1])]
    return reduce(torch.add, parts)  # many times faster than a sum over so few


def _pair(alpha: Tensor, beta: Tensor) -> tuple[list[Tensor], Tensor]:
    """Entries of the steady state's root, row by row, and the variance of the residual, for a noise of 1."""
    position, cross, velocity, ahead = design.variances(alpha, beta)
    first = position.sqrt()
    along = cross / first
    return [first, along, (velocity - along.square()).sqrt()], 1 + ahead


def _triple(alpha: Tensor, beta: Tensor, gamma: Tensor) -> tuple[list[Tensor], Tensor]:
    """The same for three gains."""
    rows = [[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]]
    transition = torch.tensor(rows, dtype=alpha.dtype, device=alpha.device)
    root = design.steady_root(transition, torch.stack([alpha, beta, gamma / 2], -1))
    ahead = (transition[0].unsqueeze(-2) @ root).squeeze(-2)
    return [root[..., i, j] for i in range(3) for j in range(i + 1)], 1 + ahead.square().sum(-1)


def _scaled(entries: Sequence[Tensor], dt: Tensor, std: Tensor) -> Tensor:
    """Entries ``(..., p, d)`` for this time step and noise."""
    rows = [i for i in range(3) for _ in range(i + 1)]
    scaled = [entry / dt**i * std for i, entry in zip(rows, entries, strict=False)]
    return torch.stack(torch.broadcast_tensors(*scaled), -2)


def _whole(entries: Tensor, n: int) -> Tensor:
    """``(..., n, n)`` root from its entries ``(..., p, d)``; states without any are certain."""
    p, d = entries.shape[-2:]
    places = [(row, column) for row in range(3) for column in range(row + 1)][:p]
    if not is_traced(entries) and entries.dim() > 3 and entries.stride(0) == 1:
        # From kernels tracks lie side by side: so they stay.
        batch = entries.shape[:-2]
        whole = entries.new_zeros((*batch[1:], n, n, batch[0])).movedim(-1, 0)
        for i, (row, column) in enumerate(places):
            block = whole[..., row * d : (row + 1) * d, column * d : (column + 1) * d]
            block.diagonal(dim1=-2, dim2=-1).copy_(entries[..., i, :])
        return whole
    place = torch.zeros(p * d, n * n, dtype=entries.dtype, device=entries.device)
    for i, (row, column) in enumerate(places):
        for axis in range(d):
            place[i * d + axis, (row * d + axis) * n + column * d + axis] = 1
    spread: Tensor = (entries.flatten(-2) @ place).unflatten(-1, (n, n))
    return spread


def _record(state: Any, residual: Tensor, frame: Frame, spread: Tensor, info: Any) -> Record:
    """What is kept of a step; the covariance unfolds in ``finish``."""
    std = spread.expand_as(residual)
    whitened = residual * frame.noise.scale
    std = torch.where(frame.seen > 0, std, 1.0)
    return Record(Gaussian(state.mean, state.root), whitened, std.diag_embed(), whitened / std, info)
