"""A car among high buildings: pseudoranges of satellites, many of them reflected, and the car's own odometry.

A recording is two text files, ``<name>_Input.txt`` and ``<name>_GT.txt`` beside it.  Of their lines these are read,
places in coordinates that are fixed to the Earth (ECEF), m:

- ``pseudorange3 time range variance x y z satellite system elevation density``: of a satellite at x, y, z, with the
  carrier-to-noise density of its signal, dBHz; one whose signal is weak counts as missing;
- ``odom3 time speed ...``: the speed along the car in m/s, and in the eighth column how fast it turns, rad/s;
- ``point3 time x y z ...``: where it was.

Source: Reisdorf, Pfeifer, Breßler, Bauer, Weissig, Lange, Wanielik & Protzel (2016), "The Problem of Comparable GNSS
Results - An Approach for a Uniform Dataset with Low-Cost and Reference Data".
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from recorded_bench.files import steps_between
from recorded_bench.tracks import Figures, Track
from torchfra import presets
from torchfra.catalogue import make_filter
from torchfra.filters import Filter
from torchfra.motion import Augmented, Bank, Clock, ConstantVelocity, Level, Motion, Odometry, RandomWalk
from torchfra.readers.columns import Array
from torchfra.readers.tables import naming
from torchfra.sensors import Biased, Ranges, Sensor
from torchfra.types import Gaussian

METRIC = "rmse_3d"
PARTS = (METRIC, "smoothed", "nees", "nees_smoothed", "beyond")
NOTE = (
    "libRSF (Pfeifer & Protzel): Gaussian, EM mixture and variational mixture, errors in space at the current time by "
    "its own tests"
)
PUBLISHED: dict[str, Figures] = {
    "Berlin_Potsdamer_Platz": {"Gaussian": 68.0, "EM mixture": 22.0, "variational mixture": 19.0}
}
OWN_PRESETS = ("gpb_odometry",)
"""Presets that this kind has besides those that commands list: ``gpb`` with the car's speed and turn rate."""
IN_STATE = ()
"""Presets that have time-correlated errors in their state."""
LIGHT, TURN = 299792458.0, 7.2921151467e-5
"""Speed of light, m/s, and how fast the Earth turns, rad/s."""
FLATTENING_SQUARED = 0.00669438
"""Square of the first eccentricity of the Earth's ellipsoid."""
STD = 2.0
"""Standard deviation of a pseudorange in line of sight, m."""
BIAS = 3.0
"""Standard deviation of what the pseudoranges of each satellite are off by, m: signals that are believed come some
metres late.  Chosen on the first half of the drive for its NEES."""
UNNOTICED = (0.05, 4 * BIAS)
"""Fault of protection levels, as for a robot on a campus: four times the time-correlated errors."""
WEAKEST = 30.0
"""Carrier-to-noise density below which a pseudorange counts as missing, dBHz."""
LATE = (7.0, 14.0, 25.0, 45.0, 75.0, 120.0)
"""By how many metres reflections come late: each is as likely, and stands for what is within 30 % of it, or 4 m."""
LASTS = 100.0
"""Seconds for which a satellite is in line of sight in the mean, and for which it is not."""
ACCELERATION, HEIGHT = 1.0, 1e-3
"""Densities: of the car's acceleration, m^2/s^3, and of the walk of its height, m^2/s."""
CLOCK = (0.01, 5e-4)
"""Densities of the walks of the receiver's clock, m^2/s, and of its drift, m^2/s^3."""
WALKS = (0.02, 1e-5, 1e-6, 1e-8)
"""Densities of the walks of position, heading, scale and bias of the odometry: ``motion.Odometry``."""
BETWEEN = 0.01
"""Density of the walk of what the clocks of two systems of satellites differ by, m^2/s."""
START = {"position": 10.0, "velocity": 10.0, "heading": 0.2, "scale": 0.05, "bias": 0.01, "clock": 50.0, "drift": 100.0,
         "between": 10.0}  # fmt: skip
"""Standard deviations before the first step: m, m/s, rad, 1, rad/s, m, m/s, m."""
OPTIONS: dict[str, Any] = {
    "manoeuvres": "none",
    "noise": "stated",
    "unreliable": 0.0,
    "outlier_durations": (LASTS, LASTS),
    "outlier_sizes": tuple((max(0.3 * late, 4.0) / STD) ** 2 for late in LATE),
    "outlier_shares": (1 / len(LATE),) * len(LATE),
    "outlier_offsets": tuple(late / STD for late in LATE),
    "adaptive_largest_size": False,
    "prior_outlier": 1e-3,
}
"""Of ``gpb``: pseudoranges are in line of sight, or too long; noise is stated for errors that last."""


def read(path: Path) -> Track:
    """A drive.  East, north and up count from where it starts; satellites are in order of their elevation.

    Raises:
        ValueError: the name of the file, a line that is none of those above, or no pseudorange, odometry or truth.
    """
    if not path.name.endswith("_Input.txt"):
        raise ValueError(f"{path}: expected the file of a drive, NAME_Input.txt with NAME_GT.txt beside it")
    name = path.name.removesuffix("_Input.txt")
    ranges, odometry = _lines(path, "pseudorange3", 11), _lines(path, "odom3", 14)
    points = _lines(path.with_name(f"{name}_GT.txt"), "point3", 5)
    start, axes = points[0, 1:4], _axes(points[0, 1:4])
    time, at = np.unique(ranges[:, 0], return_inverse=True)
    satellites, which = np.unique(ranges[:, [7, 6]], axis=0, return_inverse=True)  # by system and number
    which = which.reshape(-1)  # NumPy 2.0 has one more dimension
    elevation = np.array([ranges[which == i, 8].mean() for i in range(len(satellites))])
    order = np.argsort(-elevation)
    which = np.argsort(order)[which]
    z, places = np.full((len(time), len(order)), np.nan), np.full((len(time), len(order), 3), np.nan)
    z[at, which] = np.where(ranges[:, 9] < WEAKEST, np.nan, ranges[:, 1])
    places[at, which] = (_turned(ranges[:, 3:6], ranges[:, 1]) - start) @ axes.T
    driven = odometry[np.searchsorted(odometry[:, 0], time, side="right").clip(1) - 1]
    truth = (points[np.abs(points[:, 0] - time[:, None]).argmin(1), 1:4] - start) @ axes.T
    systems = np.unique(satellites[:, 0])
    mean, root = _start(z[0] - np.linalg.norm(places[0], axis=-1), truth, len(systems))
    return Track(
        name,
        z=torch.from_numpy(z),
        u=torch.from_numpy(np.concatenate([driven[:, [1, 6]], places.reshape(len(time), -1)], 1)),
        dt=torch.from_numpy(steps_between(time)),
        truth=torch.from_numpy(truth),
        prior=Gaussian(mean, root),
        fixes=None,
        published=PUBLISHED.get(name, {}),
        per_axis=False,
        groups=tuple(int(i) for i in np.searchsorted(systems, satellites[order, 0])),
    )


def _lines(path: Path, kind: str, count: int) -> Array:
    """The numbers of all lines of a kind, so many in each with the word in front, which becomes the time."""
    with naming(path):
        rows = [
            line.split()[1:count] for line in path.read_text(encoding="utf-8").splitlines() if line.startswith(kind)
        ]
        if not rows or min(map(len, rows)) < count - 1:
            raise ValueError(
                f"expected lines of {kind} and {count - 1} numbers, received {len(rows)} lines, some shorter"
            )
        return np.array(rows, dtype=float)


def _axes(place: Array) -> Array:
    """Rows ``(3, 3)`` that point east, north and up from a place near the ground."""
    longitude = math.atan2(place[1], place[0])
    latitude = math.atan2(place[2], math.hypot(place[0], place[1]) * (1 - FLATTENING_SQUARED))
    (sin, cos), (s, c) = ((math.sin(a), math.cos(a)) for a in (longitude, latitude))
    return np.array([[-sin, cos, 0.0], [-s * cos, -s * sin, c], [c * cos, c * sin, s]])


def _turned(places: Array, ranges: Array) -> Array:
    """Places of satellites when they sent, in the coordinates of an Earth that has turned until the signal came."""
    turn = TURN * ranges / LIGHT
    x, y, z = places.T
    return np.stack([np.cos(turn) * x + np.sin(turn) * y, np.cos(turn) * y - np.sin(turn) * x, z], 1)


def _start(late: Array, truth: Array, systems: int) -> tuple[Tensor, Tensor]:
    """The belief at the start of ``gpb_odometry``: the true place and heading, and the clock by its median."""
    away = truth[np.argmax(np.linalg.norm(truth, axis=-1) > 3.0)]
    heading = math.atan2(away[1], away[0])
    mean = [0.0, 0.0, 0.0, heading, 0.0, 0.0, float(np.nanmedian(late)), 0.0, *[0.0] * (systems - 1)]
    names = ["position"] * 3 + ["heading", "scale", "bias", "clock", "drift"] + ["between"] * (systems - 1)
    deviations = [START[name] for name in names]
    return torch.tensor(mean, dtype=torch.float64), torch.tensor(deviations, dtype=torch.float64).diag()


class Driven(Odometry):
    """Odometry whose ``u`` has places of satellites behind."""

    def forward(self, x: Tensor, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """As of ``Odometry``."""
        return super().forward(x, dt, None if u is None else u[..., :2])


class FromSatellites(Ranges):
    """Ranges whose ``u`` has odometry in front."""

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """As of ``Ranges``."""
        return super().forward(x, None if u is None else u[..., 2:])


def models(plane: Motion, groups: tuple[int, ...]) -> tuple[Motion, Sensor]:
    """A car that moves like this at a level, its receiver's clocks, and pseudoranges by them."""
    level, between = Level(plane, HEIGHT), [RandomWalk(BETWEEN, 1, kind="bias") for _ in set(groups) - {0}]
    motion = Augmented(level, Clock(*CLOCK), *between)
    clock = FromSatellites(count=len(groups), std=STD, dims=3)
    off = [None if group == 0 else level.size + 1 + group for group in groups]
    return motion, Biased(Biased(clock, level.size), off) if between else Biased(clock, level.size)


def make(name: str, track: Track) -> tuple[Filter, Gaussian]:
    """A preset with the one setting of all drives, and its belief at the start."""
    mean, spread = track.prior.mean, track.prior.scale_tril.diagonal()
    if name in OWN_PRESETS:
        return presets.gpb(*models(Driven(*WALKS), track.groups), **OPTIONS), track.prior
    rest = mean.new_zeros(2), mean.new_full((2,), START["velocity"])
    prior = Gaussian(torch.cat([mean[:3], rest[0], mean[6:]]), torch.cat([spread[:3], rest[1], spread[6:]]).diag())
    motion, sensor = models(ConstantVelocity(ACCELERATION, continuous=True), track.groups)
    bank = None
    if name != "gpb":
        others = (ConstantVelocity(share * ACCELERATION, continuous=True) for share in (0.1, 10.0))
        bank = Bank([motion, *(models(other, track.groups)[0] for other in others)])
    return make_filter(name, motion, sensor, bank, **(OPTIONS if name == "gpb" else {})), prior
