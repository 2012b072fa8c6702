"""Targets that come and go: births, confirmation, deletion and identities around a filter of scans."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from torchfra.filters.scans.jpda import JPDA
from torchfra.filters.scans.lost_tracks import log_miss
from torchfra.gaussian.inputs import Measurements, Time
from torchfra.numbers import real, whole
from torchfra.targets.births import Birth, Newborn, OnePoint
from torchfra.targets.checks import check_filter, check_parts, check_scan, check_scans
from torchfra.targets.clusters import Group
from torchfra.targets.merging import Merging
from torchfra.targets.others import around, others
from torchfra.targets.places import known_components, place, to_cartesian
from torchfra.targets.records import collect
from torchfra.targets.rules import SPRT, Confirmation, Deletion
from torchfra.targets.saved import restored, saved
from torchfra.targets.scan import Look, Said, look_at
from torchfra.targets.state import TargetsEstimate, TargetsState, Track, Unexplained, joined, rows
from torchfra.types import Gaussian


class Targets(nn.Module):
    """Any number of targets that come and go, in scans of measurements that do not say whose they are.

    In every scan the targets are predicted, gated and split into clusters that share measurements; the filter takes all
    clusters of one size in one call.  Measurements that no target explains begin new, tentative ones, which are
    confirmed or given up; targets that are missed too often end.  Nothing limits how many there are.

    Scans come one by one (``step``) or as whole sequences (``forward``); several scenes may run side by side, which
    have nothing to do with each other.  A row of NaN is no measurement.  A scan without any measurement is one in which
    all targets were missed.

    Args:
        filter: around a filter of one target; a copy of it runs here.  Its hyperparameters are the same for all
            targets, and they are not measured for certain: ``detection`` or the gate's probability is below 1.
        birth: how targets begin, ``OnePoint()`` if None; needs a sensor that ``locates``.
        confirmation: when tentative targets are confirmed or given up, ``SPRT()`` if None; scores need clutter of a
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
        if not 0 < real(free) < 1:
            raise ValueError(f"free: expected a probability above 0 and below 1, received {free}")
        self.filter = copy.deepcopy(filter)
        self.birth = OnePoint() if birth is None else birth
        self.confirmation = SPRT() if confirmation is None else confirmation
        self.deletion = Deletion() if deletion is None else deletion
        self.merging, self.free = merging, free
        more = others(self.filter, sensors)
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
            device: likewise.

        Raises:
            ValueError: less than one scene, or another dtype than ``float32`` and ``float64``.
        """
        if not whole(scenes, 1):
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
        return TargetsState(self.filter.begin(empty), track, Unexplained(position, none, nothing), next_identity)

    def saved(self, state: TargetsState) -> dict[str, Any]:
        """A state as a dictionary for ``torch.save``, which ``torch.load`` reads with ``weights_only=True``."""
        return saved(state)

    def restored(self, values: Mapping[str, Any]) -> TargetsState:
        """The state that was saved; a manager like the one that left it goes on to the same bits.

        Args:
            values: from ``saved``.

        Raises:
            ValueError: they are of another manager.
        """
        return restored(values, self.init())

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
        looks = check_scans(self.filter, z, dt, u)
        state, states = self.init(len(looks[0].z), dtype=z.dtype, device=z.device), []
        for look in looks:
            state = self._step(state, look, self.filter)
            states.append(state)
        return collect(states, z.shape[:-3])

    def _of(self, sensor: str | None) -> JPDA:
        """The filter of a sensor."""
        if sensor is None:
            return self.filter
        if sensor not in self.sensors:
            raise ValueError(f"sensor: expected one of {', '.join(self.sensors) or 'none'}, received {sensor!r}")
        return around(self.filter, self.sensors[sensor])  # type: ignore[arg-type]  # torch knows modules only

    def _step(self, state: TargetsState, look: Look, filter: JPDA) -> TargetsState:
        """The next state, of a look by the sensor of this filter."""
        after, said, groups = look_at(filter, state.filter, state.track.scene, look)
        miss = log_miss(filter.detection, filter.gate, said.log_missed)
        track = _aged(state.track, said, miss)
        stays = ~self._ends(after.belief, track, groups)
        newborn, unexplained = self._births(state.unexplained, said.explained, look, filter)
        track, next_identity = _with_newborn(rows(track, stays), newborn, state.next_identity)
        everyone = rows(after, stays)
        if len(newborn.scene):
            everyone = joined(everyone, self.filter.init(newborn.belief))
        confirmed, given_up = self.confirmation(track)
        track = track._replace(confirmed=track.confirmed | confirmed)
        here = track.confirmed | ~given_up
        return TargetsState(rows(everyone, here), rows(track, here), unexplained, next_identity)

    def _ends(self, belief: Gaussian, track: Track, groups: list[Group]) -> Tensor:
        """Which targets ``(N,)`` are missed too much, or are others."""
        motion = self.filter.motion
        position = to_cartesian(motion, belief).scale_tril[:, known_components(motion)[: motion.dims]]
        ends: Tensor = self.deletion(track, position)
        return ends if self.merging is None else ends | self.merging(motion, belief, track, groups)

    def _births(self, before: Unexplained, explained: Tensor, look: Look, filter: JPDA) -> tuple[Newborn, Unexplained]:
        """Who begins, and what is left for the next scan's births."""
        whole = ~look.z.isnan().any(-1)
        scene, j = (whole & (explained < 1 - self.free)).nonzero().unbind(-1)
        u = None if look.u is None else look.u[scene]
        own = (None if x is None else x[scene, j] for x in (look.std, look.noise))
        where = place(filter.motion, filter.sensor, look.z[scene, j], u, *own)
        now = Unexplained(where, scene, look.dt.new_zeros(len(scene)))
        before = before._replace(since=before.since + look.dt[before.scene])
        newborn, left = self.birth(self.filter.motion, now, before)
        return newborn, left


def _aged(track: Track, said: Said, log_miss: Tensor) -> Track:
    """Targets after one more scan.

    Args:
        track: before.
        said: what the scan has said of them.
        log_miss: log probability to be missed, before it came.
    """
    hit = said.log_missed < math.log(0.5)
    score = track.score + log_miss - said.log_missed
    return track._replace(
        hits=torch.cat([hit.unsqueeze(-1), track.hits[:, :-1]], -1), age=track.age + 1,
        misses=torch.where(hit, 0, track.misses + 1), score=score, best=torch.maximum(track.best, score),
        density=said.density,
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
