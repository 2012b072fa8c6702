"""The manager of targets: births, confirmation, deletion and identities around a filter of scans."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torchfra import tree
from torchfra.filters.base import Filter
from torchfra.filters.scans.jpda import JPDA
from torchfra.filters.scans.lost_tracks import log_miss, log_unseen
from torchfra.filters.scans.scan import JPDAState
from torchfra.filters.srckf import SRCKF
from torchfra.gaussian.arguments import measurements_of
from torchfra.gaussian.inputs import Measurements, Time
from torchfra.hyper import Part
from torchfra.numbers import as_number, fraction, is_integer
from torchfra.steps.engine import INTERPRETED
from torchfra.targets.births import Birth, Newborn, OnePoint
from torchfra.targets.checks import check_filter, check_parts, check_scan, check_scans
from torchfra.targets.clusters import Group
from torchfra.targets.clutter_map import ClutterMap
from torchfra.targets.detections import check_linkage, linked
from torchfra.targets.extent import Extent
from torchfra.targets.late import Passed, kept, put_in
from torchfra.targets.merging import Merging
from torchfra.targets.places import place, positions
from torchfra.targets.rules import SPRT, Confirmation, Deletion
from torchfra.targets.scan import SceneScan, filter_scan
from torchfra.targets.state import (
    Ended,
    Lines,
    Mapped,
    TargetsEstimate,
    TargetsState,
    Track,
    Unassociated,
    collect,
    joined,
    renamed,
    rows,
)
from torchfra.targets.stitching import Parts, Stitching, lost
from torchfra.targets.triangulation import Triangulation, check_triangulation, sights
from torchfra.targets.views import FieldOfView, check_place, check_views
from torchfra.targets.visibility import Visibility, check_visibility
from torchfra.types import Gaussian

FORMAT = 4
"""Version of saved states."""


class Targets(Part):
    """Tracks any number of targets in scans of unlabelled measurements, with track initiation and deletion.

    In every scan the targets are predicted, gated and split into clusters that share measurements; the filter takes all
    clusters of one size in one call.  Unassociated measurements begin tentative targets, which are confirmed or
    deleted; targets that are missed too often are deleted.  The number of targets has no limit.

    Scans come one by one (``step``) or as whole sequences (``forward``); several independent scenes may run side by
    side.  A row of NaN is no measurement.  In a scan without any measurement all targets are missed.

    Args:
        filter: around a filter of one target; a copy of it runs here.  Its hyperparameters are the same for all
            targets, and its ``detection`` or the gate's probability is below 1.
        birth: how targets begin, ``OnePoint()`` if None; needs a sensor that ``locates``, or ``triangulation``.
        confirmation: when tentative targets are confirmed or deleted, ``SPRT()`` if None; scores need clutter of a
            Poisson rate.
        deletion: when targets end, ``Deletion()`` if None, and if the confirmation deletes none that are confirmed.
        merging: which tracks are of one target; None for never.
        extent: whether a target beside another is a part of its hull; None if targets are points.
        birth_threshold: a measurement may begin a target if it belongs to no other with a probability above this.
        sensors: others that scan the same targets, by name, each as a ``JPDA`` with its sensor, gate, clutter and
            detection; targets are followed by the inner filter of ``filter``, around that sensor.  A scan of any sensor
            counts as one for confirmation, and a miss by its own probability (see ``Deletion``); targets begin from the
            scans of each sensor that ``locates``.
        views: fields of view of sensors, by name, None for the filter's own: a target outside is not missed, whatever
            the ``detection`` of the sensor.
        lag: seconds that a scan may come late; the scans of so long, and the states before them, are kept.
        linkage: distance, m, up to which detections are linked, directly or through others, to one measurement: their
            mean, whose noise grows with their spread.  By name of the sensors that may detect a target several times in
            a scan, None for the filter's own.
        stitching: when a target has the identity of one that was lost before; None for never.
        visibility: of sensors from which targets are hidden for a while, by others or by the shore, by name, None for
            the filter's own; all other sensors see all targets at all times.
        triangulation: births where the bearings of two sensors cross; None for births by sensors that ``locate`` alone.
        clutter_map: learns where false measurements recur, for each sensor that measures every direction of space;
            None for a uniform density.  It needs clutter of a Poisson rate.

    Raises:
        ValueError: an argument that is none of those, or does not go with the others.
        ImportError: (in ``step`` and ``forward``) scipy is not installed.

    Source: Blackman & Popoli (1999), chapter 6, for the life of a track; Fortmann, Bar-Shalom & Scheffe (1983) for the
    association within a cluster.
    """

    def __init__(
        self, filter: JPDA, *, birth: Birth | None = None, confirmation: Confirmation | None = None,
        deletion: Deletion | None = None, merging: Merging | None = None, birth_threshold: float = 0.5,
        sensors: Mapping[str, JPDA] | None = None,
        views: Mapping[str | None, FieldOfView] | None = None, clutter_map: ClutterMap | None = None,
        lag: float = 0.0, stitching: Stitching | None = None, linkage: Mapping[str | None, float] | None = None,
        visibility: Mapping[str | None, Visibility] | None = None, triangulation: Triangulation | None = None,
        extent: Extent | None = None,
    ) -> None:  # fmt: skip
        super().__init__()
        check_filter(filter, births=triangulation is None)
        check_parts(birth=(birth, Birth), confirmation=(confirmation, Confirmation), deletion=(deletion, Deletion),
                    merging=(merging, Merging), clutter_map=(clutter_map, ClutterMap),
                    stitching=(stitching, Stitching), triangulation=(triangulation, Triangulation),
                    extent=(extent, Extent))  # fmt: skip
        if not 0 <= as_number(lag) < math.inf:
            raise ValueError(f"lag: expected finite seconds of 0 or more, received {lag}")
        self.filter = copy.deepcopy(filter)
        self.birth = OnePoint() if birth is None else birth
        self.confirmation = SPRT() if confirmation is None else confirmation
        self.deletion = Deletion() if deletion is None and not self.confirmation.deletes else deletion
        self.merging, self.clutter_map, self.lag = merging, clutter_map, float(lag)
        self.birth_threshold = fraction("birth_threshold", birth_threshold)
        self.stitching, self.triangulation, self.extent = stitching, triangulation, extent
        if extent is not None and self.filter.motion.dims != 2:
            raise ValueError(f"extent: expected targets in the plane, received {self.filter.motion.dims} dimensions")
        more = _of_sensors(self.filter, sensors)
        self.sensors, self.views = nn.ModuleDict(more), check_views(views, list(more), self.filter.motion.dims)
        check_triangulation(triangulation, self.filter, more)
        self.linkage = check_linkage(linkage, self.filter, more)
        self.visibility = check_visibility(visibility, list(more))
        rates = [f.clutter.rate for f in (self.filter, *more.values())]
        if (self.confirmation.scored or getattr(self.deletion, "score_drop", None) is not None) and None in rates:
            expected = "clutter of a Poisson rate for scores, as of Clutter(..., rate=), or MOfN and no score_drop"
            raise ValueError(f"confirmation, deletion: expected {expected}, received none")
        if clutter_map is not None and None in rates:
            raise ValueError(
                "clutter_map: expected clutter of a Poisson rate, as of Clutter(..., rate=), received none"
            )

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
        track = Track(none, none, none.bool(), hits, none, nothing, nothing, nothing, nothing, nothing, nothing)
        if self.visibility is not None:
            track = track._replace(visible=self.visibility.first(nothing, 0))
        if self.extent is not None:
            track = track._replace(beside=self.extent.first(nothing))
        empty = Gaussian(nothing.reshape(0, n), nothing.reshape(0, n, n))
        position = Gaussian(nothing.reshape(0, dims), nothing.reshape(0, dims, dims))
        next_identity = torch.zeros(scenes, dtype=torch.int64, device=device)
        free, mapped = Unassociated(position, none, nothing, nothing, none), None
        if self.clutter_map is not None:
            mapped = self.clutter_map.begin(scenes, 1 + len(self.sensors), position.mean)
        begun = self.filter.begin(empty)
        ended = None if self.stitching is None else Ended(begun, none, none, nothing, nothing)
        lines = None if self.triangulation is None else self.triangulation.begin(nothing)
        return TargetsState(begun, track, free, next_identity, mapped, ended, lines)

    def saved(self, state: TargetsState) -> dict[str, Any]:
        """A state as a dictionary for ``torch.save``, which ``torch.load`` reads with ``weights_only=True``."""
        past = [
            {"before": tree.flatten(before), "scan": scan._asdict(), "sensor": sensor}
            for before, scan, sensor in state.past
        ]
        return {"format": FORMAT, "state": tree.flatten(state._replace(past=())), "past": past}

    def restored(self, values: Mapping[str, Any]) -> TargetsState:
        """The state of a dictionary from ``saved``; an equal manager continues from it with bit-equal results.

        Args:
            values: from ``saved``.

        Raises:
            ValueError: they are of another manager.
        """
        received = values.get("format") if isinstance(values, Mapping) else None
        if type(received) is not int or received != FORMAT:
            raise ValueError(f"values: expected format {FORMAT}, received {received!r}")
        if missing := {"state", "past"} - values.keys():
            raise ValueError(f"values: expected state and past, received none of {', '.join(sorted(missing))}")
        try:
            past = [self._unpassed(**x) for x in values["past"]]
            return self._unsaved(values["state"])._replace(past=tuple(past))
        except (TypeError, AttributeError, LookupError, RuntimeError):
            raise ValueError("values: expected what saved gives, received entries of other types") from None
        except ValueError as error:
            raise ValueError(f"values: {error}") from None

    def _unpassed(self, before: list[Tensor], scan: Mapping[str, Any], sensor: str | None) -> Passed:
        """A scan that a late one may yet belong before."""
        state, saved = self._unsaved(before), SceneScan(**scan)
        if saved.dt.shape != state.next_identity.shape or not bool((saved.dt >= 0).all()):
            raise ValueError(f"dt: expected 0 s or more for each scene, received {saved.dt.tolist()}")
        measurements = Measurements(*saved)._replace(dt=1.0)  # that of a scan which was late may be 0
        checked = check_scan(self._of(sensor), state, measurements, self.confirmation.window, 0.0)
        return Passed(state, checked._replace(dt=saved.dt), sensor)

    def _unsaved(self, tensors: list[Tensor]) -> TargetsState:
        """The state of these tensors."""
        empty = self.init()
        expected, found = (
            [(x.shape[1:], x.is_floating_point()) for x in each] for each in (tree.flatten(empty), tensors)
        )
        if found != expected or len({x.dtype for x in tensors if x.is_floating_point()}) > 1:
            raise ValueError(f"expected a state of {expected}, received {found}")
        state = tree.unflatten(empty, iter(tensors))
        parts = {"targets": state.track, "unassociated": state.unassociated, "ended": state.ended}
        for name, part in parts.items():
            tensors = tree.flatten((state.filter, part) if part is state.track else part)
            if len(rows := {len(x) for x in tensors}) > 1:
                raise ValueError(f"{name}: expected as many rows of all, received {sorted(rows)}")
            if part is not None and not set(part.scene.tolist()) <= {*range(len(state.next_identity))}:
                raise ValueError(f"{name}: expected {len(state.next_identity)} scenes, received {part.scene.tolist()}")
        return state

    def step(
        self, state: TargetsState, z: Tensor, *, dt: Time = 1.0, u: Tensor | None = None, std: Tensor | None = None,
        noise: Tensor | None = None, sensor: str | None = None,
    ) -> TargetsState:  # fmt: skip
        """One scan.

        Args:
            state: from ``init`` or the step before; it is not changed.
            z: ``(J, m)``, or ``(R, J, m)`` of R scenes, of any J, also 0; NaN is missing.
            dt: seconds since the newest scan, a number or ``(R,)``; 0 for another scan at the same instant, below 0,
                down to ``-lag``, for one that comes late: the state is then the one that the scans would have left in
                the order of their times, but targets keep their identities.
            u: ``(k,)`` or ``(R, k)`` what the models need to know, such as where the sensor is.
            std: like ``z``: standard deviations of the noise of these measurements, instead of the sensor's.
            noise: like ``z`` with one more ``m``: roots of its covariances, instead of the sensor's.
            sensor: whose scan it is, one of ``sensors``; None for the filter's own.

        Raises:
            ValueError: a shape or a value that does not fit.
            ImportError: scipy is not installed.
        """
        filter, measurements = self._of(sensor), measurements_of(z, dt, u, std, noise)
        scan = check_scan(filter, state, measurements, self.confirmation.window, self.lag)
        parts = (("a map of clutter", state.clutter, self.clutter_map), ("stitching", state.ended, self.stitching),
                 ("visibility", state.track.visible, self.visibility),
                 ("triangulation", state.lines, self.triangulation),
                 ("an extent", state.track.beside, self.extent))  # fmt: skip
        for name, has, part in parts:
            if (has is None) != (part is None):
                expected, received = ("none", "one") if part is None else ("one", "none")
                raise ValueError(f"state: expected {expected} of a manager with {name}, received {received}")
        if state.track.visible is not None and state.track.visible.shape[-1] != 1 + len(self.sensors):
            sensors = state.track.visible.shape[-1]
            raise ValueError(f"state: expected one of {1 + len(self.sensors)} sensors, received one of {sensors}")
        check_place(self.views.get(sensor), scan.u, filter.motion.dims)
        if self.clutter_map is not None:
            self.clutter_map.check(state.clutter, scan.u, filter.motion.dims)
        if bool((scan.dt < 0).any()):
            return put_in(self._step, filter.motion, state, scan, sensor)
        now = state._replace(past=())
        return kept(self._step(now, scan, sensor), (*state.past, Passed(now, scan, sensor)), self.lag)

    def forward(self, z: Tensor, *, dt: Time = 1.0, u: Tensor | None = None) -> TargetsEstimate:
        """Tracks whole sequences of scans, beginning without targets.

        Args:
            z: ``(..., T, J, m)``; NaN is missing.
            dt: seconds between scans, a number or ``(T,)``.
            u: ``(T, k)`` or ``(..., T, k)`` what the models need to know.

        Raises:
            ValueError: a shape or a value that does not fit.
            ImportError: scipy is not installed.
        """
        z, dt, u = measurements_of(z, dt, u)[:3]
        scans = check_scans(self.filter, z, dt, u)
        check_place(self.views.get(None), scans[0].u, self.filter.motion.dims)
        state, states = self.init(len(scans[0].z), dtype=z.dtype, device=z.device), []
        if self.clutter_map is not None:
            self.clutter_map.check(state.clutter, scans[0].u, self.filter.motion.dims)
        for scan in scans:
            state = self._step(state, scan, None)
            states.append(state)
        return collect(states, z.shape[:-3])

    def _of(self, sensor: str | None) -> JPDA:
        """The filter of a sensor."""
        if sensor is None:
            return self.filter
        if sensor not in self.sensors:
            raise ValueError(f"sensor: expected one of {', '.join(self.sensors) or 'none'}, received {sensor!r}")
        return _around(self.filter, self.sensors[sensor])  # type: ignore[arg-type]  # torch knows modules only

    def _step(self, state: TargetsState, scan: SceneScan, sensor: str | None) -> TargetsState:
        """The next state, of a scan by the sensor of this name."""
        scene, number = state.track.scene, 0 if sensor is None else 1 + list(self.sensors).index(sensor)
        filter = self._of(sensor)
        if sensor in self.linkage:
            scan = linked(filter.sensor, scan, self.linkage[sensor])
        state, visible = self._predicted(state, scan.dt[scene], number)
        exists = self.confirmation.exists(state.track.score)
        after, log_missed, density, association, groups = filter_scan(
            filter, state.filter, scene, scan, exists, visible
        )
        miss = log_miss(filter.detection, filter.gate, log_missed)
        miss_or_hidden = miss if visible is None else log_unseen(miss, visible)
        gained, own = miss_or_hidden - log_missed, log_miss(self.filter.detection, self.filter.gate, log_missed)
        located, excess, mapped = _located(filter, scan), scan.z.new_zeros(scan.z.shape[:2]), None
        if self.clutter_map is not None:
            excess, explained, mapped = self._mapped(state, scan, filter, number, located, association)
            gained = gained - explained if _maps(filter) else torch.zeros_like(gained)
        track = _aged(state.track, log_missed, density, gained, miss_or_hidden / own, scan.dt[scene])
        if self.visibility is not None and track.visible is not None:
            track = track._replace(visible=self.visibility.updated(track.visible, number, log_missed, miss))
        if self.extent is not None:
            seen = -torch.expm1(miss_or_hidden)
            track = self.extent.weighed(filter.motion, after.belief, track, log_missed, seen, scan.dt[scene])
        if sensor in self.views:
            track, after = self._not_missed(state, track, after, self.views[sensor], scan)
        gone, merged = self._deleted(after.belief, track, groups)
        if self.extent is not None:
            track, ends_not = self.extent.kept(track, ~gone)
            gone = ~ends_not
        stays = ~(gone | merged)
        exists = self.confirmation.exists(track.score)
        claims = association if exists is None else association * exists.unsqueeze(-1)
        free = 1 - torch.zeros_like(excess).index_add(0, scene, claims)
        newborn, unassociated = self._births(state.unassociated, free, excess, scan, located, number)
        lines = state.lines
        if self.triangulation is not None and lines is not None:
            newborn, lines = self._triangulated(newborn, lines, free, scan, sensor)
        begun, next_identity = _begun(newborn, self.confirmation, state.next_identity)
        if self.visibility is not None:
            begun = begun._replace(visible=self.visibility.first(begun.score, number))
        if self.extent is not None:
            begun = begun._replace(beside=self.extent.first(begun.score))
        if self.clutter_map is not None and mapped is not None and _maps(filter):
            mapped = self.clutter_map.begun(mapped, newborn.newest, len(located.scene), begun.identity)
        was, track = track, joined(rows(track, stays), begun)
        everyone = rows(after, stays)
        if len(newborn.scene):
            everyone = joined(everyone, self.filter.init(newborn.belief))
        confirmed, deleted = self.confirmation(track)
        if self.extent is not None:
            now = confirmed & ~deleted  # an ended target has no parts
            confirmed, track = self.extent.decided(self.filter.motion, everyone.belief, track.confirmed, now, track)
        ended, found = state.ended, (confirmed & ~track.confirmed)[~deleted]
        if self.stitching is not None and ended is not None:
            over = lost(after, was, was.confirmed & gone & ~merged), lost(everyone, track, track.confirmed & deleted)
            ended = joined(self.stitching.later(ended, track, scan.dt), *over)
        everyone, track = rows((everyone, track._replace(confirmed=confirmed)), ~deleted)
        if ended is not None and bool(found.any()):
            everyone, track, ended, names = self._stitched(everyone, track, found, ended, filter.inner, scan.u)
            if self.clutter_map is not None and mapped is not None:
                mapped = self.clutter_map.stitched(mapped, *names)
        return TargetsState(everyone, track, unassociated, next_identity, mapped, ended, lines)

    def _predicted(self, state: TargetsState, dt: Tensor, sensor: int) -> tuple[TargetsState, Tensor | None]:
        """The state predicted by ``dt (N,)`` seconds, and each target's probability ``(N,)`` of being visible."""
        track = state.track._replace(score=self.confirmation.predicted(state.track.score, dt))
        if self.visibility is None or track.visible is None:
            return state._replace(track=track), None
        visible = self.visibility.predicted(track.visible, dt)
        return state._replace(track=track._replace(visible=visible)), visible[:, sensor]

    def _stitched(
        self, everyone: JPDAState, track: Track, found: Tensor, ended: Ended, inner: Filter, u: Tensor | None
    ) -> tuple[JPDAState, Track, Ended, tuple[Tensor, Tensor, Tensor]]:
        """Gives targets ``found (N,)`` the identities of lost ones.

        Returns:
            The targets, the remaining lost targets, and the scene, the new and the old identity ``(S,)`` of each target
            whose identity has changed.
        """
        assert self.stitching is not None
        count, new = len(ended.scene), found.nonzero()[:, 0]
        there = (track.confirmed & ~found).nonzero()[:, 0]  # one of them that is not measured may be lost as well
        with torch.no_grad():
            now = rows(everyone.belief, there)
            if count:
                own = None if u is None else u[ended.scene]
                now = joined(inner.predict(ended.filter.inner, ended.deleted, u=own).belief, now)
            scene, identity, since = joined(ended[1:4], rows((track.scene, track.identity, track.since), there))
            begun = Parts(rows(everyone.belief, new), *rows((track.scene, track.lived), new))
            i, j = self.stitching(self.filter.motion, Parts(now, scene, since), begun)
        names = track.scene[new[j]], track.identity[new[j]], identity[i]
        track = renamed(track, *names)
        left, stays = torch.ones_like(ended.scene, dtype=torch.bool), torch.ones_like(found)
        left[i[i < count]], stays[there[i[i >= count] - count]] = False, False
        return *rows((everyone, track), stays), rows(ended, left), names

    def _not_missed(
        self, state: TargetsState, track: Track, after: JPDAState, view: FieldOfView, scan: SceneScan
    ) -> tuple[Track, JPDAState]:
        """Restores age and misses of targets outside the sensor's field of view."""
        motion, scene = self.filter.motion, state.track.scene
        position = positions(motion, after.belief).mean
        counts = view(position, None if scan.u is None else scan.u[scene]) | (track.misses == 0)
        kept: Track = tree.map_tensors(lambda now, was: _where(counts, now, was), track, state.track)
        missed = torch.where(counts, after.missed, state.filter.missed)
        return kept._replace(density=track.density, since=track.since, lived=track.lived), after._replace(missed=missed)

    @torch.no_grad()
    def _mapped(
        self, state: TargetsState, scan: SceneScan, filter: JPDA, sensor: int, located: Located, association: Tensor
    ) -> tuple[Tensor, Tensor, Mapped]:
        """The effect of the map on the scores of a scan, and the next state of the map.

        Returns:
            Log ``(R, J)`` of the density of false measurements over the uniform one; the mean ``(N,)`` of that log over
            the measurements that may be each target's, with ``ClutterMap.correction``; and the next state.
        """
        clutter_map, ((position, _), scene, j), track = self.clutter_map, located, state.track
        assert clutter_map is not None
        assert state.clutter is not None
        mapped, excess = clutter_map.aged(state.clutter, scan.dt), scan.z.new_zeros(scan.z.shape[:2])
        if not _maps(filter):
            return excess, torch.zeros_like(track.score), mapped
        position = clutter_map.placed(position, None if scan.u is None else scan.u[scene])
        scale = torch.exp(-filter.clutter.in_space(scan.z[scene, j], filter.sensor))
        density = clutter_map.density(mapped, position, scene, sensor)
        excess = excess.index_put((scene, j), torch.log1p(density * scale))
        share = torch.where(track.scene.unsqueeze(-1) == scene, association[:, j], 0.0)
        i, of = (share > 0).nonzero().unbind(-1)
        changed = clutter_map.correction(mapped, position[of], scene[of], sensor, track.identity[i])
        above = (density[of] + changed).clamp_min(0.0)  # what rounding leaves below 0
        explained = torch.zeros_like(track.score).index_add(0, i, share[i, of] * torch.log1p(above * scale[of]))
        return excess, explained, clutter_map.learned(mapped, position, scene, sensor, share, track)

    def _deleted(self, belief: Gaussian, track: Track, groups: list[Group]) -> tuple[Tensor, Tensor]:
        """Two ``(N,)`` bool: targets that the rule of deletion ends, and those that are merged with another."""
        motion = self.filter.motion
        none = torch.zeros_like(track.confirmed)
        gone = none if self.deletion is None else self.deletion(track, motion, belief)
        return gone, none if self.merging is None else self.merging(motion, belief, track, groups)

    def _births(
        self, before: Unassociated, free: Tensor, excess: Tensor, scan: SceneScan, located: Located, sensor: int
    ) -> tuple[Newborn, Unassociated]:
        """The newborn targets, and the unassociated measurements that the sensor's next scan may use.

        Rows of newest measurements are among all that are ``located``.
        """
        free, excess = (x[located.scene, located.number] for x in (free, excess))
        new = free * torch.exp(-excess)
        chosen = (free > self.birth_threshold).nonzero()[:, 0]
        position, scene, new = rows((located.position, located.scene, new), chosen)
        now = Unassociated(position, scene, scan.dt.new_zeros(len(scene)), new, torch.full_like(scene, sensor))
        before = before._replace(since=before.since + scan.dt[before.scene])
        own = before.sensor == sensor
        newborn, left = self.birth(self.filter.motion, now, rows(before, own))
        return newborn._replace(newest=chosen[newborn.newest]), joined(rows(before, ~own), left)

    def _triangulated(
        self, newborn: Newborn, lines: Lines, free: Tensor, scan: SceneScan, sensor: str | None
    ) -> tuple[Newborn, Lines]:
        """The newborn targets, where bearings of a scan cross others too, and the remaining lines of sight."""
        triangulation, of = self.triangulation, self._of(sensor).sensor
        assert triangulation is not None
        lines = triangulation.later(lines, scan.dt)
        if not sights(of):
            return newborn, lines
        number = 0 if sensor is None else 1 + list(self.sensors).index(sensor)
        farthest = self.views[sensor].farthest if sensor in self.views else math.inf
        found, lines = triangulation(
            triangulation.lines(of, scan, free, self.birth_threshold, farthest, number), lines, number
        )
        begun, _ = OnePoint(triangulation.speed, self.birth.more)(self.filter.motion, found, rows(found, slice(0)))
        return begun._replace(hits=2), lines


def _maps(filter: JPDA) -> bool:
    """Whether a map of clutter learns from the sensor of a filter."""
    sensor = filter.sensor
    return bool(sensor.locates and sensor.measures_each_direction)


class Located(NamedTuple):
    """The complete measurements ``(L,)`` of a scan."""

    position: Gaussian
    """``(L, dims)`` positions, m."""
    scene: Tensor
    number: Tensor
    """Number of each measurement in its scene."""


def _located(filter: JPDA, scan: SceneScan) -> Located:
    """The complete measurements of a scan, with positions; none for a sensor that does not locate (bearings, say)."""
    complete = ~scan.z.isnan().any(-1)
    if not filter.sensor.locates:
        nothing, dims = scan.z.new_zeros(0), filter.motion.dims
        none = complete.nonzero()[:0, 0]
        return Located(Gaussian(nothing.reshape(0, dims), nothing.reshape(0, dims, dims)), none, none)
    scene, j = complete.nonzero().unbind(-1)
    u = None if scan.u is None else scan.u[scene]
    own = (None if x is None else x[scene, j] for x in (scan.std, scan.noise))
    return Located(place(filter.motion, filter.sensor, scan.z[scene, j], u, *own), scene, j)


def _of_sensors(filter: JPDA, sensors: Mapping[str, JPDA] | None) -> dict[str, JPDA]:
    """Filters for further sensors, by name, with their own gates, clutter and detection.

    They run interpreted.

    Raises:
        ValueError: one that cannot have these targets.
    """
    made = {}
    for name, other in (sensors or {}).items():
        check_filter(other, f"sensors[{name!r}]", births=False)
        if type(other.motion) is not type(filter.motion) or other.motion.components != filter.motion.components:
            expected = f"the motion of the targets, {type(filter.motion).__name__}"
            raise ValueError(f"sensors: expected {expected}, received {type(other.motion).__name__} of {name!r}")
        if isinstance(filter.inner, SRCKF) and filter.inner.fading is not None:
            raise ValueError("sensors: expected none beside fading factors, which remember measurements of one sensor")
        filter.inner.other_sensor(other.sensor)
        made[name] = copy.deepcopy(other)
        made[name].scanner = made[name].sensor
        _around(filter, made[name])
        made[name].engine = INTERPRETED
    return made


def _around(filter: JPDA, other: JPDA) -> JPDA:
    """The ``other`` filter, around the inner one of ``filter`` as that is now."""
    other.inner = filter.inner
    return other


def _aged(
    track: Track, log_missed: Tensor, density: Tensor, gained: Tensor, miss: Tensor, dt: Tensor
) -> Track:  # fmt: skip
    """Targets after one more scan.

    Args:
        track: before.
        log_missed: ``(N,)`` log probability that each was missed, given the scan.
        density: ``(N,)`` each one's share of the log density of the scan.
        gained: ``(N,)`` what the scan adds to the score.
        miss: a number or ``(N,)`` by which a miss counts: see ``Track.misses``.
        dt: ``(N,)`` seconds since the last one.
    """
    hit, score = log_missed < math.log(0.5), track.score + gained
    return track._replace(
        hits=torch.cat([hit.unsqueeze(-1), track.hits[:, :-1]], -1), age=track.age + 1,
        misses=torch.where(hit, 0.0, track.misses + miss.detach()), score=score, best=torch.maximum(track.best, score),
        density=density, since=torch.where(hit, 0.0, track.since + dt), lived=track.lived + dt,
    )  # fmt: skip


def _where(condition: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Rows of the first or the second tensor, by a mask."""
    return torch.where(condition.reshape(-1, *[1] * (a.dim() - 1)), a, b)


def _begun(newborn: Newborn, confirmation: Confirmation, next_identity: Tensor) -> tuple[Track, Tensor]:
    """The targets that begin, and the next identity ``(R,)`` of each scene."""
    scene, order = newborn.scene.sort(stable=True)
    count = torch.bincount(scene, minlength=len(next_identity))
    place = torch.arange(len(scene), device=scene.device) - (count.cumsum(0) - count)[scene]
    identity = (next_identity[scene] + place)[order.argsort()]
    zero, score = torch.zeros_like(identity), confirmation.first(newborn.new)
    hits = (torch.arange(confirmation.window, device=scene.device) < newborn.hits).expand(len(identity), -1)
    nothing = torch.zeros_like(score)
    begun = Track(
        identity, newborn.scene, zero.bool(), hits, zero + newborn.hits, nothing, score, score, nothing, nothing,
        newborn.lived,
    )  # fmt: skip
    return begun, next_identity + count
