"""Births of targets from unassociated measurements, and the law of their number."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchfra.hyper import Hyper, Part, Value
from torchfra.linalg.triangular import tria
from torchfra.motion.base import Motion
from torchfra.numbers import is_integer, positive
from torchfra.targets.assignment import assigned
from torchfra.targets.places import from_cartesian, known_components
from torchfra.targets.state import TargetsEstimate, Unassociated, joined, rows
from torchfra.types import Gaussian

_SIGMAS = 3.0
"""Standard deviations of the positions by which two of them may be farther apart than the speed allows."""


class Newborn(NamedTuple):
    """Targets ``(K,)`` that begin."""

    belief: Gaussian
    """In the coordinates of the motion."""
    scene: Tensor
    """``(K,)``."""
    hits: int
    """Measurements that each begins with, in as many scans."""
    new: Tensor
    """``(K,)`` probability that nothing that was there explains any of its measurements: see ``Unassociated``."""
    lived: Tensor
    """``(K,)`` seconds since its first measurement."""
    newest: Tensor
    """``(K,)`` row of its newest measurement among those of this scan."""


class Birth(Part):
    """Abstract: a subclass defines ``forward``.

    Args:
        more: standard deviation of the components of a state beside position and velocity, which begin with 0: one
            number for all, each in its own units: 1 is 1 m/s^2 of an acceleration, and 1 rad/s of the rate of a turn.

    Raises:
        ValueError: a value that is not above 0.
    """

    def __init__(self, more: float) -> None:
        super().__init__()
        self.more = positive("more", more)

    def forward(self, motion: Motion, now: Unassociated, before: Unassociated) -> tuple[Newborn, Unassociated]:
        """The newborn targets, and the measurements that the next scan's births may use.

        Args:
            motion: of the targets.
            now: unassociated measurements of this scan.
            before: the measurements that the last call has left, with the seconds since then.
        """
        raise TypeError(f"{type(self).__name__} must define forward")

    def belief(self, motion: Motion, mean: Tensor, root: Tensor) -> Gaussian:
        """Beliefs in the coordinates of a motion from ``[position, velocity]``: ``(K, 2 dims)``, ``(K, 2 dims, r)``.

        A motion whose states have no velocity takes the position alone.
        """
        known = known_components(motion).to(mean.device)
        mean, root = mean[..., : len(known)], root[..., : len(known), :]
        others = mean.new_ones(motion.size).index_fill(0, known, 0.0)
        place = torch.nn.functional.one_hot(known, motion.size).to(mean)  # (2 dims or dims, n)
        both = torch.cat([place.mT @ root, torch.diag(self.more * others).expand(*mean.shape[:-1], -1, -1)], -1)
        return from_cartesian(motion, Gaussian(mean @ place, tria(both)))


class OnePoint(Birth):
    """Every unassociated measurement begins a target: its position is known, its velocity is not.

    Args:
        velocity: standard deviation of the velocity in each direction, m/s, around 0.
        more: of the components beside position and velocity, in their units.

    Raises:
        ValueError: a value that is not above 0.

    Source: Bar-Shalom, Li & Kirubarajan (2001), "Estimation with Applications to Tracking and Navigation", section
    5.5.
    """

    def __init__(self, velocity: float = 30.0, more: float = 1.0) -> None:
        super().__init__(more)
        self.velocity = positive("velocity", velocity)

    def forward(self, motion: Motion, now: Unassociated, before: Unassociated) -> tuple[Newborn, Unassociated]:
        """A target for each measurement; none is left."""
        position, root = now.position
        dims = motion.dims
        free = torch.eye(dims, dtype=root.dtype, device=root.device).expand_as(root) * self.velocity
        both = torch.cat([pad(root, (0, dims)), pad(free, (dims, 0))], -2)
        belief = self.belief(motion, pad(position, (0, dims)), both)
        newest = torch.arange(len(now.scene), device=now.scene.device)
        return Newborn(belief, now.scene, 1, now.new, now.since, newest), rows(now, slice(0))

    def extra_repr(self) -> str:
        """The standard deviation of the velocity."""
        return f"velocity={self.velocity:g}"


class TwoPoint(Birth):
    """Two unassociated measurements in consecutive scans begin a target: their difference gives the velocity.

    The pairs are an assignment: as many as the highest speed allows, with the least sum of distances.  Scans are those
    of one sensor.  Measurements of one instant are not paired: all of them are left for the next scan.

    Args:
        speed: highest speed of a target, m/s.
        more: standard deviation of the components beside position and velocity, in their units.

    Raises:
        ValueError: a value that is not above 0.

    Source: Bar-Shalom, Li & Kirubarajan (2001), section 5.5, two-point differencing.
    """

    def __init__(self, speed: float = 100.0, more: float = 1.0) -> None:
        super().__init__(more)
        self.speed = positive("speed", speed)

    def forward(self, motion: Motion, now: Unassociated, before: Unassociated) -> tuple[Newborn, Unassociated]:
        """A target for each pair; measurements in no pair are left."""
        old, new = self._pairs(now, before)
        (first, first_root), since = before.position, before.since[old][:, None]
        position, root = now.position.mean[new], now.position.scale_tril[new]
        velocity = (position - first[old]) / since
        moved = torch.cat([root, -first_root[old]], -1) / since.unsqueeze(-1)
        both = torch.cat([pad(root, (0, motion.dims)), moved], -2)
        left = torch.ones_like(now.scene, dtype=torch.bool).index_fill(0, new, False)
        belief = self.belief(motion, torch.cat([position, velocity], -1), both)
        same = rows(before, before.since == 0)
        newborn = Newborn(belief, now.scene[new], 2, before.new[old] * now.new[new], before.since[old], new)
        return newborn, joined(same, rows(now, left))

    def _pairs(self, now: Unassociated, before: Unassociated) -> tuple[Tensor, Tensor]:
        """Rows of the measurements before and now that belong together."""
        pairs = [torch.zeros(2, 0, dtype=torch.int64, device=now.scene.device)]
        for scene in before.scene.unique():
            old, new = ((x.scene == scene).nonzero().squeeze(-1) for x in (before, now))
            i, j = assigned(*self._costs(rows(before, old), rows(now, new)))
            pairs.append(torch.stack([old[i], new[j]]))
        old, new = torch.cat(pairs, 1)
        return old, new

    def _costs(self, before: Unassociated, now: Unassociated) -> tuple[Tensor, Tensor]:
        """Distances ``(K, L)``, and which pairs are allowed."""
        distance = (before.position.mean.unsqueeze(1) - now.position.mean).norm(dim=-1)
        spread = [torch.linalg.matrix_norm(x.position.scale_tril) for x in (before, now)]
        reach = self.speed * before.since.unsqueeze(-1) + _SIGMAS * (spread[0].unsqueeze(-1) + spread[1])
        return distance, (distance <= reach) & (before.since > 0).unsqueeze(-1)

    def extra_repr(self) -> str:
        """The highest speed."""
        return f"speed={self.speed:g}"


class PoissonBirths(Part):
    """Log probability of the number of targets that begin in each scan, to learn their rate by.

    Together with the likelihood of the scans it is the negative log likelihood of a sequence, given its targets::

        loss = -(estimate.log_likelihood.sum(-2) + births(estimate)).mean()

    Args:
        rate: expected number of targets that begin per scan; a number, or what broadcasts with the scenes.
        skip: first scans that do not count: as many as it takes to confirm a target, more where targets may be there
            from the start.

    Raises:
        ValueError: a rate that is not above 0, or a number of scans below 0.

    Source: Reid (1979), "An Algorithm for Tracking Multiple Targets", whose new targets are Poisson.
    """

    def __init__(self, rate: Value = 0.1, *, skip: int = 5) -> None:
        super().__init__()
        self.rate = Hyper(rate, name="rate")
        if not is_integer(skip, 0):
            raise ValueError(f"skip: expected 0 scans or more, received {skip!r}")
        self.skip = skip

    def forward(self, estimate: TargetsEstimate) -> Tensor:
        """``(..., T)`` log probability of the number of targets confirmed for the first time; 0 in skipped scans."""
        there = estimate.confirmed
        earlier = there.cumsum(-1) - there.to(torch.int64) > 0
        begun = (there & ~earlier).sum(-2).to(estimate.mean)
        rate = self.rate(begun).unsqueeze(-1)
        log_probability = begun * rate.log() - rate - torch.lgamma(begun + 1)
        counts = torch.arange(there.shape[-1], device=there.device) >= self.skip
        return torch.where(counts, log_probability, 0.0)

    def extra_repr(self) -> str:
        """The number of skipped scans."""
        return f"skip={self.skip}"
