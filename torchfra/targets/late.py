"""Scans that come late: those of the last seconds are kept, and filtered again after one that belongs before them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.motion.base import Motion
from torchfra.targets.assignment import assigned, chi_square, squared_distance
from torchfra.targets.scan import SceneScan
from torchfra.targets.state import Ended, TargetsState, Track, renamed, rows

_SAME = 0.99
"""Probability of the gate in which a target of before and one of after a late scan are the same."""


class Passed(NamedTuple):
    """A scan that a late one may yet belong before."""

    before: TargetsState
    """The state before it, which keeps no scans itself."""
    scan: SceneScan
    sensor: str | None


Step = Callable[[TargetsState, SceneScan, str | None], TargetsState]
"""A step of the manager."""


def kept(state: TargetsState, past: Sequence[Passed], lag: float) -> TargetsState:
    """The state with those scans of the ``past`` that are needed where one comes ``lag`` seconds late."""
    if not lag:
        return state
    old = int((_ages(past) >= lag).all(-1).sum())
    return state._replace(past=tuple(past[old:]))


def put_in(step: Step, motion: Motion, state: TargetsState, scan: SceneScan, sensor: str | None) -> TargetsState:
    """The state after all scans in the order of their times; at one instant the late scan comes last.

    Targets keep their identities; those that begin with the late scan have new ones.

    Args:
        step: of the manager.
        motion: of the targets.
        state: before the late scan.
        scan: with a negative ``dt``, from the newest scan.
        sensor: of it.

    Raises:
        ValueError: a scan that is late in some scenes only, or between others in each.
    """
    past, late, ages = state.past, -scan.dt, _ages(state.past)
    place = (ages >= late).sum(0)
    if not bool((late > 0).all() & (place == place[0]).all()):
        expected = "a scan that is late in every scene, between the same two of the others, or in none"
        raise ValueError(f"dt: expected {expected}, received {scan.dt.tolist()}")
    first, *others = past[int(place[0]) :]
    age = ages[int(place[0])]
    since = (age + first.scan.dt - late).clamp_min(0.0)  # the first scan of all has nothing before it
    scans = [
        (scan._replace(dt=since), sensor),
        (first.scan._replace(dt=late - age), first.sensor),
        *((x.scan, x.sensor) for x in others),
    ]
    now, again = first.before._replace(next_identity=state.next_identity), []
    for x, of in scans:
        again.append(Passed(now, x, of))
        now = step(now, x, of)
    changed = _same(motion, state, first.before, now)
    again = [x._replace(before=_renamed(x.before, *changed)) for x in again]
    return _renamed(now, *changed)._replace(past=(*past[: int(place[0])], *again))


def _ages(past: Sequence[Passed]) -> Tensor:
    """Seconds ``(K, R)`` from each scan to the newest."""
    dt = torch.stack([x.scan.dt for x in past])
    return dt.flip(0).cumsum(0).flip(0) - dt


def _same(motion: Motion, was: TargetsState, before: TargetsState, now: TargetsState) -> tuple[Tensor, Tensor, Tensor]:
    """Scene, new and old identity ``(S,)`` of targets that are the same in both states and did not exist ``before``.

    Only identities of confirmed targets are kept, as no others have been reported.
    """
    others = before.track, now.track, *(() if now.ended is None else (now.ended,))
    old = was.track.confirmed
    for other in others:
        old = old & ~_among(was.track, other)
    old = old.nonzero()[:, 0]
    new = (now.track.identity >= was.next_identity[now.track.scene]).nonzero()[:, 0]
    one, other = rows(now.belief, new[:, None]), rows(was.belief, old[None])
    apart = squared_distance(motion, one, other)
    near = apart <= chi_square(_SAME, motion.size)
    i, j = assigned(apart, near & (now.track.scene[new][:, None] == was.track.scene[old]))
    return now.track.scene[new[i]], now.track.identity[new[i]], was.track.identity[old[j]]


def _among(track: Track, others: Track | Ended) -> Tensor:
    """Which targets ``(N,)`` are there among others."""
    same = (track.scene[:, None] == others.scene) & (track.identity[:, None] == others.identity)
    return same.any(-1)


def _renamed(state: TargetsState, scene: Tensor, new: Tensor, old: Tensor) -> TargetsState:
    """The state with old identities for new ones."""
    track, clutter, ended = renamed(state.track, scene, new, old), state.clutter, state.ended
    ended = None if ended is None else renamed(ended, scene, new, old)
    if clutter is not None:
        clutter = clutter._replace(claimed=renamed(clutter.claimed, scene, new, old))
    return state._replace(track=track, ended=ended, clutter=clutter)
