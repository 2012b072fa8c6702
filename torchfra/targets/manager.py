"""The manager of targets: births, confirmation, deletion and identities around a filter of scans."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from torchfra import tree
from torchfra.filters.engine import INTERPRETED
from torchfra.filters.scans.jpda import JPDA
from torchfra.filters.scans.lost_tracks import log_miss
from torchfra.filters.srckf import SRCKF
from torchfra.gaussian.inputs import Measurements, Time
from torchfra.numbers import as_number, is_integer
from torchfra.targets.births import Birth, Newborn, OnePoint
from torchfra.targets.checks import check_filter, check_parts, check_scan, check_scans
from torchfra.targets.clusters import Group
from torchfra.targets.merging import Merging
from torchfra.targets.places import known_components, place, to_cartesian
from torchfra.targets.records import collect
from torchfra.targets.rules import SPRT, Confirmation, Deletion
from torchfra.targets.scan import SceneScan, filter_scan
from torchfra.targets.state import TargetsEstimate, TargetsState, Track, Unassociated, joined, rows
from torchfra.types import Gaussian

FORMAT = 1
"""Of saved states."""


class Targets(nn.Module):
    """Tracks any number of targets in scans of unlabelled measurements, with track initiation and deletion.

    In every scan the targets are predicted, gated and split into clusters that share measurements; the filter takes all
    clusters of one size in one call.  Unassociated measurements begin tentative targets, which are confirmed or
    deleted; targets that are missed too often are deleted.  The number of targets has no limit.

    Scans come one by one (``step``) or as whole sequences (``forward``); several independent scenes may run side by
    side.  A row of NaN is no measurement.  In a scan without any measurement all targets are missed.

    Args:
        filter: around a filter of one target; a copy of it runs here.  Its hyperparameters are the same for all
            targets, and its ``detection`` or the gate's probability is below 1.
        birth: how targets begin, ``OnePoint()`` if None; needs a sensor that ``locates``.
        confirmation: when tentative targets are confirmed or deleted, ``SPRT()`` if None; scores need clutter of a
            Poisson rate.
        deletion: when targets end, ``Deletion()`` if None.
        merging: which tracks are of one target; None for never.
        free: probability that a measurement is no target's above which it may begin one.
        sensors: others that scan the same targets, by name, each as a ``JPDA`` with its sensor, gate, clutter and
            detection; targets are followed by the inner filter of ``filter``, around that sensor.  A scan of any sensor
            counts as one for births, confirmation and deletion.

    Raises:
        ValueError: an argument that is none of those, or does not go with the others.
        ImportError: (in ``step`` and ``forward``) scipy is not installed.

    Source: Blackman & Popoli (1999), chapter 6, for the life of a track; Fortmann, Bar-Shalom & Scheffe (1983) for the
    association within a cluster.
    """

    def __init__(
        self, filter: JPDA, *, birth: Birth | None = None, confirmation: Confirmation | None = None,
        deletion: Deletion | None = None, merging: Merging | None = None, free: float = 0.5,
        sensors: Mapping[str, JPDA] | None = None,
    ) -> None:  # fmt: skip
        super().__init__()
        check_filter(filter)
        check_parts(birth=(birth, Birth), confirmation=(confirmation, Confirmation), deletion=(deletion, Deletion),
                    merging=(merging, Merging))  # fmt: skip
        if not 0 < as_number(free) < 1:
            raise ValueError(f"free: expected a probability above 0 and below 1, received {free}")
        self.filter = copy.deepcopy(filter)
        self.birth = OnePoint() if birth is None else birth
        self.confirmation = SPRT() if confirmation is None else confirmation
        self.deletion = Deletion() if deletion is None else deletion
        self.merging, self.free = merging, free
        more = _of_sensors(self.filter, sensors)
        self.sensors = nn.ModuleDict(more)
        rates = [f.clutter.rate for f in (self.filter, *more.values())]
        if (self.confirmation.scored or self.deletion.drop is not None) and None in rates:
            expected = "clutter of a Poisson rate for scores, as of Clutter(..., rate=), or MOfN and no drop"
            raise ValueError(f"confirmation, deletion: expected {expected}, received none")

    def init(
        self, scenes: int = 1, *, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None
    ) -> TargetsState:
        """The state before the first scan: no target yet.

        Args:
            scenes: how many run side by side.
            dtype: of all numbers.
            device: of all tensors.

        Raises:
            ValueError: less than one scene, or another dtype than ``float32`` and ``float64``.
        """
        if not is_integer(scenes, 1):
            raise ValueError(f"scenes: expected 1 or more, received {scenes}")
        if dtype not in (torch.float32, torch.float64):
            raise ValueError(f"dtype: expected torch.float32 or torch.float64, received {dtype}")
        n, dims = self.filter.motion.size, self.filter.motion.dims
        nothing = torch.zeros(0, dtype=dtype, device=device)
        none = torch.zeros(0, dtype=torch.int64, device=device)
        hits = none.bool().reshape(0, self.confirmation.window)
        track = Track(none, none, none.bool(), hits, none, none, nothing, nothing, nothing)
        empty = Gaussian(nothing.reshape(0, n), nothing.reshape(0, n, n))
        position = Gaussian(nothing.reshape(0, dims), nothing.reshape(0, dims, dims))
        next_identity = torch.zeros(scenes, dtype=torch.int64, device=device)
        return TargetsState(self.filter.begin(empty), track, Unassociated(position, none, nothing), next_identity)

    def saved(self, state: TargetsState) -> dict[str, Any]:
        """A state as a dictionary for ``torch.save``, which ``torch.load`` reads with ``weights_only=True``."""
        return {"format": FORMAT, "state": tree.flatten(state)}

    def restored(self, values: Mapping[str, Any]) -> TargetsState:
        """The state that was saved; a manager like the one that left it goes on to the same bits.

        Args:
            values: from ``saved``.

        Raises:
            ValueError: they are of another manager.
        """
        received = values.get("format") if isinstance(values, Mapping) else None
        if received != FORMAT:
            raise ValueError(f"values: expected format {FORMAT}, received {received!r}")
        empty = self.init()
        expected, found = (
            [(x.shape[1:], x.is_floating_point()) for x in each] for each in (tree.flatten(empty), values["state"])
        )
        if found != expected:
            raise ValueError(f"values: expected a state of {expected}, received {found}")
        state: TargetsState = tree.unflatten(empty, iter(values["state"]))
        return state

    def step(
        self, state: TargetsState, z: Tensor, *, dt: Time = 1.0, u: Tensor | None = None, std: Tensor | None = None,
        noise: Tensor | None = None, sensor: str | None = None,
    ) -> TargetsState:  # fmt: skip
        """One scan.

        Args:
            state: from ``init`` or the step before; it is not changed.
            z: ``(J, m)``, or ``(R, J, m)`` of R scenes, of any J, also 0; NaN is missing.
            dt: seconds since the last scan, a number or ``(R,)``; 0 for another scan at the same instant.
            u: ``(k,)`` or ``(R, k)`` what the models need to know, such as where the sensor is.
            std: like ``z``: standard deviations of the noise of these measurements, instead of the sensor's.
            noise: like ``z`` with one more ``m``: roots of its covariances, instead of the sensor's.
            sensor: whose scan it is, one of ``sensors``; None for the filter's own.

        Raises:
            ValueError: a shape or a value that does not fit.
            ImportError: scipy is not installed.
        """
        filter, measurements = self._of(sensor), Measurements(z, dt, u, std, noise)
        return self._step(state, check_scan(filter, state, measurements, self.confirmation.window), filter)

    def forward(self, z: Tensor, *, dt: Time = 1.0, u: Tensor | None = None) -> TargetsEstimate:
        """Whole sequences of scans, from no target on.

        Args:
            z: ``(..., T, J, m)``; NaN is missing.
            dt: seconds between scans, a number or ``(T,)``.
            u: ``(T, k)`` or ``(..., T, k)`` what the models need to know.

        Raises:
            ValueError: a shape or a value that does not fit.
            ImportError: scipy is not installed.
        """
        scans = check_scans(self.filter, z, dt, u)
        state, states = self.init(len(scans[0].z), dtype=z.dtype, device=z.device), []
        for scan in scans:
            state = self._step(state, scan, self.filter)
            states.append(state)
        return collect(states, z.shape[:-3])

    def _of(self, sensor: str | None) -> JPDA:
        """The filter of a sensor."""
        if sensor is None:
            return self.filter
        if sensor not in self.sensors:
            raise ValueError(f"sensor: expected one of {', '.join(self.sensors) or 'none'}, received {sensor!r}")
        return _around(self.filter, self.sensors[sensor])  # type: ignore[arg-type]  # torch knows modules only

    def _step(self, state: TargetsState, scan: SceneScan, filter: JPDA) -> TargetsState:
        """The next state, of a scan by the sensor of this filter."""
        after, log_missed, density, associated, groups = filter_scan(filter, state.filter, state.track.scene, scan)
        track = _aged(state.track, log_missed, density, log_miss(filter.detection, filter.gate, log_missed))
        stays = ~self._deleted(after.belief, track, groups)
        newborn, unassociated = self._births(state.unassociated, associated, scan, filter)
        track, next_identity = _with_newborn(rows(track, stays), newborn, state.next_identity)
        everyone = rows(after, stays)
        if len(newborn.scene):
            everyone = joined(everyone, self.filter.init(newborn.belief))
        confirmed, given_up = self.confirmation(track)
        track = track._replace(confirmed=track.confirmed | confirmed)
        here = track.confirmed | ~given_up
        return TargetsState(rows(everyone, here), rows(track, here), unassociated, next_identity)

    def _deleted(self, belief: Gaussian, track: Track, groups: list[Group]) -> Tensor:
        """Which targets ``(N,)`` are deleted: missed too often, or merged with others."""
        motion = self.filter.motion
        position = to_cartesian(motion, belief).scale_tril[:, known_components(motion)[: motion.dims]]
        deleted: Tensor = self.deletion(track, position)
        return deleted if self.merging is None else deleted | self.merging(motion, belief, track, groups)

    def _births(
        self, before: Unassociated, associated: Tensor, scan: SceneScan, filter: JPDA
    ) -> tuple[Newborn, Unassociated]:
        """The newborn targets, and the unassociated measurements that the next scan's births may use."""
        complete = ~scan.z.isnan().any(-1)
        scene, j = (complete & (associated < 1 - self.free)).nonzero().unbind(-1)
        u = None if scan.u is None else scan.u[scene]
        own = (None if x is None else x[scene, j] for x in (scan.std, scan.noise))
        where = place(filter.motion, filter.sensor, scan.z[scene, j], u, *own)
        now = Unassociated(where, scene, scan.dt.new_zeros(len(scene)))
        before = before._replace(since=before.since + scan.dt[before.scene])
        newborn, left = self.birth(self.filter.motion, now, before)
        return newborn, left


def _of_sensors(filter: JPDA, sensors: Mapping[str, JPDA] | None) -> dict[str, JPDA]:
    """By name, filters with the gates, clutter and detection of other sensors, whose targets are those of ``filter``.

    They run interpreted.

    Raises:
        ValueError: one that cannot have these targets.
    """
    made = {}
    for name, other in (sensors or {}).items():
        check_filter(other)
        if type(other.motion) is not type(filter.motion) or other.motion.components != filter.motion.components:
            expected = f"the motion of the targets, {type(filter.motion).__name__}"
            raise ValueError(f"sensors: expected {expected}, received {type(other.motion).__name__} of {name!r}")
        if isinstance(filter.inner, SRCKF) and not filter.inner.fading.plain:
            raise ValueError("sensors: expected none beside fading factors, which remember measurements of one sensor")
        made[name] = _around(filter, copy.deepcopy(other))
        made[name].engine = INTERPRETED
    return made


def _around(filter: JPDA, other: JPDA) -> JPDA:
    """The ``other`` filter, around the inner one of ``filter`` as that is now."""
    other.inner = filter.inner.with_sensor(other.sensor)
    return other


def _aged(track: Track, log_missed: Tensor, density: Tensor, log_miss: Tensor) -> Track:
    """Targets after one more scan.

    Args:
        track: before.
        log_missed: ``(N,)`` log probability that each was missed, given the scan.
        density: ``(N,)`` each one's share of the log density of the scan.
        log_miss: log probability that a target is missed, before the scan.
    """
    hit = log_missed < math.log(0.5)
    score = track.score + log_miss - log_missed
    return track._replace(
        hits=torch.cat([hit.unsqueeze(-1), track.hits[:, :-1]], -1), age=track.age + 1,
        misses=torch.where(hit, 0, track.misses + 1), score=score, best=torch.maximum(track.best, score),
        density=density,
    )  # fmt: skip


def _with_newborn(track: Track, newborn: Newborn, next_identity: Tensor) -> tuple[Track, Tensor]:
    """The targets and those that begin, and the next identity ``(R,)`` of each scene."""
    scene, order = newborn.scene.sort(stable=True)
    count = torch.bincount(scene, minlength=len(next_identity))
    place = torch.arange(len(scene), device=scene.device) - (count.cumsum(0) - count)[scene]
    identity = (next_identity[scene] + place)[order.argsort()]
    zero, scores = torch.zeros_like(identity), track.score.new_zeros(len(identity))
    hits = torch.arange(track.hits.shape[-1], device=scene.device) < newborn.hits
    begun = Track(
        identity,
        newborn.scene,
        zero.bool(),
        hits.expand(len(identity), -1),
        zero + newborn.hits,
        zero,
        scores,
        scores,
        scores,
    )
    return joined(track, begun), next_identity + count
