"""What becomes of the bank's beliefs in a step, after its decisions."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchfra.filters.alphabeta.axes import (
    corrected_root,
    predicted,
    root_ahead,
    root_rows,
    short_step_gains,
    startup_gains,
    updated,
)
from torchfra.filters.alphabeta.decisions import Decisions
from torchfra.filters.alphabeta.levels import of_level, one_level
from torchfra.filters.alphabeta.memory import AlphaBetaBankState, Innovation, OutlierTest, Vote
from torchfra.types import Gaussian


class Updates(Decisions):
    """Abstract: beliefs, whose roots are entries ``(..., p, d)``."""

    def update(
        self, state: AlphaBetaBankState, innovation: Innovation, vote: Vote, test: OutlierTest, level: Tensor
    ) -> tuple[Gaussian, Gaussian | None]:
        """The belief after the step, and that of the fastest filter if it runs all the time."""
        belief = self._corrected(state, innovation, test, Gaussian(state.mean, state.root), level)
        restart, fastest = _restarted(state, innovation, test.points), state.fastest
        if fastest is not None:
            fastest = self._corrected(state, innovation, test, fastest, one_level(0, level))
            onset = self._of_states(vote.manoeuvre * (1 - state.manoeuvre))
            mean, root = belief.mean, belief.scale_tril
            root = torch.lerp(root, fastest.scale_tril, (vote.manoeuvre * (1 - state.manoeuvre)).unsqueeze(-2))
            belief = Gaussian(mean + onset * (fastest.mean - mean), root)
            fastest = self._where(test.restarted, restart, fastest)
        if math.isfinite(self.longest):
            lost = (innovation.since > self.longest) * (state.used > 0.5) * (1 - test.accepted)
            belief = belief._replace(
                scale_tril=torch.where(lost.unsqueeze(-2) > 0, _lost_root(state, innovation), belief.scale_tril)
            )
        return self._where(test.restarted, restart, belief), fastest

    def _corrected(
        self, state: AlphaBetaBankState, innovation: Innovation, test: OutlierTest, belief: Gaussian, level: Tensor
    ) -> Gaussian:
        """A belief after the step, by the gains of a level."""
        ahead = predicted(self._components(belief.mean), innovation.dt)
        rows = root_ahead(root_rows(belief.scale_tril), innovation.dt)
        used, since = (1 - test.rejected) * innovation.axis_measured, innovation.since
        hypers = [self.alpha, self.beta] + ([] if self.gamma is None else [self.gamma])
        gains = [of_level(level, h(innovation.residual)) for h in hypers]
        if self.gamma is not None:
            has_gamma = of_level(level, (self.gamma(innovation.residual) > 0).to(used))
            gains[2], ahead[2], rows[2] = gains[2] / 2, has_gamma * ahead[2], [has_gamma * x for x in rows[2]]
        count = state.used * (state.used > 1.5) if self.confirm else state.used
        gains = startup_gains(short_step_gains(gains, since, self.period), count)
        mean = torch.cat(updated(ahead, gains, since, used * (innovation.z - ahead[0])), -1)
        return Gaussian(mean, corrected_root(rows, gains, since, used, innovation.std))

    def _where(self, mask: Tensor, yes: Gaussian, no: Gaussian) -> Gaussian:
        """The one or the other belief, for each axis."""
        mean = torch.where(self._of_states(mask) > 0, yes.mean, no.mean)
        return Gaussian(mean, torch.where(mask.unsqueeze(-2) > 0, yes.scale_tril, no.scale_tril))

    def _of_states(self, decision: Tensor) -> Tensor:
        """A decision ``(..., g)`` for each state ``(..., n)``."""
        return torch.cat([decision.expand(*decision.shape[:-1], self.motion.dims)] * self.motion.orders, -1)


def _restarted(state: AlphaBetaBankState, innovation: Innovation, points: Tensor) -> Gaussian:
    """Mean and entries of the root of a track that begins with the last two measurements, or with the last alone."""
    two, since, std = points - 1, state.since_last + innovation.dt, innovation.std
    speed = two * (innovation.z - state.last) / since
    along = two * std / since
    entries, more = [std, along, along + (1 - two) * state.start[..., 1, :]], state.start.shape[-2] > 2
    if more:
        entries += [0 * std, 0 * std, state.start[..., 2, :]]
    parts = [innovation.z, speed] + [0 * speed] * (state.mean.shape[-1] // speed.shape[-1] - 2)
    return Gaussian(torch.cat(torch.broadcast_tensors(*parts), -1), torch.stack(torch.broadcast_tensors(*entries), -2))


def _lost_root(state: AlphaBetaBankState, innovation: Innovation) -> Tensor:
    """Entries of the root of a track of which nothing was used for long: it has any speed since then."""
    speed = state.start[..., 1, :]
    entries = [innovation.since * speed, speed, 0 * speed]
    if state.start.shape[-2] > 2:
        entries += [0 * speed, 0 * speed, state.start[..., 2, :]]
    return torch.stack(torch.broadcast_tensors(*entries), -2)
