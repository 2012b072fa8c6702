"""Merging of tracks of one target."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchfra.motion.base import Motion
from torchfra.numbers import positive
from torchfra.targets.assignment import squared_distance
from torchfra.targets.clusters import Group
from torchfra.targets.state import Track, rows
from torchfra.types import Gaussian


class Merging(nn.Module):
    """Merges targets of one cluster whose states hardly differ: the confirmed one stays, otherwise the older.

    Whole states are compared, so that targets whose paths cross are not merged.  Tracks of one target share its
    measurements, so that their difference is far smaller than the sum of their covariances.

    Args:
        distance: root of the mean square of the difference, in standard deviations of each component, below which two
            are one.

    Raises:
        ValueError: a distance that is not finite and above 0.

    Source: the test of Bar-Shalom (1981), "On the Track-to-Track Correlation Problem", with a threshold far below that
    of chance.
    """

    def __init__(self, distance: float = 0.3) -> None:
        super().__init__()
        self.distance = positive("distance", distance)

    def forward(self, motion: Motion, belief: Gaussian, track: Track, groups: list[Group]) -> Tensor:
        """Which targets ``(N,)`` are deleted as duplicates of another.

        Args:
            motion: of the targets.
            belief: ``(N,)``.
            track: of each.
            groups: clusters of them.
        """
        deleted = torch.zeros_like(track.confirmed)
        for targets in (group.targets for group in groups if group.targets.shape[-1] > 1):
            one, other = targets[:, torch.combinations(torch.arange(targets.shape[-1]))].flatten(0, 1).unbind(-1)
            apart = squared_distance(motion, rows(belief, one), rows(belief, other))
            same = apart / motion.size < self.distance**2
            rank = [track.confirmed[x].to(torch.int64) for x in (one, other)]
            older = track.identity[one] < track.identity[other]
            stays = (rank[0] > rank[1]) | ((rank[0] == rank[1]) & older)
            deleted[torch.where(stays, other, one)[same]] = True
        return deleted

    def extra_repr(self) -> str:
        """The distance."""
        return f"distance={self.distance:g}"
