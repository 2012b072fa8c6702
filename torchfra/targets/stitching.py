"""Stitching of broken tracks: a target that is found again has the identity that it had before."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchfra.filters.scans.scan import JPDAState
from torchfra.motion.base import Motion
from torchfra.numbers import fraction, positive
from torchfra.targets.assignment import assigned, chi_square, squared_distance
from torchfra.targets.places import positions
from torchfra.targets.state import Ended, Track, rows
from torchfra.types import Gaussian


class Parts(NamedTuple):
    """Parts of tracks ``(K,)``, lost ones or found ones."""

    belief: Gaussian
    """Now."""
    scene: Tensor
    seconds: Tensor
    """Since each lost one was measured last; since each found one was measured first."""


class Stitching(nn.Module):
    """Gives a newly confirmed track the identity of one that was lost before it began, if the two agree.

    They agree if the lost one, predicted to now, is within ``metres`` of the other and in a gate: that of the
    difference of the whole states, by the sum of their covariances.  The pairs are an assignment: as many as possible,
    with the least sum of squared distances.

    Args:
        seconds: longest time between the last measurement of the lost one and the first of the other.
        metres: largest distance of their positions.
        probability: of the gate.

    Raises:
        ValueError: seconds or metres that are not finite and above 0, or a probability that is not in (0, 1).

    Source: Yeom, Kirubarajan & Bar-Shalom (2004), "Track Segment Association, Fine-Step IMM and Initialization with
    Doppler for Improved Track Performance".  Differs: the lost part is predicted to the scan in which the other is
    confirmed, and that is not predicted back.
    """

    def __init__(self, seconds: float, metres: float, *, probability: float = 0.99) -> None:
        super().__init__()
        self.seconds, self.metres = positive("seconds", seconds), positive("metres", metres)
        self.probability = fraction("probability", probability)

    def forward(self, motion: Motion, lost: Parts, found: Parts) -> tuple[Tensor, Tensor]:
        """Numbers ``(S,)`` of lost parts and of found ones that are of one target each."""
        pairs = Gaussian(*(x.unsqueeze(1) for x in lost.belief)), Gaussian(*(x.unsqueeze(0) for x in found.belief))
        squared = squared_distance(motion, *pairs)
        one, other = (positions(motion, x).mean for x in pairs)
        distance = (one - other).norm(dim=-1)
        between = lost.seconds[:, None] - found.seconds
        allowed = (lost.scene[:, None] == found.scene) & (between > 0) & (between <= self.seconds)
        allowed &= (distance <= self.metres) & (squared <= chi_square(self.probability, motion.size))
        return assigned(squared, allowed)

    def later(self, ended: Ended, track: Track, dt: Tensor) -> Ended:
        """The lost targets ``dt (R,)`` seconds later, without those that no target can be stitched to any more."""
        past = dt[ended.scene]
        ended = ended._replace(since=ended.since + past, deleted=ended.deleted + past)
        tentative = torch.where(track.confirmed, 0.0, track.lived)
        longest = torch.zeros_like(dt).scatter_reduce(0, track.scene, tentative, "amax")
        left: Ended = rows(ended, ended.since <= self.seconds + longest[ended.scene])
        return left

    def extra_repr(self) -> str:
        """Its arguments."""
        return f"seconds={self.seconds:g}, metres={self.metres:g}, probability={self.probability:g}"


def lost(state: JPDAState, track: Track, which: Tensor) -> Ended:
    """Those targets ``which (N,)`` are deleted now, of a filter's ``state``."""
    state, track = rows((state, track), which)
    return Ended(state, track.scene, track.identity, track.since, torch.zeros_like(track.since))
