"""A robot on a campus: wheels, the heading of an inertial sensor, and satellite positions with time-correlated errors.

A file is a day: rows of 1 s with ``time`` (s), ``gps_x`` and ``gps_y`` (m, empty without a new fix), ``wheel_left`` and
``wheel_right`` (m/s), ``yaw`` (rad, counter-clockwise from +x), ``truth_x`` and ``truth_y`` (m).  Other columns do not
matter.

Source: Carlevaris-Bianco, Ushani & Eustice (2016), "University of Michigan North Campus long-term vision and lidar
dataset", as prepared by Song et al. (2024).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from learned.campus import learned, signals
from torch import Tensor

from recorded_bench.compass import steadied
from recorded_bench.files import check_ascending, check_complete, read_columns, steps_between
from recorded_bench.tracks import Figures, Followed, Track
from torchfra.catalogue import make_filter
from torchfra.filters import Filter
from torchfra.gaussian import moment_match
from torchfra.motion import Augmented, Bank, GaussMarkov, Odometry
from torchfra.presets import imm
from torchfra.sensors import Biased, Position
from torchfra.types import Estimate, Gaussian

METRIC = "rmse_axis"
PARTS = (METRIC, "smoothed", "nees", "nees_smoothed", "beyond")
COLUMNS = ("time", "gps_x", "gps_y", "wheel_left", "wheel_right", "yaw", "truth_x", "truth_y")
PUBLISHED: dict[str, Figures] = {
    "2012-11-04": {"EKF": 18.76, "KalmanNet": 12.46},
    "2012-11-16": {"EKF": 12.29, "KalmanNet": 5.61},
    "2013-04-05": {"EKF": 8.94, "KalmanNet": 5.99},
}
"""Root mean square errors per axis, m, on the three test days of Song et al. (2024); KalmanNet has learnt from 22 other
days with a truth."""
NOTE = (
    "Song et al. (2024): EKF and KalmanNet, which has learnt from 22 other days with a truth; means over 2012-11-04, "
    "2012-11-16 and 2013-04-05: EKF 13.33, SIKNet 9.37, KalmanNet 8.02"
)
COMPASS = (-0.138, -0.059, 0.043, -0.069, -0.027)
"""Deviation of the inertial sensor's heading, rad: a constant, and factors of the sine and cosine of the heading and of
twice the heading, as iron beside a compass causes it (Bowditch, "The American Practical Navigator", on deviation)."""
GPS = 5.0
"""Standard deviation of a satellite position, m, for filters that take its errors for white."""
WALKS = (6e-3, 1e-8, 9e-8)
"""Densities of the walks of position, heading error and scale for these: m^2/s, rad^2/s, 1/s."""
START = (0.1, 0.1, 0.05, 0.02)
"""Standard deviations before the first step: position, m, heading error, rad, logarithm of the wheels' scale."""
SCALE = -0.076
"""Logarithm of the wheels' scale before the first step."""
OPTIONS: dict[str, dict[str, Any]] = {
    "gpb": {
        "manoeuvres": "none",
        "noise": "stated",
        "unreliable": 0.0,
        "outlier_transition": ((0.999, 0.001), (0.01, 0.99)),
        "outlier_sizes": (10.0, 100.0),
        "outlier_shares": (0.5, 0.5),
    }
}
"""Arguments of presets, others than their defaults: satellite positions that are wrong stay so for 100 steps on
average, so a place that lasts is no jump of the robot, and wheels are as accurate as stated.  Noise is stated for
errors that last, which look like motion."""
OWN_PRESETS = IN_STATE = ("imm",)
"""Presets of this kind beside those that commands list, and those with time-correlated errors in their state."""
MIXED = ("gpb", "imm")
"""Presets whose estimates a network weighs."""
TURNS = (-0.62, -0.45)
"""How far the robot turns in a step, rad, for each m/s by which its right wheels are faster at its end and at its
start: by least squares on the two days that values were chosen on.  (They are below 0, as if sides were exchanged.)"""
MOVES = 0.1
"""Sum of the speeds of both sides beyond which the robot moves, m/s."""
WHITE, SLIP = 1.2, 0.1
"""Of ``imm``: the part of a position's error that is white, m, and the density of the position's walk, m^2/s."""
ERROR, TIME = 4.0, 80.0
"""Standard deviation, m, and time constant, s, of the time-correlated part of the errors."""
FAULT, STEADY, MOVING = 50.0, 0.8, 6.0
"""Standard deviation of the error of a fault, m, and how far it wanders, m in 1 s, while steady and while moving."""
TRANSITION = (
    (0.999, 0.001, 0.0, 0.0, 0.0),
    (0.0, 0.1, 0.4, 0.4, 0.1),
    (0.0, 0.001, 0.969, 0.02, 0.01),
    (0.0, 0.001, 0.2, 0.789, 0.01),
    (0.999, 0.001, 0.0, 0.0, 0.0),
)
"""Probabilities of what follows in 1 s on: no fault, a fault begins, is steady, moves, ends."""
BIAS = ERROR
"""Standard deviation of what positions are off by for a whole day, m, for filters that take their errors for white."""
UNNOTICED = (0.05, 4 * ERROR)
"""Of protection levels: share of the time with an error of positions that was believed, and its standard deviation, m:
four times that of the error that is always there, the least multiple at which the levels of ``imm`` and ``gpb`` hold on
both days that values were chosen on."""


def read(path: Path) -> Track:
    """A day.

    Raises:
        ValueError: a column is missing, has no number where it must, or times do not grow.
    """
    columns = read_columns(path, COLUMNS)
    check_complete(path, columns, [name for name in COLUMNS if not name.startswith(("gps", "truth"))])
    check_ascending(path, "time", columns["time"])
    rows = {name: torch.from_numpy(np.stack([columns[part] for part in parts], -1)) for name, parts in (
        ("gps", ("gps_x", "gps_y")), ("truth", ("truth_x", "truth_y")), ("wheels", ("wheel_left", "wheel_right")),
        ("yaw", ("yaw",)),
    )}  # fmt: skip
    start = rows["truth"][0]
    if bool(start.isnan().any()):
        raise ValueError(f"{path}: truth_x, truth_y: expected a start in the first row, received none")
    mean = torch.cat([start, start.new_tensor([0.0, SCALE])])
    name, speed, compass = path.name.split(".")[0], rows["wheels"].mean(-1), rows["yaw"].squeeze(-1)
    heading = steadied(compass + deviation(compass), turns(rows["wheels"]), speed.abs() > MOVES / 2)
    return Track(
        name,
        z=rows["gps"],
        u=torch.stack([speed, heading], -1),
        dt=torch.from_numpy(steps_between(columns["time"])),
        truth=rows["truth"],
        prior=Gaussian(mean, torch.tensor(START, dtype=torch.float64).diag()),
        fixes=rows["gps"],
        published=PUBLISHED.get(name, {}),
        per_axis=True,
    )


def turns(wheels: Tensor) -> Tensor:
    """By how much wheels ``(T, 2)`` of both sides, m/s, turn the robot in each step ``(T,)``, rad; 0 in the first."""
    faster = wheels[:, 1] - wheels[:, 0]
    return torch.cat([faster.new_zeros(1), TURNS[0] * faster[1:] + TURNS[1] * faster[:-1]])


def learned_mixture(
    tracks: Sequence[Track],
    filters: Sequence[Filter],
    seed: int,
    progress: Callable[[range], Iterable[int]],
) -> Callable[[Track, Sequence[Followed]], Followed]:
    """From a day and what the two filters say of it to what networks make of that; they have learned on other days.

    Raises:
        ValueError: a day without a truth at all of its steps.
    """
    networks = learned(tracks, filters, with_error, seed, progress)

    def mixture(track: Track, of: Sequence[Followed]) -> Followed:
        with torch.no_grad():
            said = signals(track.z, *(one.estimate for one in of))
            weight = torch.stack([network(said) for network in networks]).mean(0)
        log_weights = torch.stack([1 - weight, weight]).log()

        def mixed(estimates: list[Estimate]) -> Estimate:
            beliefs = [Gaussian(e.mean[:, :2], e.scale_tril[:, :2, :2]) for e in estimates]
            mean, root = moment_match(Gaussian(*map(torch.stack, zip(*beliefs, strict=True))), log_weights)
            return estimates[0]._replace(mean=mean, scale_tril=root)

        level = torch.stack([one.level for one in of])  # an error is at most the weighed errors of both: twice the risk
        return Followed(
            mixed([one.estimate for one in of]),
            mixed([one.smoothed for one in of]),
            (log_weights.exp() * level).sum(0),
        )

    return mixture


def deviation(yaw: Tensor) -> Tensor:
    """What is added to a measured heading, rad."""
    waves = torch.ones_like(yaw), yaw.sin(), yaw.cos(), (2 * yaw).sin(), (2 * yaw).cos()
    return sum(c * wave for c, wave in zip(COMPASS, waves, strict=True))  # type: ignore[return-value]


def make(name: str, track: Track) -> tuple[Filter, Gaussian]:
    """A preset with the one setting of all days, chosen on 2013-01-10 and 2013-02-23, and its belief at the start."""
    if name == "imm":
        return with_faults(track)
    return make_filter(name, Odometry(*WALKS), Position(GPS), **OPTIONS.get(name, {})), track.prior


def with_faults(track: Track) -> tuple[Filter, Gaussian]:
    """Interacting models of the error of satellite positions, which is a part of the state.

    Without a fault it is a few metres and changes slowly.  A fault begins with an error of tens of metres, which then
    stays or moves, and ends with a new error of a few metres.
    """
    begins = 1e-3  # seconds over which an error is forgotten that is replaced by a new one
    steady, moving = (2 * (FAULT / wander) ** 2 for wander in (STEADY, MOVING))
    errors = (ERROR, TIME), (FAULT, begins), (FAULT, steady), (FAULT, moving), (ERROR, begins)
    odometry = Odometry(SLIP, *WALKS[1:])
    bank = Bank([Augmented(odometry, GaussMarkov(*error, dims=2)) for error in errors])
    sensor = Biased(Position(WHITE), [odometry.size, odometry.size + 1])
    return imm(bank, sensor, transition=torch.tensor(TRANSITION, dtype=torch.float64)), with_error(track.prior)


def with_error(prior: Gaussian) -> Gaussian:
    """A belief ``(..., 4)`` with the error of positions, ``(..., 6)``."""
    mean, root = prior
    error = (ERROR * torch.eye(2).to(root)).expand(*root.shape[:-2], 2, 2)
    aside = torch.zeros_like(root[..., :2])
    rows = torch.cat([torch.cat([root, aside], -1), torch.cat([aside.mT, error], -1)], -2)
    return Gaussian(torch.cat([mean, torch.zeros_like(mean[..., :2])], -1), rows)
