"""A map of the sources of false measurements, such as land, buoys and moored boats."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from torchfra.hyper import one_of
from torchfra.numbers import positive
from torchfra.targets.state import Claimed, Mapped, Track, joined, renamed, rows

FRAMES = "fixed", "platform"
"""Where a map may stay: with the positions of targets, or with the sensors."""
_LEAST = 0.01
"""Weight and probability below which a measurement is forgotten."""
_REACH = 9.0
"""Radius of a kernel, in standard deviations: its values beyond are less than rounding."""


class ClutterMap(nn.Module):
    """Learns on line where false measurements recur, in a fixed frame or around a platform that moves.

    The density of false measurements is the uniform one of a sensor's ``clutter``, and a kernel at each measurement of
    that sensor that was no confirmed target's, over the number of its scans.  It enters the scores of targets, and so
    their confirmation and deletion.  The map explains a source that stays in its place as well as a target does, which
    is then not confirmed; a moving target leaves its own measurements behind.  Association does not use the map, and
    scans of a sensor that does not measure every direction leave scores unchanged, as the map cannot learn from them.

    A tentative target may be such a source itself.  So its own measurements, the newest of its birth and those that it
    has claimed since, are one kernel at their mean instead of a kernel each.  With the weight ``w_k`` of measurement
    ``z_k``, of which the target has claimed ``w_ik``, and the number of scans ``n``, the density of its score is::

        W_i = sum_k w_ik,    m_i = sum_k w_ik z_k / W_i
        density_i(z) = uniform + [sum_k (w_k - w_ik) N(z; z_k, size^2 I) + W_i N(z; m_i, size^2 I)] / (scans + n)

    Args:
        size: standard deviation of a kernel in each direction, m: that of a measured position as it is stated.  With
            wider kernels moving targets are confirmed sooner, and after some tens of scans sources that stay, too.
        seconds: time after which the weight of a measurement is ``1 / e``.
        scans: number of scans without any measurement with which the map begins: the more, the slower it learns.
        frame: ``"fixed"`` for sources that stay in their places, such as land; ``"platform"`` for those that move with
            the sensors, such as echoes of the own mast or wake: positions are then relative to the first ``dims``
            entries of ``u``.

    Raises:
        ValueError: a value that is not finite and above 0, or another frame.

    Source: Musicki, Suvorova, Morelande & Moran (2005), "Clutter map and target tracking".  Differs: kernels at the
    measurements instead of cells of a grid; exponential forgetting; the kernel of a tentative target's measurements.
    """

    def __init__(self, size: float = 10.0, seconds: float = 60.0, scans: float = 2.0, *, frame: str = "fixed") -> None:
        super().__init__()
        one_of(frame=(frame, FRAMES))
        self.size, self.seconds = positive("size", size), positive("seconds", seconds)
        self.scans, self.frame = positive("scans", scans), frame

    def begin(self, scenes: int, sensors: int, position: Tensor) -> Mapped:
        """An empty map; ``position (0, dims)`` sets the dimensions and the dtype."""
        none = torch.zeros(0, dtype=torch.int64, device=position.device)
        weight = position.new_zeros(0)
        claimed = Claimed(position, weight, none, none, none)
        frame = torch.tensor([FRAMES.index(self.frame)], device=position.device)
        return Mapped(position, weight, none, none, position.new_zeros(scenes, sensors), claimed, frame)

    def aged(self, mapped: Mapped, dt: Tensor) -> Mapped:
        """The map ``dt (R,)`` seconds later, without measurements whose weight is less than 1 % by then."""
        left = torch.exp(-dt / self.seconds)
        claimed = mapped.claimed._replace(weight=mapped.claimed.weight * left[mapped.claimed.scene])
        claimed = rows(claimed, claimed.weight > _LEAST)
        mapped = mapped._replace(weight=mapped.weight * left[mapped.scene], scans=mapped.scans * left.unsqueeze(-1))
        position, weight, scene, sensor = rows(mapped[:4], mapped.weight > _LEAST)
        return mapped._replace(position=position, weight=weight, scene=scene, sensor=sensor, claimed=claimed)

    def placed(self, position: Tensor, u: Tensor | None) -> Tensor:
        """Positions ``(L, dims)`` in the map's frame; ``u (L, k)`` is that of their scans."""
        if self.frame == "fixed":
            return position
        assert u is not None  # as checked before
        return position - u[:, : position.shape[-1]]

    def check(self, mapped: Mapped | None, u: Tensor | None, dims: int) -> None:
        """Checks that a map is of this frame, and that a scan has the place of the platform if it needs it.

        Raises:
            ValueError: it does not.
        """
        if mapped is not None and FRAMES[int(mapped.frame)] != self.frame:
            received = FRAMES[int(mapped.frame)]
            raise ValueError(f"state: expected a map of clutter in the frame {self.frame!r}, received {received!r}")
        if self.frame == "platform" and (u is None or u.shape[-1] < dims):
            received = "none" if u is None else f"{u.shape[-1]} numbers"
            expected = f"the place of the platform, {dims} numbers, as its map of clutter needs"
            raise ValueError(f"u: expected {expected}, received {received}")

    def density(self, mapped: Mapped, position: Tensor, scene: Tensor, sensor: int) -> Tensor:
        """Density ``(L,)`` of a sensor's false measurements above the uniform one, per scan, in 1 / m^dims.

        Args:
            mapped: the map.
            position: ``(L, dims)`` m.
            scene: ``(L,)``.
            sensor: number.
        """
        place, weight, of = rows(mapped[:3], mapped.sensor == sensor)
        ordered, order = place[:, 0].sort()
        low, high = (torch.searchsorted(ordered, position[:, 0] + side * _REACH * self.size) for side in (-1, 1))
        query, near = _ranges(low, high)
        near = order[near]
        kernel = self._kernel(position[query] - place[near])
        kernel = torch.where(scene[query] == of[near], weight[near] * kernel, 0.0)
        return self._per_scan(mapped, scene, sensor, position.new_zeros(len(position)).index_add(0, query, kernel))

    def correction(self, mapped: Mapped, position: Tensor, scene: Tensor, sensor: int, identity: Tensor) -> Tensor:
        """Correction ``(P,)`` of the density for a target, whose own measurements are one kernel at their mean.

        Args:
            mapped: the map.
            position: ``(P, dims)`` m.
            scene: ``(P,)``.
            sensor: number.
            identity: ``(P,)`` of the target.
        """
        own = rows(mapped.claimed, mapped.claimed.sensor == sensor)
        scenes = len(mapped.scans)
        ordered, order = (own.identity * scenes + own.scene).sort()
        key = identity * scenes + scene
        low, high = (torch.searchsorted(ordered, key, right=right) for right in (False, True))
        query, member = _ranges(low, high)
        place, weight = rows(own[:2], order[member])
        nothing = position.new_zeros(len(position))
        cloud = nothing.index_add(0, query, weight * self._kernel(position[query] - place))
        whole = nothing.index_add(0, query, weight)
        mean = torch.zeros_like(position).index_add(0, query, weight.unsqueeze(-1) * place)
        mean = mean / torch.where(whole > 0, whole, 1.0).unsqueeze(-1)
        return self._per_scan(mapped, scene, sensor, whole * self._kernel(position - mean) - cloud)

    def _kernel(self, gap: Tensor) -> Tensor:
        """The normal density ``(...)`` of a gap ``(..., dims)``."""
        squared = (gap / self.size).square().sum(-1)
        return torch.exp(-0.5 * squared) / (self.size * math.sqrt(2 * math.pi)) ** gap.shape[-1]

    def _per_scan(self, mapped: Mapped, scene: Tensor, sensor: int, kernels: Tensor) -> Tensor:
        """Sums of kernels ``(...)`` over the number of scans."""
        return kernels / (self.scans + mapped.scans[scene, sensor])

    def learned(
        self, mapped: Mapped, position: Tensor, scene: Tensor, sensor: int, association: Tensor, track: Track
    ) -> Mapped:
        """The map after a scan of a sensor in every scene.

        Args:
            mapped: the map before the scan.
            position: ``(L, dims)`` positions of its measurements, m.
            scene: ``(L,)``.
            sensor: number.
            association: ``(N, L)`` probability that each is a target's.
            track: of the targets ``(N,)``.
        """
        number = torch.full_like(scene, sensor)
        free = (1 - (association * track.confirmed.unsqueeze(-1)).sum(0)).clamp(0.0, 1.0)
        new = Mapped(position, free, scene, number, mapped.scans[:0], rows(mapped.claimed, slice(0)), mapped.frame[:0])
        both: Mapped = joined(mapped, new)
        there = torch.isin(*(x.identity * len(mapped.scans) + x.scene for x in (mapped.claimed, track)))
        i, j = ((association > _LEAST) & ~track.confirmed.unsqueeze(-1)).nonzero().unbind(-1)
        share = torch.minimum(association[i, j], free[j])
        more = Claimed(position[j], share, scene[j], number[j], track.identity[i])
        now = torch.nn.functional.one_hot(torch.tensor(sensor), mapped.scans.shape[1]).to(mapped.scans)
        return both._replace(scans=mapped.scans + now, claimed=joined(rows(mapped.claimed, there), more))

    def begun(self, mapped: Mapped, newest: Tensor, count: int, identity: Tensor) -> Mapped:
        """The map after targets have begun with measurements of the scan that it has just learned.

        Args:
            mapped: from ``learned``.
            newest: ``(K,)`` number of each target's newest measurement among those of the scan.
            count: number of measurements of the scan.
            identity: ``(K,)`` of the targets.
        """
        position, weight, scene, sensor = rows(mapped[:4], len(mapped.weight) - count + newest)
        return mapped._replace(claimed=joined(mapped.claimed, Claimed(position, weight, scene, sensor, identity)))

    def stitched(self, mapped: Mapped, scene: Tensor, new: Tensor, old: Tensor) -> Mapped:
        """The map after targets ``new (S,)`` of scenes ``(S,)`` got ``old`` identities: their own claims go with them.

        Those of the lost targets, which ended elsewhere, are left to the cloud.
        """
        claimed = mapped.claimed
        lost = ((claimed.scene[:, None] == scene) & (claimed.identity[:, None] == old)).any(-1)
        return mapped._replace(claimed=renamed(rows(claimed, ~lost), scene, new, old))

    def extra_repr(self) -> str:
        """Its arguments."""
        return f"size={self.size:g}, seconds={self.seconds:g}, scans={self.scans:g}, frame={self.frame!r}"


def _ranges(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Numbers of all pairs of a query ``(L,)`` and one of the sorted rows from its ``low`` to below its ``high``."""
    count = high - low
    query = torch.arange(len(low), device=low.device).repeat_interleave(count)
    return query, low[query] + torch.arange(len(query), device=low.device) - (count.cumsum(0) - count)[query]
