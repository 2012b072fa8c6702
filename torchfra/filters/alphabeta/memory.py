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
    """State after a step; ``g`` is the number of axes, or 1 if all axes decide together."""

    mean: Tensor
    root: Tensor
    """``(..., p, d)``, see ``AlphaBetaState``."""
    start: Tensor
    """``(..., k, d)`` std of position, velocity(, acceleration) of the prior."""
    used: Tensor
    """``(..., g)`` number of measurements used since the (re)start."""
    since: Tensor
    """``(..., g)`` seconds since the last used measurement."""
    rejected: Tensor
    """``(..., g)`` number of measurements rejected since the last used one."""
    flags: Tensor
    """``(..., votes, c)`` flags of the last measurements, the newest first; ``c`` is an axis, or range and azimuth."""
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
    """Number of the filter that was used, from 0 (the fastest); at a rejected step that of the step before."""
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


def remember(
    state: AlphaBetaBankState, innovation: AxisInnovation, vote: Vote, test: OutlierTest, flag: Tensor
) -> AlphaBetaBankState:
    """The state with counters, flags and last measurement after the step; a restart keeps the last measurement alone.

    Args:
        state: before the step.
        innovation: of the step.
        vote: of the step.
        test: of the step.
        flag: ``(..., c)`` the flag that the history keeps of this measurement.
    """
    keep, measured, axis_measured = 1 - test.restarted, innovation.measured, innovation.axis_measured
    voting = measured * (state.used > 1.5)  # the two points that start a track have no vote
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
