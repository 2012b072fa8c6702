"""Births where the lines of sight of two sensors of bearings cross."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from torchfra.filters.scans.jpda import JPDA
from torchfra.linalg.triangular import tria
from torchfra.numbers import positive
from torchfra.sensors.base import Sensor
from torchfra.sensors.direction import Bearings
from torchfra.sensors.places import from_u
from torchfra.targets.scan import SceneScan
from torchfra.targets.state import Lines, Unassociated, joined, rows
from torchfra.types import Gaussian


class Triangulation(nn.Module):
    """Births from bearings: a target begins where unassociated lines of sight of two sensors cross.

    The lines are those of a scan and of the newest scans of other sensors that are not older than ``seconds``; each
    begins targets in one scan only.  They cross in front of both sensors, no farther than their fields of view reach,
    and at an angle of ``angle`` or more: sensors in one place, or in line with a target, begin nothing.  Lines of
    several targets cross where no target is, too: those ghosts are tentative targets like others, which share the
    measurements of the true ones and are missed when their lines no longer meet.  Where several targets appear at once,
    two stations cannot tell them from their ghosts for some time; a third sensor can.

    Lines through the stations ``s_i`` in the directions ``d_i = (sin b_i, cos b_i)`` meet at ``p = s_i + r_i d_i``; to
    first order the covariance of ``p`` is, with the standard deviations ``sigma_i`` of the bearings::

        det = sin(b_1 - b_2)
        r_1 = [(s_2 - s_1) x d_2] / det,    r_2 = [(s_2 - s_1) x d_1] / det
        root = [-d_2 r_1 sigma_1, d_1 r_2 sigma_2] / det

    A line that is older than the other has the larger noise ``sqrt(sigma^2 + (speed since / r)^2)``, as the target has
    moved since.

    Args:
        speed: standard deviation of the velocity in each direction, m/s, around 0, as of ``OnePoint``.
        seconds: between two scans whose lines may cross.
        angle: least angle at which lines cross, rad.

    Raises:
        ValueError: a value that is not finite and above 0, or an angle of a right one or more.

    Source: Bar-Shalom, Li & Kirubarajan (2001), section 3.7, for least squares of bearings, of which two have this
    solution.
    """

    def __init__(self, speed: float = 30.0, *, seconds: float = 1.0, angle: float = 0.2) -> None:
        super().__init__()
        self.speed, self.seconds = positive("speed", speed), positive("seconds", seconds)
        self.angle = positive("angle", angle)
        if angle >= math.pi / 2:
            raise ValueError(f"angle: expected less than a right angle, received {angle}")

    def begin(self, like: Tensor) -> Lines:
        """No lines; ``like`` has the dtype."""
        nothing = like.new_zeros(0)
        none = torch.zeros(0, dtype=torch.int64, device=like.device)
        return Lines(nothing.reshape(0, 2), nothing, nothing, nothing, none, nothing, nothing, none)

    def later(self, lines: Lines, dt: Tensor) -> Lines:
        """The lines ``dt (R,)`` seconds later, without those that are too old."""
        lines = lines._replace(since=lines.since + dt[lines.scene])
        kept: Lines = rows(lines, lines.since <= self.seconds)
        return kept

    def lines(self, sensor: Sensor, scan: SceneScan, free: Tensor, least: float, farthest: float, number: int) -> Lines:
        """The lines of sight of a scan that no target explains.

        Args:
            sensor: that measured, see ``sights``.
            scan: of it.
            free: ``(R, J)`` probability that each measurement is no target's.
            least: the probability above which it may begin one.
            farthest: how far the sensor sees, m.
            number: of the sensor.

        Raises:
            ValueError: nothing tells where the sensor is.
        """
        assert isinstance(sensor, Bearings)  # as sights says
        scene, j = ((free > least) & ~scan.z[..., 0].isnan()).nonzero().unbind(-1)
        if sensor.stations is None:
            station = from_u(scan.u, 2, "the position of the station")[scene]
        else:
            station = sensor.stations.to(scan.z).expand(len(scene), 2)
        own = (None if x is None else x[scene, j] for x in (scan.std, scan.noise))
        z = scan.z[scene, j]
        std = sensor.measurement_noise(z, *own).std.expand_as(z)[:, 0]
        since, count = torch.zeros_like(std), torch.full_like(scene, number)
        return Lines(station, z[:, 0], std, torch.full_like(std, farthest), scene, since, free[scene, j], count)

    def forward(self, now: Lines, before: Lines, number: int) -> tuple[Unassociated, Lines]:
        """Crossings of the lines of a scan with those of other sensors, and the lines that none crosses.

        Args:
            now: of this scan.
            before: from earlier ones.
            number: of the sensor whose scan it is.
        """
        others = rows(before, before.sensor != number)
        i, j = (others.scene.unsqueeze(-1) == now.scene).nonzero().unbind(-1)
        one, other = rows(others, i), rows(now, j)
        position, meet = self._crossings(one, other)
        found = Unassociated(position, other.scene, one.since, one.new * other.new, other.sensor)
        left = (torch.ones_like(x.scene, dtype=torch.bool) for x in (others, now))
        alone = (
            rows(x, k.index_fill(0, at[meet], False)) for x, k, at in zip((others, now), left, (i, j), strict=True)
        )
        return rows(found, meet), joined(*alone)

    def _crossings(self, one: Lines, other: Lines) -> tuple[Gaussian, Tensor]:
        """Where pairs of lines ``(K,)`` cross, and whether a target may begin there, ``(K,)`` bool."""
        d, e = (torch.stack([x.bearing.sin(), x.bearing.cos()], -1) for x in (one, other))
        det = (one.bearing - other.bearing).sin()
        good = det.abs() >= math.sin(self.angle)
        det = torch.where(good, det, 1.0)
        between = other.station - one.station
        near, far = _cross(between, e) / det, _cross(between, d) / det
        good = good & (near > 0) & (far > 0) & (near <= one.farthest) & (far <= other.farthest)
        moved = self.speed * one.since / torch.where(good, near, 1.0)
        columns = [-e * (near * torch.hypot(one.std, moved) / det)[:, None], d * (far * other.std / det)[:, None]]
        return Gaussian(one.station + d * near[:, None], tria(torch.stack(columns, -1))), good

    def extra_repr(self) -> str:
        """Its arguments."""
        return f"speed={self.speed:g}, seconds={self.seconds:g}, angle={self.angle:g}"


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def sights(sensor: Sensor) -> bool:
    """Whether a sensor measures one bearing from one place."""
    return isinstance(sensor, Bearings) and sensor.size == 1


def check_triangulation(triangulation: Triangulation | None, filter: JPDA, others: Mapping[str, JPDA]) -> None:
    """Checks that there are two sensors whose lines can cross, in the plane.

    Raises:
        ValueError: there are not.
    """
    if triangulation is None:
        return
    count = sum(sights(f.sensor) for f in (filter, *others.values()))
    if count < 2 or filter.motion.dims != 2:
        expected = "two sensors or more of one bearing each, and targets in the plane"
        raise ValueError(f"triangulation: expected {expected}, received {count} and {filter.motion.dims} dimensions")
