"""State, info and intermediate results of the bank."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.filters.alphabeta.axes import full_root
from torchfra.types import Gaussian


class Earlier(NamedTuple):
    """The measurement before the last one, used or not."""

    z: Tensor
    """``(..., d)``."""
    between: Tensor
    """``(..., d)`` seconds between it and the last one."""
    number: Tensor
    """``(..., d)`` number of measurements so far."""


class AlphaBetaBankState(NamedTuple):
    """State after a step; ``g`` is the number of axes, or 1 where all axes decide together."""

    mean: Tensor
    root: Tensor
    """``(..., p, d)``, see ``AlphaBetaState``."""
    start: Tensor
    """``(..., k, d)`` std of position, velocity(, acceleration) of the prior."""
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
    since_last: Tensor
    """``(..., d)`` seconds since it."""
    earlier: Earlier | None
    """What a restart is confirmed by, if it has to be."""
    fastest: Gaussian | None
    """Mean ``(..., n)`` and entries of the root of the fastest filter, if that runs all the time."""

    @property
    def belief(self) -> Gaussian:
        """The estimate."""
        return Gaussian(self.mean, full_root(self.root, self.mean.shape[-1]))


class AlphaBetaInfo(NamedTuple):
    """Per step and track, for each axis, or once where all axes decide together: ``(..., T, g)``."""

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

    @property
    def outlier(self) -> Tensor:
        """``(..., T, g)`` bool: the measurement was rejected."""
        return self.rejected


class AxisInnovation(NamedTuple):
    """A measurement compared with its prediction."""

    z: Tensor
    """``(..., d)`` the measurement."""
    predicted: list[Tensor]
    """Predicted position, velocity(, acceleration)."""
    residual: Tensor
    """``(..., d)``, 0 where nothing was measured."""
    size: Tensor
    """``(..., d)`` of the residual, in std."""
    channels: Tensor
    """``(..., c)`` the residuals that flags are raised by, in std: of each axis, or of range and azimuth."""
    axis_measured: Tensor
    """``(..., d)`` 1 where the axis was measured."""
    measured: Tensor
    """``(..., g)`` 1 where there is something to decide."""
    dt: Tensor
    since: Tensor
    """``(..., g)`` seconds since the last measurement that was used."""
    std: Tensor


class Vote(NamedTuple):
    """The vote on a manoeuvre."""

    flag: Tensor
    """``(..., c)`` raised by this measurement."""
    vote: Tensor
    manoeuvre: Tensor
    quiet: Tensor


class OutlierTest(NamedTuple):
    """The test for outliers, and what follows from it."""

    rejected: Tensor
    """``(..., g)`` 1 for a measurement that is not used."""
    accepted: Tensor
    """``(..., g)`` 1 for one that is."""
    counted: Tensor
    """``(..., g)`` 1 for one that counts as used."""
    in_a_row: Tensor
    """``(..., g)`` rejections since the last measurement that was used."""
    restarted: Tensor
    points: Tensor
    """``(..., g)`` measurements that a restart begins with."""
    again: Tensor
    """``(..., g)`` 1 where the track had started before it restarts."""


def remember(
    state: AlphaBetaBankState, innovation: AxisInnovation, vote: Vote, test: OutlierTest, flag: Tensor
) -> AlphaBetaBankState:
    """Counters, flags and the last measurement after the step; only the last measurement survives a restart.

    Args:
        state: before the step.
        innovation: of the step.
        vote: of the step.
        test: of the step.
        flag: ``(..., c)`` what this measurement leaves in the history.
    """
    keep, measured, axis_measured = 1 - test.restarted, innovation.measured, innovation.axis_measured
    voting = measured * (state.used > 1.5)  # the two points that start a track vote for nothing
    change = voting.unsqueeze(-2) * (_pushed(state.flags, flag) - state.flags)
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
        known=keep * (state.known + voting),
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
