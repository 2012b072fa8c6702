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
from torchfra.filters.alphabeta.axes import (
    ConstantGainFilter,
    corrected_root,
    full_root,
    predict_axes,
    predict_root,
    record,
    residual_spread,
    root_rows,
    root_spreads,
    short_step_gains,
    startup_gains,
    update_axes,
)
from torchfra.filters.alphabeta.gains import Gains
from torchfra.filters.soft import Soft
from torchfra.gaussian.inputs import Frame
from torchfra.hyper import Hyper, Value, one_of
from torchfra.motion.base import Motion
from torchfra.numbers import as_number, as_numbers
from torchfra.sensors.base import Sensor
from torchfra.steps.records import Record
from torchfra.types import Gaussian

_VOTES = 2  # flags before the newest one
_PATIENCE = 5  # rejections in a row after which the next one restarts the filter
_WARMUP = 5  # measurements before the first decision


class Earlier(NamedTuple):
    """The measurement before the last one, used or not."""

    z: Tensor
    """``(..., d)``."""
    between: Tensor
    """``(..., d)`` seconds between it and the last one."""
    number: Tensor
    """``(..., d)`` number of measurements so far."""


class AlphaBetaBankState(NamedTuple):
    """State after a step; ``g`` is the number of axes, or 1 if all axes decide together."""

    mean: Tensor
    root: Tensor
    """``(..., p, d)``, see ``AlphaBetaState``."""
    prior_std: Tensor
    """``(..., k, d)`` std of position, velocity(, acceleration) of the prior."""
    used: Tensor
    """``(..., g)`` number of measurements used since the (re)start."""
    since: Tensor
    """``(..., g)`` seconds since the last used measurement."""
    rejected: Tensor
    """``(..., g)`` number of measurements rejected since the last used one."""
    flags: Tensor
    """``(..., 2, c)`` flags of the last two measurements, the newest first; ``c`` is an axis, or range and azimuth."""
    flag_count: Tensor
    """``(..., g)`` number of flags in the history."""
    manoeuvre: Tensor
    """``(..., g)`` 1 in a manoeuvre."""
    quiet: Tensor
    """``(..., g)`` steps since the last vote for a manoeuvre."""
    level: Tensor
    """``(..., g, N)`` the filter that was used last."""
    last: Tensor
    """``(..., d)`` the last measurement, used or not."""
    since_last: Tensor
    """``(..., d)`` seconds since the last measurement."""
    earlier: Earlier | None
    """The measurement before the last one, by which a restart is confirmed; None without ``confirm``."""
    fastest: Gaussian | None
    """Mean ``(..., n)`` and entries of the root of the fastest filter, if it runs all the time."""

    @property
    def belief(self) -> Gaussian:
        """The estimate."""
        return Gaussian(self.mean, full_root(self.root, self.mean.shape[-1]))


class AlphaBetaInfo(NamedTuple):
    """Per step and track, for each axis, or once if all axes decide together: ``(..., T, g)``."""

    level: Tensor
    """Index of the filter that was used, from 0 (the fastest); at a rejected step that of the step before."""
    vote: Tensor
    """bool: the flags voted for a manoeuvre."""
    manoeuvre: Tensor
    """bool: the step is treated as part of a manoeuvre."""
    rejected: Tensor
    """bool: the measurement was rejected as an outlier."""
    restarted: Tensor
    """bool: the track restarted, after too many rejections or too long without a used measurement."""

    @property
    def outlier(self) -> Tensor:
        """``(..., T, g)`` probability of an outlier: 1 if the measurement was rejected, else 0."""
        return self.rejected.float()


class AxisInnovation(NamedTuple):
    """A measurement compared with its prediction."""

    z: Tensor
    """``(..., d)`` the measurement."""
    predicted: list[Tensor]
    """Predicted position, velocity(, acceleration)."""
    residual: Tensor
    """``(..., d)``, 0 where nothing was measured."""
    size: Tensor
    """``(..., d)`` absolute residual, in std."""
    channels: Tensor
    """``(..., c)`` the absolute residuals that raise flags, in std: of each axis, or of range and azimuth."""
    axis_measured: Tensor
    """``(..., d)`` 1 where the axis was measured."""
    measured: Tensor
    """``(..., g)`` 1 where all axes of a decision were measured."""
    dt: Tensor
    since: Tensor
    """``(..., g)`` seconds since the last used measurement."""
    std: Tensor


class Vote(NamedTuple):
    """The vote on a manoeuvre."""

    flag: Tensor
    """``(..., c)`` raised by this measurement."""
    vote: Tensor
    manoeuvre: Tensor
    quiet: Tensor


class OutlierTest(NamedTuple):
    """The test for outliers, and restarts."""

    rejected: Tensor
    """``(..., g)`` 1 for a rejected measurement."""
    accepted: Tensor
    """``(..., g)`` 1 for an accepted measurement."""
    counted: Tensor
    """``(..., g)`` 1 for a measurement that ``used`` counts."""
    in_a_row: Tensor
    """``(..., g)`` number of rejections since the last used measurement."""
    restarted: Tensor
    """``(..., g)`` 1 where the track starts or restarts."""
    points: Tensor
    """``(..., g)`` number of measurements that a restart begins with."""
    again: Tensor
    """``(..., g)`` 1 where a track restarts that had started before."""


class AlphaBetaBank(Soft, ConstantGainFilter[AlphaBetaBankState]):
    """Alpha-beta filters that share one state and switch their gains with the data: small gains for straight flight.

    A residual above ``manoeuvre`` raises a flag; two of the last three flags vote for a manoeuvre.  Without a
    manoeuvre, a residual beyond ``outlier`` is rejected and the track is extrapolated; in a manoeuvre, only a residual
    that the target cannot reach is rejected.  With the sixth rejection in a row the filter restarts from the last two
    measurements.  Until five measurements are used, the fastest level is in use and nothing votes.

    ``Estimate.scale_tril`` is a root of the covariance of errors by the prior and the measurement noise under the gains
    in use: it grows while measurements are missing or rejected.  Errors by manoeuvres are not in it.

    All choices are hard.  With a ``temperature`` they are soft, for training: each comparison becomes a sigmoid (in
    units of its threshold), and gains are mixed.  ``f.temperature = 0`` makes a trained filter hard; restarts are
    always hard.

    Args:
        motion: constant velocity, or acceleration for levels with three gains (with two it stays 0); only its
            dimensions and orders count.
        sensor: a ``Position``; its std is the unit of the thresholds.
        gains: of the levels, the fastest first, ``(N,)``; ``gamma`` is 0 for levels of two gains.
            ``torchfra.filters.alphabeta.gains.levels`` if None.
        manoeuvre: residual that raises a flag, in std; None for 3 times the slowest filter's own.
        outlier: residual that is rejected outside manoeuvres, in std; None for 3 times ``manoeuvre``.
        level_shares: ``(N - 2,)`` falling shares of ``manoeuvre``: the thresholds of the residual between the
            levels that a manoeuvre uses.
        max_acceleration: largest acceleration of the target, m/s^2.
        margin: residual in std that is never rejected in a manoeuvre.
        hysteresis: share of ``manoeuvre`` that raises a flag while in a manoeuvre.
        dwell: steps without a vote after which a manoeuvre ends.
        max_gap: seconds without a used measurement after which the next measurement restarts the filter.
        detect: ``"cartesian"``: each axis decides by itself; ``"polar"``: range and horizontal azimuth from the origin
            decide for all axes.
        onset: the state at the onset of a manoeuvre: ``"shared"`` the one as it is, which lags after small gains, or
            ``"fastest"`` that of the fastest filter, which then runs all the time.
        temperature: 0 for hard choices, above for soft ones; an attribute that may be changed at any time.
        period: seconds between measurements for which the gains are designed; shorter steps have smaller gains.  None
            for steps that hardly differ.
        confirm: whether a start or restart from two measurements needs a third one that the target can reach from them
            by ``max_acceleration`` and ``margin``.  Until such a one comes, a start uses the newest measurement at a
            velocity of 0, and a track is not restarted.

    Raises:
        ValueError: gains that are not stable or whose levels do not slow down, or an argument out of its range.

    Source: Xu et al., "multilevel combined alpha-beta filter"; reconstructed where its formulas are lost.  Differs:
    after rejections the velocity gain is divided by the time since the last used measurement.  ``onset``,
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
        level_shares: Value | None = None,
        max_acceleration: Value = 60.0,
        margin: Value = 3.0,
        hysteresis: Value = 0.5,
        dwell: Value = 3.0,
        max_gap: float = math.inf,
        detect: str = "cartesian",
        onset: str = "shared",
        temperature: float = 0.0,
        period: Value | None = None,
        confirm: bool = False,
    ) -> None:
        super().__init__(motion, sensor, period)
        self.max_gap, self.detect, self.onset, self.confirm = max_gap, detect, onset, confirm
        self._check()
        gains = design.levels(motion.orders) if gains is None else gains
        self._set_levels(gains)
        self._set_thresholds(gains, manoeuvre, outlier, level_shares)
        self.max_acceleration = Hyper(max_acceleration, name="max_acceleration")
        self.margin = Hyper(margin, constraints.nonnegative, name="margin")
        self.hysteresis = Hyper(hysteresis, constraints.interval(0.0, 1.0), name="hysteresis")
        self.dwell = Hyper(dwell, constraints.greater_than_eq(1.0), name="dwell")
        self.temperature = temperature

    def _check(self) -> None:
        """Checks all arguments but gains and thresholds."""
        one_of(detect=(self.detect, ("cartesian", "polar")), onset=(self.onset, ("shared", "fastest")))
        if not as_number(self.max_gap) > 0:
            raise ValueError(f"max_gap: expected seconds above 0, received {self.max_gap!r}")
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
            None
            if gains.gamma is None
            else Hyper(gains.gamma, constraints.nonnegative, event_dim=1, finite=True, name="gamma")
        )

    def _set_thresholds(
        self, gains: Gains, manoeuvre: Value | None, outlier: Value | None, level_shares: Value | None
    ) -> None:
        slowest = 1 + design.variances(gains.alpha[..., -1], gains.beta[..., -1]).prediction
        manoeuvre = 3 * slowest.sqrt() if manoeuvre is None else as_numbers(manoeuvre, "manoeuvre").double()
        outlier = 3 * manoeuvre if outlier is None else as_numbers(outlier, "outlier").double()
        if bool((outlier < manoeuvre).any()):
            raise ValueError(f"outlier: expected {manoeuvre.tolist()} or more, received {outlier.tolist()}")
        between = gains.alpha.shape[-1] - 2
        falling = torch.linspace(0.9, 0.9 / max(between, 1), between, dtype=torch.float64)
        level_shares = falling if level_shares is None else as_numbers(level_shares, "level_shares").double()
        if level_shares.shape[-1:] != (between,) or not bool((level_shares.diff() < 0).all()):
            raise ValueError(f"level_shares: expected ({between},), falling, received {level_shares.tolist()}")
        self.level_shares = Hyper(level_shares, event_dim=1, name="level_shares")
        self.manoeuvre, self.outlier = Hyper(manoeuvre, name="manoeuvre"), Hyper(outlier, name="outlier")

    def begin(self, belief: Gaussian) -> AlphaBetaBankState:
        """The state before the first measurement: nothing used, no flags, the fastest level."""
        mean, axes = self._first(belief)
        root = self._first_root(belief)
        polar = self.detect == "polar"
        zero = axes[..., :1] if polar else axes
        channels = axes[..., :2] if polar else axes
        return AlphaBetaBankState(
            mean=mean,
            root=root,
            prior_std=root_spreads(root),
            used=zero,
            since=zero,
            rejected=zero,
            flags=channels.unsqueeze(-2).expand(*channels.shape[:-1], _VOTES, -1),
            flag_count=zero,
            manoeuvre=zero,
            quiet=zero,
            level=torch.nn.functional.pad(zero.unsqueeze(-1) + 1, (0, self.alpha.raw.shape[-1] - 1)),
            last=axes,
            since_last=axes,
            earlier=Earlier(axes, axes, axes) if self.confirm else None,
            fastest=Gaussian(mean, root) if self.onset == "fastest" else None,
        )

    def advance(self, state: AlphaBetaBankState, frame: Frame) -> tuple[AlphaBetaBankState, Record]:
        """One step, in the order of the paper: manoeuvre vote, outlier test, choice of the level, update."""
        innovation = self.innovation(state, frame)
        vote = self.manoeuvre_vote(state, innovation)
        test = self.outlier_test(state, innovation, vote.manoeuvre)
        level = self.choose_level(state, innovation, vote.manoeuvre, test.accepted)
        belief, fastest = self.update(state, innovation, vote, test, level)
        level = torch.where(test.restarted.unsqueeze(-1) > 0, one_level(0, level), level)
        after = remember(state, innovation, vote, test)
        after = after._replace(mean=belief.mean, root=belief.scale_tril, level=level, fastest=fastest)
        spread = residual_spread(predict_root(root_rows(state.root), innovation.dt), innovation.std)
        belief = Gaussian(after.mean, after.root)
        return after, record(belief, innovation.residual, frame, spread, _info(vote, test, level))

    # ------------------------------------------------------------ decisions, in the order of the paper

    def innovation(self, state: AlphaBetaBankState, frame: Frame) -> AxisInnovation:
        """The measurement compared with its prediction."""
        z, std, dt = frame.z, frame.measurement_noise.std, frame.dt.unsqueeze(-1)
        predicted = predict_axes(self._components(state.mean), dt)
        polar = self.detect == "polar"
        measured = frame.measured.amin(-1, keepdim=True) if polar else frame.measured
        residual = frame.measured * (z - predicted[0])
        size = residual.abs() / std
        channels = _polar(z, predicted[0], std) if polar else size
        since = state.since + dt
        return AxisInnovation(z, predicted, residual, size, channels, frame.measured, measured, dt, since, std)

    def manoeuvre_vote(self, state: AlphaBetaBankState, innovation: AxisInnovation) -> Vote:
        """The vote on a manoeuvre: the flag of this measurement, and the majority of the last flags."""
        channels = innovation.channels
        threshold = self.manoeuvre(channels).unsqueeze(-1)
        threshold = threshold * (1 - state.manoeuvre * (1 - self.hysteresis(channels).unsqueeze(-1)))
        flag = self._above(channels / threshold, 1.0)
        enough = self._above(state.used, _WARMUP - 0.5) * self._above(state.flag_count, _VOTES - 0.5)
        majority = self._above(reduce(torch.add, state.flags.unbind(-2), flag), (_VOTES + 1) / 2)
        vote = enough * self._any(majority) * innovation.measured
        quiet = (1 - vote) * (state.quiet + innovation.measured)
        lasting = self._above(self.dwell(channels).unsqueeze(-1) - quiet, 0.5)
        return Vote(flag, vote, vote + (1 - vote) * state.manoeuvre * lasting, quiet)

    def outlier_test(self, state: AlphaBetaBankState, innovation: AxisInnovation, manoeuvre: Tensor) -> OutlierTest:
        """The test for outliers: a residual above a threshold, or in a manoeuvre beyond reach; and restarts."""
        limit = self._largest_residual(state, innovation, manoeuvre)
        measured, started = innovation.measured, (state.used > 1.5).to(innovation.since)
        rejected = self._any(self._above(innovation.size / limit, 1.0))
        rejected = rejected * measured * started  # the first two points start a track and are never rejected
        any_used = (state.used > 0.5).to(rejected)
        expired = (innovation.since > self.max_gap).to(rejected) * measured * any_used
        rejected = torch.maximum(rejected, expired * started) if self.confirm else rejected * (1 - expired)
        in_a_row, accepted = state.rejected + rejected, (1 - rejected) * measured
        restarted = torch.maximum((in_a_row > _PATIENCE).to(rejected) * (rejected > 0.5), expired)
        if not self.confirm:
            return OutlierTest(rejected, accepted, accepted, in_a_row, restarted, 2 - expired, restarted)
        starting = any_used - started
        restarted = torch.maximum(restarted, starting) * measured * self._confirmed(state, innovation)
        counted, two = accepted * (1 - starting), torch.full_like(rejected, 2.0)
        return OutlierTest(rejected, accepted, counted, in_a_row, restarted, two, restarted * started)

    def _confirmed(self, state: AlphaBetaBankState, innovation: AxisInnovation) -> Tensor:
        """``(..., g)`` 1 where the target can reach this measurement from the last two."""
        assert state.earlier is not None
        before, between, count = state.earlier
        between = torch.where(count > 1.5, between, 1.0)
        since = state.since_last + innovation.dt
        ratio = since / between
        bend = innovation.z - state.last - ratio * (state.last - before)
        limit, margin = (h(bend).unsqueeze(-1) for h in (self.max_acceleration, self.margin))
        noise = innovation.std * (1 + (1 + ratio).square() + ratio.square()).sqrt()
        near = bend.abs() < 0.5 * limit * since * (between + since) + margin * noise
        return 1 - self._any(1 - (near & (count > 1.5)).to(bend))

    def _largest_residual(self, state: AlphaBetaBankState, innovation: AxisInnovation, manoeuvre: Tensor) -> Tensor:
        """``(..., d)`` in std: the reach of the target in a manoeuvre, otherwise the threshold of outliers."""
        flagged_steps = self._flags_in_a_row(state)
        reach = innovation.since + innovation.dt * flagged_steps * (1 - self._above(state.rejected, 0.5))
        limit, margin, outlier = (h(reach).unsqueeze(-1) for h in (self.max_acceleration, self.margin, self.outlier))
        reached = 0.5 * limit * reach.square() / innovation.std + margin
        largest: Tensor = manoeuvre * reached + (1 - manoeuvre) * outlier
        return largest

    def _flags_in_a_row(self, state: AlphaBetaBankState) -> Tensor:
        """``(..., g)`` number of successive flags immediately before this step."""
        last, before = (self._any(flags) for flags in state.flags.unbind(-2))
        return last + last * before

    def choose_level(
        self, state: AlphaBetaBankState, innovation: AxisInnovation, manoeuvre: Tensor, accepted: Tensor
    ) -> Tensor:
        """Shares ``(..., g, N)`` of the levels, a single 1 for hard choices; a rejected step keeps those before."""
        channels = innovation.channels
        converged = self._above(state.used, _WARMUP - 0.5)
        degree = channels if self.detect == "cartesian" else channels.amax(-1, keepdim=True)
        degree = degree / self.manoeuvre(degree).unsqueeze(-1)
        zero = torch.zeros_like(converged)
        over = [self._above(degree / q, 1.0) for q in self.level_shares(degree).unsqueeze(-2).unbind(-1)]
        within = [b - a for a, b in pairwise([zero, *over, zero + 1])]
        manoeuvring = converged * manoeuvre
        shares = [manoeuvring * w + (1 - converged) * (i == 0) for i, w in enumerate(within)]
        level = torch.stack(torch.broadcast_tensors(*shares, converged * (1 - manoeuvre)), -1)
        return torch.lerp(state.level, level, accepted.unsqueeze(-1))

    def _above(self, x: Tensor, threshold: float) -> Tensor:
        """1 where ``x`` is larger, else 0; with soft choices a sigmoid."""
        return torch.sigmoid((x - threshold) / self.temperature) if self.soft else (x > threshold).to(x)

    def _any(self, flags: Tensor) -> Tensor:
        """Decisions ``(..., g)`` from those of channels: for each axis, or for all axes if any channel decides."""
        if self.detect == "cartesian":
            return flags
        none: Tensor = reduce(torch.mul, (1 - flags).split(1, -1))
        return 1 - none

    # ------------------------------------------------------------ the update of beliefs

    def update(
        self, state: AlphaBetaBankState, innovation: AxisInnovation, vote: Vote, test: OutlierTest, level: Tensor
    ) -> tuple[Gaussian, Gaussian | None]:
        """The belief after the step, and that of the fastest filter if that runs all the time."""
        belief = self._corrected(state, innovation, test, Gaussian(state.mean, state.root), level)
        restart, fastest = _restarted(state, innovation, test.points), state.fastest
        if fastest is not None:
            fastest = self._corrected(state, innovation, test, fastest, one_level(0, level))
            onset = self._of_states(vote.manoeuvre * (1 - state.manoeuvre))
            mean, root = belief.mean, belief.scale_tril
            root = torch.lerp(root, fastest.scale_tril, (vote.manoeuvre * (1 - state.manoeuvre)).unsqueeze(-2))
            belief = Gaussian(mean + onset * (fastest.mean - mean), root)
            fastest = self._where(test.restarted, restart, fastest)
        if math.isfinite(self.max_gap):
            lost = (innovation.since > self.max_gap) * (state.used > 0.5) * (1 - test.accepted)
            belief = belief._replace(
                scale_tril=torch.where(lost.unsqueeze(-2) > 0, _lost_root(state, innovation), belief.scale_tril)
            )
        return self._where(test.restarted, restart, belief), fastest

    def _corrected(
        self, state: AlphaBetaBankState, innovation: AxisInnovation, test: OutlierTest, belief: Gaussian, level: Tensor
    ) -> Gaussian:
        """A belief after the step, by the gains of a level."""
        predicted = predict_axes(self._components(belief.mean), innovation.dt)
        rows = predict_root(root_rows(belief.scale_tril), innovation.dt)
        used, since = (1 - test.rejected) * innovation.axis_measured, innovation.since
        hypers = [self.alpha, self.beta] + ([] if self.gamma is None else [self.gamma])
        gains = [of_level(level, h(innovation.residual)) for h in hypers]
        if self.gamma is not None:
            has_gamma = of_level(level, (self.gamma(innovation.residual) > 0).to(used))
            gains[2], predicted[2], rows[2] = gains[2] / 2, has_gamma * predicted[2], [has_gamma * x for x in rows[2]]
        count = state.used * (state.used > 1.5) if self.confirm else state.used
        gains = startup_gains(short_step_gains(gains, since, self.period), count)
        mean = torch.cat(update_axes(predicted, gains, since, used * (innovation.z - predicted[0])), -1)
        return Gaussian(mean, corrected_root(rows, gains, since, used, innovation.std))

    def _where(self, mask: Tensor, yes: Gaussian, no: Gaussian) -> Gaussian:
        """One of two beliefs for each axis, by ``mask (..., g)``."""
        mean = torch.where(self._of_states(mask) > 0, yes.mean, no.mean)
        return Gaussian(mean, torch.where(mask.unsqueeze(-2) > 0, yes.scale_tril, no.scale_tril))

    def _of_states(self, decision: Tensor) -> Tensor:
        """A decision ``(..., g)``, expanded to the components of the state ``(..., n)``."""
        return torch.cat([decision.expand(*decision.shape[:-1], self.motion.dims)] * self.motion.orders, -1)


def _info(vote: Vote, test: OutlierTest, level: Tensor) -> AlphaBetaInfo:
    index = reduce(torch.add, (i * level[..., i] for i in range(level.shape[-1])))
    return AlphaBetaInfo(index, vote.vote > 0.5, vote.manoeuvre > 0.5, test.rejected > 0.5, test.again > 0)


def _polar(z: Tensor, predicted: Tensor, std: Tensor) -> Tensor:
    """Residuals ``(..., 2)`` of range and azimuth, in std."""
    ground = predicted[..., :2].square().sum(-1)
    safe = torch.where(ground > 0, ground, 1.0).sqrt()
    cross = predicted[..., 0] * z[..., 1] - predicted[..., 1] * z[..., 0]
    dot = (predicted[..., :2] * z[..., :2]).sum(-1)
    along_circle = torch.atan2(cross, dot) * safe  # metres
    radial = z.square().sum(-1).sqrt() - predicted.square().sum(-1).sqrt()
    return torch.stack([radial.abs(), along_circle.abs()], -1) / std.mean(-1, keepdim=True)


def _restarted(state: AlphaBetaBankState, innovation: AxisInnovation, points: Tensor) -> Gaussian:
    """Mean and entries of the root of a track that starts from the last two measurements, or from the last alone."""
    two, since, std = points - 1, state.since_last + innovation.dt, innovation.std
    speed = two * (innovation.z - state.last) / since
    along = two * std / since
    entries, more = [std, along, along + (1 - two) * state.prior_std[..., 1, :]], state.prior_std.shape[-2] > 2
    if more:
        entries += [0 * std, 0 * std, state.prior_std[..., 2, :]]
    parts = [innovation.z, speed] + [0 * speed] * (state.mean.shape[-1] // speed.shape[-1] - 2)
    return Gaussian(torch.cat(torch.broadcast_tensors(*parts), -1), torch.stack(torch.broadcast_tensors(*entries), -2))


def _lost_root(state: AlphaBetaBankState, innovation: AxisInnovation) -> Tensor:
    """Entries of the root of a track that has used no measurement for ``max_gap``, with the velocity of the prior."""
    speed = state.prior_std[..., 1, :]
    entries = [innovation.since * speed, speed, 0 * speed]
    if state.prior_std.shape[-2] > 2:
        entries += [0 * speed, 0 * speed, state.prior_std[..., 2, :]]
    return torch.stack(torch.broadcast_tensors(*entries), -2)


def one_level(index: int, level: Tensor) -> Tensor:
    """Shares ``(N,)`` with 1 for the level of this index."""
    return torch.eye(level.shape[-1], dtype=level.dtype, device=level.device)[index]


def of_level(level: Tensor, values: Tensor) -> Tensor:
    """Values ``(..., g)`` of the level in use, from those ``(..., N)`` of all and the shares ``(..., g, N)``."""
    parts = [level[..., i] * values[..., i].unsqueeze(-1) for i in range(level.shape[-1])]
    return reduce(torch.add, parts)  # many times faster than a sum over a dimension of few entries


def all_stable(gains: Gains) -> bool:
    """Whether every level is stable; a level whose ``gamma`` is 0 has two gains."""
    alpha, beta, gamma = gains
    if gamma is None:
        return design.stable(gains)
    two = gamma == 0
    parts = [Gains(alpha[two], beta[two])] if bool(two.any()) else []
    parts += [Gains(alpha[~two], beta[~two], gamma[~two])] if bool((~two).any()) else []
    return all(map(design.stable, parts))


def remember(
    state: AlphaBetaBankState, innovation: AxisInnovation, vote: Vote, test: OutlierTest
) -> AlphaBetaBankState:
    """The state with counters, flags and last measurement after the step; a restart keeps the measurement alone."""
    keep, measured, axis_measured = 1 - test.restarted, innovation.measured, innovation.axis_measured
    voting = measured * (state.used > 1.5)  # the two points that start a track have no vote
    change = voting.unsqueeze(-2) * (_pushed(state.flags, vote.flag) - state.flags)
    since_last = state.since_last + innovation.dt
    earlier = state.earlier
    if earlier is not None:
        z = earlier.z + axis_measured * (state.last - earlier.z)
        between = earlier.between + axis_measured * (since_last - earlier.between)
        earlier = Earlier(z, between, earlier.number + axis_measured)
    return state._replace(
        used=keep * (state.used + test.counted) + test.restarted * test.points,
        since=keep * innovation.since * (1 - test.accepted),
        rejected=keep * test.in_a_row * (1 - test.accepted),
        flags=keep.unsqueeze(-2) * (state.flags + change),
        flag_count=keep * (state.flag_count + voting),
        manoeuvre=keep * (state.manoeuvre + measured * (vote.manoeuvre - state.manoeuvre)),
        quiet=keep * vote.quiet,
        last=state.last + axis_measured * (innovation.z - state.last),
        since_last=since_last * (1 - axis_measured),
        earlier=earlier,
    )


def _pushed(flags: Tensor, flag: Tensor) -> Tensor:
    """The history of flags with a new one in front and without the oldest."""
    older = flags[..., :-1, :]
    newest = torch.broadcast_tensors(flag.unsqueeze(-2), older)[0]
    return torch.cat([newest[..., :1, :], older.expand(*newest.shape[:-2], -1, -1)], -2)
