"""Linkage of several detections of one target in one scan, as of a hull by lidar, to one measurement."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from torchfra.filters.scans.jpda import JPDA
from torchfra.linalg.triangular import tria
from torchfra.numbers import as_number
from torchfra.sensors.base import Sensor
from torchfra.targets.assignment import scipy
from torchfra.targets.checks import by_sensor
from torchfra.targets.scan import SceneScan


def linked(sensor: Sensor, scan: SceneScan, metres: float) -> SceneScan:
    """The scan with linked detections merged to one measurement: single linkage.

    A measurement is the mean of its detections, in the row of the first of them.  The covariance of its noise is that
    of their mixture: the mean of their covariances plus the spread of their means, since the target's centre may be
    anywhere among them.  It is diagonal if the sensor's is.

    Args:
        sensor: one that ``locates``.
        scan: of it; detections with a missing element stay as they are.
        metres: distance up to which two detections of a scene are linked.

    Raises:
        ImportError: scipy is not installed.
    """
    scene, j = (~scan.z.isnan().any(-1)).nonzero().unbind(-1)
    z = scan.z[scene, j]
    if not len(z):
        return scan
    members = _components(sensor.locate(z), scene, metres)
    there, first = members >= 0, members[:, 0]
    share = there.to(z) / there.sum(-1, keepdim=True)
    gap = sensor.difference(z[members], z[first].unsqueeze(1))
    mean = (share.unsqueeze(-1) * gap).sum(1)
    own = (None if x is None else x[scene, j] for x in (scan.std, scan.noise))
    unit = sensor.measurement_noise(z, *own).colour(torch.eye(sensor.size, dtype=z.dtype, device=z.device))
    each = torch.cat([unit.expand(len(z), -1, -1)[members], (gap - mean.unsqueeze(1)).unsqueeze(-1)], -1)
    columns = share.sqrt()[..., None, None] * each  # (C, K, m, m + 1)
    root = tria(columns.movedim(1, 2).flatten(2))
    place = scene[first], j[first]
    centres = scan.z.index_put((scene, j), z.new_tensor(torch.nan)).index_put(place, z[first] + mean)
    if scan.noise is None and sensor.std is not None:
        std = scan.z.new_ones(scan.z.shape) if scan.std is None else scan.std
        plain = sensor.std.elements().expand_as(std) if scan.std is None else std
        return scan._replace(z=centres, std=plain.to(std).index_put(place, root.norm(dim=-1)))
    whole = sensor.measurement_noise(scan.z, scan.std, scan.noise).colour(torch.eye(sensor.size).to(z))
    return scan._replace(z=centres, std=None, noise=whole.expand(*scan.z.shape, sensor.size).index_put(place, root))


def check_linkage(
    linkage: Mapping[str | None, float] | None, own: JPDA, others: Mapping[str, JPDA]
) -> dict[str | None, float]:
    """Metres by the name of the sensor, None for the filter's own.

    Raises:
        ValueError: one of no sensor, or of one that does not locate, or no metres.
    """
    checked = by_sensor("linkage", linkage, others)
    for name, metres in checked.items():
        sensor = own.sensor if name is None else others[name].sensor
        if not sensor.locates:
            expected = "a sensor that measures where a target is"
            raise ValueError(f"linkage: expected {expected}, received {sensor.describe()}")
        if isinstance(metres, bool) or not 0 < as_number(metres) < math.inf:
            raise ValueError(f"linkage: expected finite metres above 0 of {name!r}, received {metres}")
    return checked


def _components(x: Tensor, scene: Tensor, metres: float) -> Tensor:
    """Numbers ``(C, K)`` of the detections ``x (L, dims)`` of each measurement, the first one first; -1 for none."""
    near = torch.cdist(x, x, compute_mode="donot_use_mm_for_euclid_dist") <= metres
    near &= scene[:, None] == scene
    label = scipy("sparse.csgraph").connected_components(near.numpy(force=True), directed=False)[1]
    order, size = np.argsort(label, kind="stable"), np.bincount(label)
    members = np.full((len(size), size.max()), -1)
    members[label[order], np.arange(len(order)) - (size.cumsum() - size)[label[order]]] = order
    return torch.from_numpy(members).to(scene)
