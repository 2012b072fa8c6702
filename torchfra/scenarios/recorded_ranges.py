"""Recorded ranges from anchors, and the path that was walked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchfra.motion.polynomial import ConstantAcceleration
from torchfra.readers.columns import Array
from torchfra.readers.ranges import RangeGrid, RangeRecording
from torchfra.scenarios.base import Scenario, Tracks
from torchfra.scenarios.ranges import DT, LIMIT, STD, Q, walker
from torchfra.sensors.ranges import Ranges
from torchfra.types import Gaussian


def recorded_ranges(
    recordings: Sequence[RangeRecording], *, dt: float = DT, std: float = STD, q: float = Q, height: float | None = None
) -> Scenario:
    """Recorded ranges and the path that was walked: run i is recording i, whatever the seed.

    Ranges are put on a regular grid (``RangeRecording.on_grid``), the truth in the plane is the reference path, whose
    velocity and acceleration are differences of the positions.  Filters start at its first position with a standard
    deviation of 1 in all states.  Anchors come as ``u``, with heights above that of the target.  Recordings of fewer
    steps or anchors than others end in NaN.

    Args:
        recordings: from ``torchfra.readers.read_ranges``, with reference paths.
        dt: seconds per step.
        std: of the ranges, as filters assume, m.
        q: variance of the change of acceleration per step that filters assume, m^2/s^4; the bank has 0.1, 1 and
            50 times this.
        height: of the target, m, where anchors are in space; None for the median of the reference path's.

    Raises:
        ValueError: no recording, one without a reference path or without its height, or an argument out of its range.
        TypeError: something else than recordings, such as names of files.
    """
    single = isinstance(recordings, RangeRecording)
    wrong = [recordings] if single else [one for one in recordings if not isinstance(one, RangeRecording)]
    if wrong:
        expected = "a list of what torchfra.readers.read_ranges returns"
        raise TypeError(f"recordings: expected {expected}, received {type(wrong[0]).__name__}")
    if not recordings:
        raise ValueError("recordings: expected one or more, received none")
    grids = [recording.on_grid(dt) for recording in recordings]
    steps, count = (max(grid.ranges.shape[axis] for grid in grids) for axis in (0, 1))
    truth = torch.stack([_truth(grid, dt, steps, one) for grid, one in zip(grids, recordings, strict=True)])
    z = torch.stack([_padded(grid.ranges, steps, count) for grid in grids])
    places = torch.stack([_places(one, grid, height, count) for one, grid in zip(recordings, grids, strict=True)])
    start = torch.cat([truth[:, 0, :2], torch.zeros(len(grids), 4, dtype=torch.float64)], -1)
    root = torch.eye(6, dtype=torch.float64)

    def block(rng: np.random.Generator, numbers: Tensor) -> Tracks:
        return Tracks(truth, z, places.unsqueeze(1).expand(-1, steps, -1), Gaussian(start, root))

    names = tuple(one.name for one in recordings)
    settings = {
        "recordings": list(names),
        "std": std,
        "q": q,
        "height": height,
        "repairs": [_repairs(*pair) for pair in zip(recordings, grids, strict=True)],
    }
    return Scenario("recorded-ranges", ConstantAcceleration(q), Ranges(count=count, std=std, height=0.0),
                    Gaussian(start[0], root), dt, steps, block, settings, walker(q), limit=LIMIT,
                    recordings=names)  # fmt: skip


def _truth(grid: RangeGrid, dt: float, steps: int, recording: RangeRecording) -> Tensor:
    """States ``(steps, 6)`` along the reference path, NaN after its end."""
    if grid.reference is None:
        raise ValueError(f"recordings: expected a reference path for each, received none for {recording.name}")
    if len(grid.time) < 2:
        raise ValueError(f"recordings: expected 2 steps or more of {dt:g} s, received 1 for {recording.name}")
    velocity = np.gradient(grid.reference[:, :2], dt, axis=0)
    states = np.concatenate([grid.reference[:, :2], velocity, np.gradient(velocity, dt, axis=0)], 1)
    return _padded(states, steps, 6)


def _repairs(recording: RangeRecording, grid: RangeGrid) -> dict[str, int]:
    """Numbers of repairs of the recording, and of ranges that the grid dropped."""
    crowded = {"ranges dropped for a later one in the same step": grid.dropped} if grid.dropped else {}
    path = {} if recording.reference is None else recording.reference.repairs
    return recording.repairs | {f"path: {what}": count for what, count in path.items()} | crowded


def _padded(values: Array, rows: int, columns: int) -> Tensor:
    """``(rows, columns)`` that begin with these values, and are NaN where there are none."""
    missing = [(0, rows - values.shape[0]), (0, columns - values.shape[1])]
    return torch.from_numpy(np.pad(values, missing, constant_values=np.nan))


def _places(recording: RangeRecording, grid: RangeGrid, height: float | None, count: int) -> Tensor:
    """Positions of the anchors, relative to the target's height, ``(3 count,)``; 0 where there is none."""
    places = np.zeros((count, 3))
    anchors = recording.anchors
    places[: len(anchors), : anchors.shape[1]] = anchors
    if anchors.shape[1] == 3:
        if height is None:
            if grid.reference is None or grid.reference.shape[1] < 3:
                raise ValueError(f"height: expected metres, as the path of {recording.name} has no z, received None")
            height = float(np.median(grid.reference[:, 2]))
        places[: len(anchors), 2] -= height
    elif height is not None:
        raise ValueError(
            f"height: expected anchors in space beside it, received {height} for those of {recording.name}"
        )
    return torch.from_numpy(places.flatten())
