"""The state of the manager of targets, tensors with one row for each existing target; and estimates of sequences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from torchfra import tree
from torchfra.filters.scans.scan import JPDAState
from torchfra.types import Gaussian

T = TypeVar("T")  # a tree
Named = TypeVar("Named", "Track", "Ended", "Claimed")


class Beside(NamedTuple):
    """What speaks for two targets ``(N,)`` against one hull."""

    host: Tensor
    """Identity of the confirmed target whose hull each may be a part of; -1 for none."""
    scans: Tensor
    """The part of the log odds that the scans have given."""
    odds: Tensor
    """Log odds of two targets against one hull; 0 without a host."""


class Track(NamedTuple):
    """Quantities of targets ``(N,)`` from which rules confirm and delete them."""

    identity: Tensor
    """Identity: whole numbers from 0 in each scene; none is used twice."""
    scene: Tensor
    """Number of each target's scene, among those that run in parallel."""
    confirmed: Tensor
    """``(N,)`` bool; False for tentative targets."""
    hits: Tensor
    """``(N, W)`` bool: in which of the last W scans, the newest first, each was measured rather than missed."""
    age: Tensor
    """Scans since the birth, including those of the birth."""
    misses: Tensor
    """Successive misses, counted as misses by the filter's own sensor: see ``Deletion``."""
    score: Tensor
    """Log odds of the target's existence; for rules without a probability at the birth, the log likelihood ratio of the
    scans since then."""
    best: Tensor
    """The highest score so far."""
    density: Tensor
    """Each one's share of the log density of the last scan against one of false measurements alone; 0 at the birth."""
    since: Tensor
    """Seconds since each was measured last."""
    lived: Tensor
    """Seconds since each was measured first."""
    visible: Tensor | None = None
    """``(N, S)`` probability that each sensor, the filter's own first, sees a target, if it exists; None without
    ``Visibility``."""
    beside: Beside | None = None
    """Whether it is a part of another; None without ``Extent``."""


class Ended(NamedTuple):
    """Confirmed targets ``(E,)`` that were deleted recently, and may be found again."""

    filter: JPDAState
    """State of the filter at the deletion."""
    scene: Tensor
    identity: Tensor
    since: Tensor
    """Seconds since each was measured last."""
    deleted: Tensor
    """Seconds since the deletion."""


class Unassociated(NamedTuple):
    """Unassociated measurements ``(K,)``, from which targets may begin."""

    position: Gaussian
    """``(K, dims)`` positions, m."""
    scene: Tensor
    """``(K,)``."""
    since: Tensor
    """``(K,)`` seconds since the measurement."""
    new: Tensor
    """``(K,)`` probability that neither an existing target nor the clutter map explains the measurement."""
    sensor: Tensor
    """``(K,)`` number of the sensor that measured; 0 for the filter's own."""


class Claimed(NamedTuple):
    """``(K,)`` past measurements that targets have begun with, or claimed while they were tentative."""

    position: Tensor
    """``(K, dims)`` positions, m."""
    weight: Tensor
    """``(K,)`` probability that each was the target's, or, if that began with it, no confirmed target's; times its
    exponential decay since."""
    scene: Tensor
    """``(K,)`` number of the scene."""
    sensor: Tensor
    """``(K,)`` number of the sensor."""
    identity: Tensor
    """``(K,)`` of the target."""


class Mapped(NamedTuple):
    """The state of a map: ``(K,)`` past measurements that belonged to no confirmed target."""

    position: Tensor
    """``(K, dims)`` positions, m."""
    weight: Tensor
    """``(K,)`` probability that each belonged to no confirmed target, times its exponential decay since."""
    scene: Tensor
    """``(K,)`` number of the scene."""
    sensor: Tensor
    """``(K,)`` number of the sensor; 0 for the filter's own."""
    scans: Tensor
    """``(R, S)`` number of scans of each scene and sensor, each times its exponential decay since."""
    claimed: Claimed
    """Those of them that tentative targets have begun with or claimed."""
    frame: Tensor
    """``(1,)`` number of the frame of all positions in ``clutter_map.FRAMES``."""


class Lines(NamedTuple):
    """Lines of sight ``(K,)`` that belong to no target."""

    station: Tensor
    """``(K, 2)`` where each begins, m."""
    bearing: Tensor
    """``(K,)`` clockwise from +y, rad."""
    std: Tensor
    """``(K,)`` standard deviation of the bearing, rad."""
    farthest: Tensor
    """``(K,)`` how far its sensor sees, m."""
    scene: Tensor
    """``(K,)``."""
    since: Tensor
    """``(K,)`` seconds since the measurement."""
    new: Tensor
    """``(K,)`` probability that no target explains it."""
    sensor: Tensor
    """``(K,)`` number of its sensor; 0 for the filter's own."""


class TargetsState(NamedTuple):
    """The existing targets after a scan, N of them in all scenes together."""

    filter: JPDAState
    """Of rows ``(N, ...)``."""
    track: Track
    unassociated: Unassociated
    next_identity: Tensor
    """``(R,)`` of each scene."""
    clutter: Mapped | None = None
    """State of the clutter map; None without one."""
    ended: Ended | None = None
    """Lost targets that may be found again; None without ``Stitching``."""
    lines: Lines | None = None
    """Lines of sight that belong to no target; None without ``Triangulation``."""
    past: tuple[Any, ...] = ()
    """The latest scans with the states before them, for delayed scans; empty without a ``lag``."""

    @property
    def belief(self) -> Gaussian:
        """``(N,)``, tentative targets included."""
        return self.filter.belief

    @property
    def confirmed(self) -> Gaussian:
        """Beliefs of the confirmed targets alone."""
        return rows(self.belief, self.track.confirmed)

    @property
    def identity(self) -> Tensor:
        """Identities of the confirmed targets, in the order of ``confirmed``."""
        return self.track.identity[self.track.confirmed]


class TargetsEstimate(NamedTuple):
    """All K targets that were confirmed in a sequence of scans."""

    mean: Tensor
    """``(..., K, T, n)``; NaN where the target is not there, or not confirmed yet."""
    scale_tril: Tensor
    """``(..., K, T, n, n)``; NaN as in ``mean``."""
    identity: Tensor
    """``(..., K)``; -1 where a scene has fewer than K."""
    log_likelihood: Tensor
    """``(..., K, T)`` each one's share of the log density of a scan against one of false measurements alone; 0 where it
    does not exist, and after the last measurement of a target that is deleted."""

    @property
    def confirmed(self) -> Tensor:
        """``(..., K, T)`` bool: whether the target is there and confirmed."""
        return ~self.mean.isnan().any(-1)


def rows(trees: T, index: Tensor | slice) -> T:
    """The rows of all tensors of a tree: by number, in any shape, or where a mask is True."""
    return tree.map_tensors(lambda x: x[index], trees)


def joined(*trees: T) -> T:
    """The rows of one tree after those of another of the same form."""
    return tree.map_tensors(lambda *parts: torch.cat(parts), *trees)


def renamed(of: Named, scene: Tensor, new: Tensor, old: Tensor) -> Named:
    """Rows with a ``scene`` and an ``identity``, where ``new (S,)`` ones of scenes ``(S,)`` have become ``old``."""

    def changed(names: Tensor) -> Tensor:
        same = (of.scene[:, None] == scene) & (names[:, None] == new)
        return torch.where(same, old, 0).sum(-1) + torch.where(same.any(-1), 0, names)

    of = of._replace(identity=changed(of.identity))
    if not isinstance(of, Track) or of.beside is None:
        return of
    return of._replace(beside=of.beside._replace(host=changed(of.beside.host)))


def collect(states: Sequence[TargetsState], batch: Sequence[int] = ()) -> TargetsEstimate:
    """The estimate of a sequence of scans: all targets that were confirmed, each with its own index in a dimension.

    Args:
        states: after each scan of a stream, from the first on.
        batch: of the scenes, their number split up; none for one scene.

    Raises:
        ValueError: no state, or another number of scenes.
    """
    if not all(isinstance(state, TargetsState) for state in states):
        received = ", ".join(sorted({type(state).__name__ for state in states}))
        raise ValueError(f"states: expected what step has returned, received {received}")
    if not states or math.prod(batch) != len(states[0].next_identity):
        received = f"{len(states)} of {len(states[0].next_identity) if states else 0} scenes"
        raise ValueError(f"states: expected one or more, of {math.prod(batch)} scenes, received {received}")
    track: Track = joined(*(rows(s.track, s.track.confirmed) for s in states))
    belief: Gaussian = joined(*(s.confirmed for s in states))
    number = torch.arange(len(states), device=track.scene.device)
    step = number.repeat_interleave(torch.stack([s.track.confirmed.sum() for s in states]))
    R, T = len(states[0].next_identity), len(states)
    pairs, row = torch.unique(torch.stack([track.scene, track.identity], -1), dim=0, return_inverse=True)
    count = torch.bincount(pairs[:, 0], minlength=R)
    K, rank = int(count.amax()), torch.arange(len(pairs), device=row.device) - (count.cumsum(0) - count)[pairs[:, 0]]
    place = track.scene, rank[row], step

    def placed(values: Tensor, empty: float) -> Tensor:
        whole = values.new_full((R, K, T, *values.shape[1:]), empty)
        return whole.index_put(place, values).reshape(*batch, K, T, *values.shape[1:])

    identity = torch.full((R, K), -1, device=row.device).index_put(place[:2], track.identity)
    mean, root = placed(belief.mean, torch.nan), placed(belief.scale_tril, torch.nan)
    gone = _deleted(placed((track.misses == 0).to(belief.mean), 0.0) > 0, ~mean[..., 0].isnan())
    density = torch.where(gone, 0.0, placed(track.density, 0.0))
    return TargetsEstimate(mean, root, identity.reshape(*batch, K), density)


def _deleted(measured: Tensor, there: Tensor) -> Tensor:
    """Which scans ``(..., K, T)`` come after the last measurement of a target that was deleted."""
    later = measured.flip(-1).cumsum(-1).flip(-1) > 0
    return ~later & ~there[..., -1:]
