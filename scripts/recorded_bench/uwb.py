"""Ranges from ultra-wideband anchors to a tag on a cart, and the path that was driven.

A recording is a folder: a file for each anchor and one of the path, as ``torchfra.readers.read_ranges`` reads them,
and, where there is one, ``RMSD_results.txt`` with the errors that were published with it.

Source: the recordings of cucudasluv, "UWB dataset" (Apache-2.0).
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import torch

from recorded_bench.tracks import Figures, Track
from torchfra.catalogue import make_filter
from torchfra.filters import Filter
from torchfra.motion import Bank, Singer
from torchfra.readers import read_ranges
from torchfra.readers.tables import naming
from torchfra.scenarios import recorded_ranges
from torchfra.scenarios.ranges import DT
from torchfra.sensors import Ranges
from torchfra.types import Gaussian

METRIC = "rmse_2d"
PARTS = (METRIC, "smoothed", "nees", "nees_smoothed", "beyond")
RESULTS = "RMSD_results.txt"
NOTE = (
    f"{RESULTS} of each recording: LS, least squares, and ESKF, an error-state filter that has an inertial sensor as "
    "well; of both the errors in the plane"
)
_ERROR = re.compile(r"^(\w+) RMSE_2d: *([0-9.]+)", re.M)


def read(path: Path) -> Track:
    """A run.

    Raises:
        ValueError: it is no folder, its files are no ranges, or it has no path.
    """
    if not path.is_dir():
        raise ValueError(f"{path}: expected a folder with the ranges of a run, received a file or nothing")
    with naming(path):
        recording = read_ranges(path)
        scenario = recorded_ranges([recording])
    tracks = scenario.simulate(1)
    assert tracks.u is not None
    results, parts = path / RESULTS, path.resolve().parts[-3:]
    return Track(
        "/".join(part.removeprefix("Trajectory_") for part in parts),
        z=tracks.z[0],
        u=tracks.u[0],
        dt=torch.full(tracks.z.shape[1:2], scenario.dt, dtype=torch.float64),
        truth=tracks.truth[0, :, :2],
        prior=Gaussian(tracks.prior.mean[0], tracks.prior.scale_tril),
        fixes=None,
        published=published(results.read_text(encoding="utf-8")) if results.is_file() else {},
        per_axis=False,
    )


def published(text: str) -> Figures:
    """Errors in the plane, m, by the method, of a file of results."""
    return {method: float(error) for method, error in _ERROR.findall(text)}


ACCELERATION, SECONDS = 1.0, 1.0
"""Of who walks: its variance, m^2/s^4, and how long it lasts, s."""
ERROR, LASTS = 0.1, 1.0
"""Of ranges, m, and for how long one is much like the one before, s.  As many in a row tell what one tells: they are
taken for white errors whose variance is so many times as large."""
BIAS = 0.3
"""Standard deviation of what each anchor's ranges are off by for a whole run, m: chosen on LOS A 1 for its NEES."""
UNNOTICED = (0.05, 4 * ERROR)
"""Fault of protection levels, as for a robot on a campus."""
OPTIONS: dict[str, dict[str, Any]] = {"gpb": {"manoeuvres": "none", "noise": "stated", "unreliable": 0.0}}
"""Arguments of presets that differ from the defaults: a person who walks does not manoeuvre beyond the motion, and
noise is stated for errors that last."""
OWN_PRESETS = IN_STATE = ()
"""Presets of this kind beside those that commands list, and those with time-correlated errors in their state."""


def make(name: str, track: Track) -> tuple[Filter, Gaussian]:
    """A preset with the one setting of all runs, and its belief at the start."""
    std = ERROR * math.sqrt(LASTS / DT)
    sensor = Ranges(count=track.z.shape[-1], std=std, height=0.0)
    calm, usual, hasty = (Singer(share * ACCELERATION, 1 / SECONDS) for share in (0.1, 1.0, 10.0))
    bank = None if name in OPTIONS else Bank([calm, usual, hasty])
    return make_filter(name, usual, sensor, bank, **OPTIONS.get(name, {})), track.prior
