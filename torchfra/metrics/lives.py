"""Track metrics over the lives of targets: lengths, time to confirm, switches, fragmentation and false tracks."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchfra.running.optional import optional


class Lives(NamedTuple):
    """Track metrics of M targets and N tracks; counts in scans."""

    length: Tensor
    """``(..., M)`` scans in which the target is there."""
    followed: Tensor
    """``(..., M)`` scans in which a track follows it; 0 for a target that was missed altogether."""
    longest: Tensor
    """``(..., M)`` most scans in a row in which one and the same track follows it: the track length."""
    begun: Tensor
    """``(..., M)`` scans that it is there before a track follows it first: the time to confirm; NaN for never."""
    switches: Tensor
    """``(..., M)`` how often another track follows it than the last one that did."""
    breaks: Tensor
    """``(..., M)`` how often it is lost and found again, by whichever track: fragmentation."""
    track_length: Tensor
    """``(..., N)`` scans in which the track is there."""
    false: Tensor
    """``(..., N)`` scans in which it follows no target; a track that never follows one is a false track."""

    @property
    def false_tracks(self) -> Tensor:
        """``(...)`` how many tracks never follow a target."""
        return ((self.track_length > 0) & (self.false == self.track_length)).sum(-1)

    @property
    def missed_targets(self) -> Tensor:
        """``(...)`` how many targets no track ever follows."""
        return ((self.length > 0) & (self.followed == 0)).sum(-1)


def lives(mean: Tensor, truth: Tensor, states: slice, *, cutoff: float = 100.0) -> Lives:
    """How each target is followed over its life.

    In each scan a track keeps following the target that it followed in the last one, while both exist and are closer
    than ``cutoff``.  The other tracks and targets are assigned to each other: as many pairs closer than ``cutoff`` as
    possible, with the least sum of distances.

    Args:
        mean: ``(..., N, T, n)`` estimates, each of one identity; NaN where it does not exist.
        truth: ``(..., M, T, n)``; NaN where the target does not exist.
        states: the components to compare, ``scenario.position`` say; where that raises, ``scenario.truth_position``
            after ``scenario.cartesian``.
        cutoff: distance from which on a track does not follow a target, m.

    Raises:
        ImportError: scipy is not installed.
        ValueError: a cutoff that is not above 0, an infinite one, or shapes that do not match.

    Source: Bernardin & Stiefelhagen (2008), "Evaluating Multiple Object Tracking Performance: The CLEAR MOT Metrics",
    for the matching and the switches; Li, Huang & Nevatia (2009) for fragmentation; Gorji, Tharmarasa & Kirubarajan
    (2011), "Performance Measures for Multiple Target Tracking Problems", for the lengths and false tracks.
    """
    estimates, targets, batch = tracks_and_targets(mean, truth, states, cutoff)
    follower = np.full(targets.shape[:-1], -1)
    for i, (e, t) in enumerate(zip(estimates, targets, strict=True)):
        follower[i] = _followers(e, t, cutoff)
    there = [torch.from_numpy(~np.isnan(x).any(-1)) for x in (targets, estimates)]
    counts = _counts(torch.from_numpy(follower), *there)
    return Lives(*(x.reshape(*batch, x.shape[-1]).to(mean.device) for x in counts))


def tracks_and_targets(
    mean: Tensor, truth: Tensor, states: slice, cutoff: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], tuple[int, ...]]:
    """The compared components of estimates ``(B, N, T, d)`` and targets ``(B, M, T, d)``, and the batch.

    Raises:
        ValueError: a cutoff that is not above 0, an infinite one, or shapes that do not match.
    """
    if not 0 < cutoff < torch.inf:
        raise ValueError(f"cutoff: expected finite metres above 0, received {cutoff}")
    batch, fits = mean.shape[:-3], min(mean.dim(), truth.dim()) >= 3 and mean.shape[-2] == truth.shape[-2]
    if not fits or truth.shape[:-3] != batch:
        raise ValueError(
            f"mean, truth: expected (..., N, T, n) and (..., M, T, n), received {tuple(mean.shape)} and "
            f"{tuple(truth.shape)}"
        )
    estimates, targets = (
        x[..., states].detach().double().cpu().reshape(math.prod(batch), *x[..., states].shape[-3:]).numpy()
        for x in (mean, truth)
    )
    return estimates, targets, batch


def least_cost(cost: NDArray[np.generic]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of the assignment of least ``cost (M, N)``.

    Raises:
        ImportError: scipy is not installed.
    """
    rows, columns = optional("scipy.optimize", "assignment", "assignment").linear_sum_assignment(cost)
    return rows, columns


def _followers(estimates: NDArray[np.float64], targets: NDArray[np.float64], cutoff: float) -> NDArray[np.int64]:
    """The track ``(M, T)`` that follows each target in each scan; -1 for none."""
    follower = np.full(targets.shape[:2], -1)
    last: NDArray[np.int64] = np.full(len(targets), -1)
    for t in range(targets.shape[1]):
        gap = np.linalg.norm(targets[:, None, t] - estimates[None, :, t], axis=-1)
        near = gap < cutoff  # nothing is near what does not exist
        kept = np.flatnonzero(last >= 0)
        kept = kept[near[kept, last[kept]]]
        follower[kept, t] = last[kept]
        near[kept], near[:, last[kept]] = False, False
        rows, columns = (np.flatnonzero(near.any(axis)) for axis in (1, 0))
        if len(rows):
            # Any pair that is near costs less than none.
            cost = np.where(near, gap, 1e3 * cutoff * len(targets))[np.ix_(rows, columns)]
            i, j = least_cost(cost)
            good = near[rows[i], columns[j]]
            follower[rows[i[good]], t] = columns[j[good]]
        last[:] = follower[:, t]
    return follower


def _counts(follower: Tensor, target: Tensor, track: Tensor) -> tuple[Tensor, ...]:
    """The fields of ``Lives`` from followers ``(B, M, T)`` and who is there, ``(B, M, T)`` and ``(B, N, T)``."""
    followed = follower >= 0
    run = longest = torch.zeros(follower.shape[:2], dtype=torch.int64)
    last, before = torch.full_like(run, -1), torch.full_like(run, -1)
    switches, breaks = torch.zeros_like(run), torch.zeros_like(run)
    for now in follower.unbind(-1):
        run = torch.where(now < 0, 0, torch.where(now == before, run + 1, 1))
        longest = torch.maximum(longest, run)
        again = (now >= 0) & (last >= 0)
        switches, breaks = switches + (again & (now != last)), breaks + (again & (before < 0))
        last, before = torch.where(now >= 0, now, last), now
    first = torch.where(followed.any(-1), followed.int().argmax(-1), -1)
    until = torch.arange(follower.shape[-1]) < first.unsqueeze(-1)
    begun = torch.where(first >= 0, (target & until).sum(-1).double(), torch.nan)
    busy = torch.zeros(len(track), track.shape[1] + 1, track.shape[2], dtype=torch.bool)
    busy.scatter_(1, follower + 1, torch.ones_like(followed))  # the first row is that of no track
    false = (track & ~busy[:, 1:]).sum(-1)
    return target.sum(-1), followed.sum(-1), longest, begun, switches, breaks, track.sum(-1), false
