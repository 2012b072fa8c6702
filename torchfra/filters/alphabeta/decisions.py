"""The decisions of the bank, in the order of the paper: manoeuvre vote, outlier test, choice of the level."""

from __future__ import annotations

from functools import reduce
from itertools import pairwise

import torch
from torch import Tensor

from torchfra.filters.alphabeta.axes import predicted
from torchfra.filters.alphabeta.base import ConstantGainFilter
from torchfra.filters.alphabeta.levels import of_level, steady_states
from torchfra.filters.alphabeta.memory import AlphaBetaBankState, Innovation, OutlierTest, Vote
from torchfra.filters.soft import Soft
from torchfra.gaussian.inputs import Frame
from torchfra.hyper import Hyper


class Decisions(Soft, ConstantGainFilter[AlphaBetaBankState]):
    """Abstract: what a measurement decides; ``AlphaBetaBank`` says what the attributes are."""

    alpha: Hyper
    beta: Hyper
    manoeuvre: Hyper
    outlier: Hyper
    degrees: Hyper
    limit: Hyper
    margin: Hyper
    hysteresis: Hyper
    dwell: Hyper
    votes: int
    patience: int
    longest: float
    converged: int
    detect: str
    expect: str
    confirm: bool

    def innovation(self, state: AlphaBetaBankState, frame: Frame) -> Innovation:
        """The measurement compared with its prediction."""
        z, std, dt = frame.z, frame.measurement_noise.std, frame.dt.unsqueeze(-1)
        ahead = predicted(self._components(state.mean), dt)
        polar = self.detect == "polar"
        measured = frame.seen.amin(-1, keepdim=True) if polar else frame.seen
        residual = frame.seen * (z - ahead[0])
        size = residual.abs() / std
        channels = _polar(z, ahead[0], std) if polar else size
        return Innovation(z, ahead, residual, size, channels, frame.seen, measured, dt, state.since + dt, std)

    def manoeuvre_vote(self, state: AlphaBetaBankState, innovation: Innovation) -> Vote:
        """Whether this is a manoeuvre: the flag of this measurement, and the majority of the last ones."""
        channels = innovation.channels
        expected = 1.0 if self.expect == "paper" else self._expected_ratio(state.level)
        threshold = self.manoeuvre(channels).unsqueeze(-1) * expected
        threshold = threshold * (1 - state.manoeuvre * (1 - self.hysteresis(channels).unsqueeze(-1)))
        flag = self._above(channels / threshold, 1.0)
        enough = self._above(state.used, self.converged - 0.5) * self._above(state.known, self.votes - 0.5)
        majority = self._above(reduce(torch.add, state.flags.unbind(-2), flag), (self.votes + 1) / 2)
        vote = enough * self._any(majority) * innovation.measured
        quiet = (1 - vote) * (state.quiet + innovation.measured)
        lasting = self._above(self.dwell(channels).unsqueeze(-1) - quiet, 0.5)
        return Vote(flag, vote, vote + (1 - vote) * state.manoeuvre * lasting, quiet)

    def outlier_test(self, state: AlphaBetaBankState, innovation: Innovation, manoeuvre: Tensor) -> OutlierTest:
        """Whether this is an outlier: above a threshold, or in a manoeuvre out of the target's reach; and restarts."""
        limit = self._largest_residual(state, innovation, manoeuvre)
        measured, started = innovation.measured, (state.used > 1.5).to(innovation.since)
        rejected = self._any(self._above(innovation.size / limit, 1.0))
        rejected = rejected * measured * started  # two points start a track, whatever they are
        begun = (state.used > 0.5).to(rejected)
        expired = (innovation.since > self.longest).to(rejected) * measured * begun
        rejected = torch.maximum(rejected, expired * started) if self.confirm else rejected * (1 - expired)
        in_a_row, accepted = state.rejected + rejected, (1 - rejected) * measured
        restarted = torch.maximum((in_a_row > self.patience).to(rejected) * (rejected > 0.5), expired)
        if not self.confirm:
            return OutlierTest(rejected, accepted, accepted, in_a_row, restarted, 2 - expired, restarted)
        starting = begun - started
        restarted = torch.maximum(restarted, starting) * measured * self._confirmed(state, innovation)
        counted, two = accepted * (1 - starting), torch.full_like(rejected, 2.0)
        return OutlierTest(rejected, accepted, counted, in_a_row, restarted, two, restarted * started)

    def _confirmed(self, state: AlphaBetaBankState, innovation: Innovation) -> Tensor:
        """``(..., g)`` 1 where the target can reach this measurement from the last two."""
        assert state.earlier is not None
        before, between, seen = state.earlier
        between = torch.where(seen > 1.5, between, 1.0)
        since = state.since_last + innovation.dt
        ratio = since / between
        bend = innovation.z - state.last - ratio * (state.last - before)
        limit, margin = (h(bend).unsqueeze(-1) for h in (self.limit, self.margin))
        noise = innovation.std * (1 + (1 + ratio).square() + ratio.square()).sqrt()
        near = bend.abs() < 0.5 * limit * since * (between + since) + margin * noise
        return 1 - self._any(1 - (near & (seen > 1.5)).to(bend))

    def _largest_residual(self, state: AlphaBetaBankState, innovation: Innovation, manoeuvre: Tensor) -> Tensor:
        """``(..., d)`` in std: what the target can reach in a manoeuvre, and the threshold of outliers without one."""
        flagged_steps = self._flags_in_a_row(state)
        reach = innovation.since + innovation.dt * flagged_steps * (1 - self._above(state.rejected, 0.5))
        limit, margin, outlier = (h(reach).unsqueeze(-1) for h in (self.limit, self.margin, self.outlier))
        reached = 0.5 * limit * reach.square() / innovation.std + margin
        largest: Tensor = manoeuvre * reached + (1 - manoeuvre) * outlier
        return largest

    def _flags_in_a_row(self, state: AlphaBetaBankState) -> Tensor:
        """``(..., g)`` flags raised without a gap immediately before this step."""
        count, flagged = torch.zeros_like(state.since), self._any(state.flags[..., 0, :])
        for i in range(self.votes):
            count = count + flagged
            flagged = flagged * self._any(state.flags[..., min(i + 1, self.votes - 1), :])
        return count

    def choose_level(
        self, state: AlphaBetaBankState, innovation: Innovation, manoeuvre: Tensor, accepted: Tensor
    ) -> Tensor:
        """Shares ``(..., g, N)`` of the levels; a single 1 where choices are hard.  A rejected step keeps the last."""
        channels = innovation.channels
        converged = self._above(state.used, self.converged - 0.5)
        degree = channels if self.detect == "cartesian" else channels.amax(-1, keepdim=True)
        degree = degree / self.manoeuvre(degree).unsqueeze(-1)
        zero = torch.zeros_like(converged)
        over = [self._above(degree / q, 1.0) for q in self.degrees(degree).unsqueeze(-2).unbind(-1)]
        within = [b - a for a, b in pairwise([zero, *over, zero + 1])]
        manoeuvring = converged * manoeuvre
        shares = [manoeuvring * w + (1 - converged) * (i == 0) for i, w in enumerate(within)]
        level = torch.stack(torch.broadcast_tensors(*shares, converged * (1 - manoeuvre)), -1)
        return torch.lerp(state.level, level, accepted.unsqueeze(-1))

    def _above(self, x: Tensor, threshold: float) -> Tensor:
        """1 where ``x`` is larger, else 0; between the two where choices are soft."""
        return torch.sigmoid((x - threshold) / self.heat) if self.soft else (x > threshold).to(x)

    def _any(self, flags: Tensor) -> Tensor:
        """Decisions ``(..., g)`` from those of channels: one for each axis, or one for all."""
        if self.detect == "cartesian":
            return flags
        none: Tensor = reduce(torch.mul, (1 - flags).split(1, -1))
        return 1 - none

    def _steady_states(self, like: Tensor) -> tuple[list[Tensor], Tensor]:
        return steady_states(self.alpha(like), self.beta(like), None if self.gamma is None else self.gamma(like))

    def _expected_ratio(self, level: Tensor) -> Tensor:
        """How much larger residuals of the level in use are than those of the slowest."""
        variance = self._steady_states(level)[1]
        ratio: Tensor = (of_level(level, variance) / variance[..., -1:]).sqrt()
        return ratio


def _polar(z: Tensor, ahead: Tensor, std: Tensor) -> Tensor:
    """Residuals ``(..., 2)`` of range and azimuth, in std."""
    ground = ahead[..., :2].square().sum(-1)
    safe = torch.where(ground > 0, ground, 1.0).sqrt()
    cross = ahead[..., 0] * z[..., 1] - ahead[..., 1] * z[..., 0]
    dot = (ahead[..., :2] * z[..., :2]).sum(-1)
    along_circle = torch.atan2(cross, dot) * safe  # metres
    radial = z.square().sum(-1).sqrt() - ahead.square().sum(-1).sqrt()
    return torch.stack([radial.abs(), along_circle.abs()], -1) / std.mean(-1, keepdim=True)
