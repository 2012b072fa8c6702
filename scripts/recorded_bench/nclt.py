"""A robot on a campus: wheels, the heading of an inertial sensor, and satellite positions with errors that last.

A file is a day: rows of 1 s with ``time`` (s), ``gps_x`` and ``gps_y`` (m, empty without a new fix), ``wheel_left`` and
``wheel_right`` (m/s), ``yaw`` (rad, counter-clockwise from +x), ``truth_x`` and ``truth_y`` (m).  Other columns do not
matter.

Source: Carlevaris-Bianco, Ushani & Eustice (2016), "University of Michigan North Campus long-term vision and lidar
dataset", as prepared by Song et al. (2024).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from recorded_bench.files import check_ascending, check_complete, read_columns, steps_between
from recorded_bench.tracks import Figures, Track
from torchfra.catalogue import make_filter
from torchfra.filters import Filter
from torchfra.motion import Odometry
from torchfra.sensors import Position
from torchfra.types import Gaussian

METRIC = "rmse_axis"
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
GPS = 5.0
"""Standard deviation of a satellite position, m."""
WALKS = (1e-2, 1e-8, 9e-8)
"""Densities of the walks of position, heading error and scale: m^2/s, rad^2/s, 1/s."""
START = (1.0, 1.0, 0.2, 0.1)
"""Standard deviations before the first step: position, m, heading error, rad, logarithm of the wheels' scale."""
OPTIONS: dict[str, dict[str, Any]] = {
    "gpb": {
        "manoeuvres": "none",
        "outlier_transition": ((0.999, 0.001), (0.01, 0.99)),
        "outlier_sizes": (10.0, 100.0),
        "outlier_shares": (0.5, 0.5),
    }
}
"""Arguments of presets, others than their defaults: a robot that measures its own way does not jump, and satellite
positions that are wrong stay so for 100 steps on average."""


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
    mean = torch.cat([start, torch.zeros(len(START) - 2, dtype=torch.float64)])
    name = path.name.split(".")[0]
    return Track(
        name,
        z=rows["gps"],
        u=torch.cat([rows["wheels"].mean(-1, keepdim=True), rows["yaw"]], -1),
        dt=torch.from_numpy(steps_between(columns["time"])),
        truth=rows["truth"],
        prior=Gaussian(mean, torch.tensor(START, dtype=torch.float64).diag()),
        fixes=rows["gps"],
        published=PUBLISHED.get(name, {}),
        per_axis=True,
    )


def make(name: str, track: Track) -> Filter:
    """A preset with the one setting of all days, chosen on 2013-01-10 and 2013-02-23."""
    return make_filter(name, Odometry(*WALKS), Position(GPS), **OPTIONS.get(name, {}))
