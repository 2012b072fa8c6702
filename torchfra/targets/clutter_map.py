"""A map of the sources of false measurements, such as land, buoys and moored boats."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchfra.numbers import as_number
from torchfra.targets.state import joined, rows

_REACH = 9.0
"""Radius of a kernel, in standard deviations: its values beyond are less than rounding."""


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


class ClutterMap(nn.Module):
    """Learns on line, in a fixed frame, where false measurements recur.

    The density of false measurements is the uniform one of a sensor's ``clutter``, and a kernel at each measurement of
    that sensor that was no confirmed target's, over the number of its scans.  It enters the scores of targets, and so
    their confirmation and deletion: what stays where it is, is explained by the map as well as by a target, and is not
    confirmed; what moves leaves its own measurements behind.  Which measurement is whose is decided without the map.

    Args:
        size: standard deviation of a kernel in each direction, m: that of a measured position as it is stated.  Wider
            kernels confirm sooner what moves, and after some tens of scans what stays too.
        seconds: after which a measurement counts for ``1 / e``.
        scans: number of scans without any measurement with which the map begins: the more, the slower it learns.

    Raises:
        ValueError: a value that is not finite and above 0.

    Source: Musicki, Suvorova, Morelande & Moran (2005), "Clutter map and target tracking".  Differs: kernels at the
    measurements for cells of a grid; forgetting by the time.
    """

    def __init__(self, size: float = 10.0, seconds: float = 60.0, scans: float = 2.0) -> None:
        super().__init__()
        for name, value in (("size", size), ("seconds", seconds), ("scans", scans)):
            if not 0 < as_number(value) < math.inf:
                raise ValueError(f"{name}: expected a finite number above 0, received {value}")
        self.size, self.seconds, self.scans = float(size), float(seconds), float(scans)

    def begin(self, scenes: int, sensors: int, position: Tensor) -> Mapped:
        """An empty map; ``position (0, dims)`` sets the dimensions and the dtype."""
        none = torch.zeros(0, dtype=torch.int64, device=position.device)
        return Mapped(position, position.new_zeros(0), none, none, position.new_zeros(scenes, sensors))

    def aged(self, mapped: Mapped, dt: Tensor) -> Mapped:
        """The map ``dt (R,)`` seconds later, without measurements whose weight is less than 1 % by then."""
        left = torch.exp(-dt / self.seconds)
        mapped = mapped._replace(weight=mapped.weight * left[mapped.scene], scans=mapped.scans * left.unsqueeze(-1))
        position, weight, scene, sensor = rows(mapped[:4], mapped.weight > 0.01)
        return Mapped(position, weight, scene, sensor, mapped.scans)

    def log_excess(self, mapped: Mapped, position: Tensor, scene: Tensor, sensor: int, log_uniform: Tensor) -> Tensor:
        """Log ``(L,)`` of a sensor's density of false measurements at positions ``(L, dims)`` over its uniform one.

        Args:
            mapped: the map.
            position: m.
            scene: ``(L,)``.
            sensor: number.
            log_uniform: ``(L,)`` log of the uniform density per scan, in 1 / m^dims.
        """
        place, weight, of = rows(mapped[:3], mapped.sensor == sensor)
        query, near = self._near(position[:, 0], place[:, 0])
        squared = (position[query] - place[near]).square().sum(-1) / self.size**2
        kernel = torch.exp(-0.5 * squared) / (self.size * math.sqrt(2 * math.pi)) ** position.shape[-1]
        kernel = torch.where(scene[query] == of[near], weight[near] * kernel, 0.0)
        there = position.new_zeros(len(position)).index_add(0, query, kernel)
        return torch.log1p(there / (self.scans + mapped.scans[scene, sensor]) * torch.exp(-log_uniform))

    def _near(self, at: Tensor, places: Tensor) -> tuple[Tensor, Tensor]:
        """Indices of pairs of a coordinate ``at (L,)`` and one of ``places (K,)`` that are within a kernel's radius."""
        ordered, order = places.sort()
        low, high = (torch.searchsorted(ordered, at + side * _REACH * self.size) for side in (-1, 1))
        count = high - low
        query = torch.arange(len(at), device=at.device).repeat_interleave(count)
        return query, order[low[query] + torch.arange(len(query), device=at.device) - (count.cumsum(0) - count)[query]]

    def learned(self, mapped: Mapped, position: Tensor, scene: Tensor, sensor: int, free: Tensor) -> Mapped:
        """The map after a scan of a sensor in every scene.

        Args:
            mapped: the map before the scan.
            position: ``(L, dims)`` positions of its measurements, m.
            scene: ``(L,)``.
            sensor: number.
            free: ``(L,)`` probability that each was no confirmed target's.
        """
        now = torch.nn.functional.one_hot(torch.tensor(sensor), mapped.scans.shape[1]).to(mapped.scans)
        new = Mapped(position, free.clamp(0.0, 1.0), scene, torch.full_like(scene, sensor), mapped.scans[:0])
        both: Mapped = joined(mapped, new)
        return both._replace(scans=mapped.scans + now)

    def extra_repr(self) -> str:
        """Its arguments."""
        return f"size={self.size:g}, seconds={self.seconds:g}, scans={self.scans:g}"
