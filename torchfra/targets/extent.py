"""Two boats or one hull: the odds of a target beside another, by what both scans and courses say."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchfra.motion.base import Motion
from torchfra.numbers import as_number, fraction, positive
from torchfra.targets.places import known_components
from torchfra.targets.state import Beside, Track, rows
from torchfra.types import Gaussian

_TURN = 0.05
"""Standard deviation of the rate of turn of a hull, rad/s: its bow then moves across its course."""
_SLOWEST = 1e-6
"""m/s, below which a target has no course."""


class Pairs(NamedTuple):
    """Targets ``(K,)`` that may be parts of hulls, each with the one that may be its hull."""

    part: Tensor
    """Rows."""
    hull: Tensor
    """Rows."""


class Extent(nn.Module):
    """Decides by evidence whether a target beside a confirmed one is another, or the other end of its hull.

    A tentative target that comes within ``longest`` of a confirmed one, its host, is confirmed only where the odds of
    two targets against one hull are at least ``sure / (1 - sure)``.  A confirmed one whose odds fall below the inverse
    is tentative again.  A target that was farther than that from its host has none, so that boats that meet stay two.
    The log odds add three parts:

    - the scans: in one whose sensor detects a target with probability ``P``, less while it may be hidden, two have
      both, one or no measurement with ``P^2``, ``P (1 - P)`` each and ``(1 - P)^2``, a hull with ``P both``,
      ``P (1 - both) / 2`` each and ``1 - P``; their logs are summed, weighted by the probabilities of the association,
      and forgotten exponentially;
    - the place: a hull has its parts along its course, to both sides of one another, with a length whose logarithm is
      uniform, and across it within ``beam``; another target is anywhere within ``longest``.  A course is as uncertain
      as the velocity is;
    - the motion: both ends have the same velocity but for the rate of turn, targets that stay together one that differs
      by ``speed`` in each direction.

    Place and motion are those of the two beliefs now, as if they were independent.  While one hull is as sure as that,
    the host is not deleted as long as its part is measured, and a part that is measured in two scans in which the host
    is not takes over its identity.

    Args:
        longest: length of the longest hull, m.
        shortest: length of the shortest hull, m.
        beam: standard deviation of a detection across a hull, m.
        both: probability that a detected hull has two detections.
        speed: standard deviation of the difference of the velocities of two targets side by side, m/s.
        seconds: after which what a scan has said counts ``1 / e``.
        two: probability of two targets before anything is known.
        sure: probability of two that confirms a target, and of one that takes it back or lets it take over.

    Raises:
        ValueError: lengths, a speed or seconds that are not finite and above 0, a shortest hull that is not below the
            longest, or a probability that is not in (0, 1); of ``sure`` in [0.5, 1).

    Source: the hypotheses are those of this module.  A part along the course is the spatial model of Gilholm & Salmond
    (2005), "Spatial distribution model for tracking extended objects".
    """

    def __init__(
        self, longest: float = 40.0, shortest: float = 4.0, *, beam: float = 2.0, both: float = 0.3, speed: float = 1.0,
        seconds: float = 30.0, two: float = 0.5, sure: float = 0.9,
    ) -> None:  # fmt: skip
        super().__init__()
        self.longest = positive("longest", longest, "finite metres")
        self.shortest = positive("shortest", shortest, "finite metres")
        if not self.shortest < self.longest:
            raise ValueError(f"shortest, longest: expected shortest < longest, received {shortest}, {longest}")
        self.beam, self.speed = positive("beam", beam, "finite metres"), positive("speed", speed)
        self.both, self.two, self.seconds = fraction("both", both), fraction("two", two), positive("seconds", seconds)
        if not 0.5 <= as_number(sure) < 1:
            raise ValueError(f"sure: expected a probability in [0.5, 1), received {sure}")
        self.sure, self.limit = float(sure), math.log(sure / (1 - sure))

    def first(self, like: Tensor) -> Beside:
        """Of new targets ``(N,)``: no host."""
        zero = torch.zeros_like(like)
        return Beside(torch.full(like.shape, -1, device=like.device), zero, zero)

    @torch.no_grad()
    def weighed(
        self, motion: Motion, belief: Gaussian, track: Track, log_missed: Tensor, detection: Tensor, dt: Tensor
    ) -> Track:
        """Targets with their odds after a scan.

        Args:
            motion: of the targets.
            belief: ``(N,)`` after the scan.
            track: of each.
            log_missed: ``(N,)`` log probability that each was missed.
            detection: probability ``()`` or ``(N,)`` that the sensor measures a target, which may be hidden.
            dt: ``(N,)`` seconds since the last scan.
        """
        assert track.beside is not None
        host, scans, odds = track.beside
        part, hull = pairs = self.pairs(track)
        host = torch.full_like(host, -1).index_put((part,), host[part])  # none where that has ended
        missed, P = log_missed.exp(), detection.expand_as(odds)[part]
        one, other = missed[part], missed[hull]
        said = (
            torch.xlogy((1 - one) * (1 - other), P / self.both)
            + torch.xlogy(one * (1 - other) + (1 - one) * other, 2 * (1 - P) / (1 - self.both))
            + torch.special.xlog1py(one * other, -P)
        )
        scans = torch.zeros_like(scans).index_put((part,), torch.exp(-dt[part] / self.seconds) * scans[part] + said)
        whole = scans[part] + self.log_odds(motion, belief, pairs)
        odds = torch.zeros_like(odds).index_put((part,), whole)
        return track._replace(beside=Beside(host, scans, odds))

    def log_odds(self, motion: Motion, belief: Gaussian, pairs: Pairs) -> Tensor:
        """Log odds ``(K,)`` of two targets by their places and motions, with what was probable before."""
        components, dims = known_components(motion).to(belief.mean.device), motion.dims
        (mean, root), (base, base_root) = (Gaussian(x.mean[:, components], x.scale_tril[:, components]) for x in (
            rows(belief, pairs.part), rows(belief, pairs.hull)))  # fmt: skip
        gap, P = mean - base, root @ root.mT + base_root @ base_root.mT
        own = base_root @ base_root.mT
        speed = base[:, dims:].norm(dim=-1).clamp_min(_SLOWEST)
        ahead = base[:, dims:] / speed[:, None]
        left = torch.stack([-ahead[:, 1], ahead[:, 0]], -1)
        along, across = (gap[:, :dims] * ahead).sum(-1), (gap[:, :dims] * left).sum(-1)
        course = _along(own[:, dims:, dims:], left) / speed**2
        width = _along(P[:, :dims, :dims], left) + self.beam**2 + along**2 * course.clamp_max(1.0)
        length = torch.log(self.longest / along.abs().clamp(self.shortest, self.longest))
        hull = torch.log(length / (2 * (self.longest - self.shortest))) + _normal(across, width)
        turn = (_TURN * along)[:, None, None] * left.unsqueeze(-1)
        S, velocity = P[:, dims:, dims:], gap[:, dims:]
        same = _normal_2(velocity, S + turn @ turn.mT)
        free = _normal_2(velocity, S + self.speed**2 * torch.eye(dims, dtype=S.dtype, device=S.device))
        anywhere = -math.log(math.pi * self.longest**2)
        return math.log(self.two / (1 - self.two)) + anywhere + free - hull - same

    def kept(self, track: Track, stays: Tensor) -> tuple[Track, Tensor]:
        """Targets after parts have taken over, and which ``(N,)`` of them a rule that ends the others does not end.

        Args:
            track: of each, with the odds after a scan.
            stays: ``(N,)`` bool: which targets are not ended by the rule.
        """
        assert track.beside is not None
        part, hull = self.pairs(track)
        shown = (track.beside.odds[part] < -self.limit) & (track.misses[part] == 0) & ~track.confirmed[part]
        part, hull = part[shown], hull[shown]
        stays = stays.index_fill(0, hull, True)
        over = track.misses[hull] >= 2
        part, hull = part[over], hull[over]
        hull, first = torch.unique(hull, return_inverse=True)
        part = torch.zeros_like(hull).scatter_reduce(0, first, part, "amax", include_self=False)
        order = torch.arange(len(stays), device=stays.device).index_put((part,), hull).index_put((hull,), part)
        host = track.beside.host.index_put((part,), torch.full_like(part, -1))
        host = host.index_put((hull,), track.identity[hull])
        beside = track.beside
        scans, odds = beside.scans[order], beside.odds[order]
        track = track._replace(
            identity=track.identity[order], confirmed=track.confirmed[order], score=track.score[order],
            best=track.best[order], beside=Beside(host, scans, odds),
        )  # fmt: skip
        return track, stays

    @torch.no_grad()
    def decided(
        self, motion: Motion, belief: Gaussian, was: Tensor, confirmed: Tensor, track: Track
    ) -> tuple[Tensor, Track]:
        """Which targets ``(N,)`` are confirmed, and all of them with their hosts.

        Args:
            motion: of the targets.
            belief: ``(N,)``.
            was: ``(N,)`` bool: confirmed before.
            confirmed: ``(N,)`` bool: confirmed by the rule of confirmation.
            track: of each.
        """
        assert track.beside is not None
        host, scans, odds = track.beside
        at = belief.mean[:, known_components(motion)[: motion.dims].to(host.device)]
        some = confirmed.nonzero()[:, 0]
        gap = (at.unsqueeze(1) - at[some]).norm(dim=-1)
        first = was[some] | (track.identity[some] < track.identity.unsqueeze(1))
        able = (track.scene.unsqueeze(1) == track.scene[some]) & first & (gap <= self.longest) & ~was.unsqueeze(1)
        own = track.identity[some] == host.unsqueeze(1)
        near = (own & (gap <= self.longest) & (track.scene.unsqueeze(1) == track.scene[some])).any(-1)
        able = able & (track.identity[some] != track.identity.unsqueeze(1))
        found, has = torch.full_like(host, -1), able.any(-1)
        if len(some):
            nearest = torch.where(able, gap, torch.inf).argmin(-1)
            found = torch.where(has, track.identity[some][nearest], -1)
        new = ~near & (found >= 0)
        held = near & (odds < torch.where(was, -self.limit, self.limit)) | new
        host = torch.where(near, host, found)
        zero = torch.zeros_like(odds)
        beside = Beside(host, torch.where(near, scans, zero), torch.where(near, odds, zero))
        return confirmed & ~held, track._replace(beside=beside)

    def pairs(self, track: Track) -> Pairs:
        """The targets with a host that is there."""
        assert track.beside is not None
        part = (track.beside.host >= 0).nonzero()[:, 0]
        same = (track.identity == track.beside.host[part, None]) & (track.scene == track.scene[part, None])
        at, hull = same.nonzero().unbind(-1)
        return Pairs(part[at], hull)

    def extra_repr(self) -> str:
        """Its arguments."""
        return (f"longest={self.longest:g}, shortest={self.shortest:g}, beam={self.beam:g}, both={self.both:g}, "
                f"speed={self.speed:g}, seconds={self.seconds:g}, two={self.two:g}, sure={self.sure:g}")  # fmt: skip


def _along(P: Tensor, axis: Tensor) -> Tensor:
    """Variance ``(K,)`` in the direction of ``axis (K, d)``."""
    return (axis.unsqueeze(-2) @ P @ axis.unsqueeze(-1)).flatten()


def _normal(x: Tensor, variance: Tensor) -> Tensor:
    """Log density ``(K,)``."""
    return -0.5 * (x.square() / variance + torch.log(2 * math.pi * variance))


def _normal_2(x: Tensor, P: Tensor) -> Tensor:
    """Log density ``(K,)`` of ``x (K, 2)``."""
    (a, b), (_, d) = ((P[:, i, 0], P[:, i, 1]) for i in (0, 1))
    determinant = a * d - b * b
    squared = (d * x[:, 0] ** 2 - 2 * b * x[:, 0] * x[:, 1] + a * x[:, 1] ** 2) / determinant
    return -0.5 * (squared + determinant.log()) - math.log(2 * math.pi)
