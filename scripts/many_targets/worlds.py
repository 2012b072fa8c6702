"""Worlds in which many targets appear and disappear: aircraft as recorded, and a crowd."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchfra import presets, readers
from torchfra.association import ChiSquare, Clutter
from torchfra.motion import ConstantVelocity
from torchfra.readers import Recording, resample
from torchfra.sensors import Position
from torchfra.targets import Deletion, Merging, Targets, TwoPoint

DETECTION, FALSE = 0.9, 300
"""Probability that a target is measured, and expected false measurements per scan."""
STD = 50.0
"""Of the positions, m."""


class World(NamedTuple):
    """Truth and scans, and the manager for them."""

    truth: Tensor
    """``(M, T, 2 or 4)`` positions, NaN where a target is not there."""
    scans: list[Tensor]
    """``(J, 2)`` each."""
    dt: float
    targets: Targets
    cutoff: float
    """Distance from which on a target is not followed, m."""


def recorded(flights: Sequence[Recording], seed: int, dt: float, scans: int, *, folded: bool) -> World:
    """Aircraft as recorded, from the middle of the recorded time on.

    Args:
        flights: without gaps, see ``torchfra.readers.flyable``.
        seed: of the measurements.
        dt: seconds between scans.
        scans: how many.
        folded: whether all flights are moved by a whole multiple of that time, so that they begin in it.
    """
    start, end = min(f.time[0] for f in flights), max(f.time[-1] for f in flights)
    grid, rows = (start + end - dt * scans) / 2 + dt * np.arange(scans), []
    for flight in flights:
        ((time, position),) = resample(flight, 1.0, max_gap=math.inf)
        time = time - folded * dt * scans * ((time[0] - grid[0]) // (dt * scans))
        inside = (grid >= time[0]) & (grid <= time[-1])
        if inside.sum() >= 2:
            axes = [np.interp(grid, time, x) for x in position[:, :2].T]
            rows.append(np.where(inside[:, None], np.stack(axes, -1), np.nan))
    truth = torch.from_numpy(np.stack(rows))
    corners = truth.nan_to_num(nan=math.inf).amin((0, 1)), truth.nan_to_num(nan=-math.inf).amax((0, 1))
    return _world(truth, corners, seed, dt, q=4.0, speed=350.0)


def crowd(seed: int, scans: int, count: int = 200, width: float = 100e3) -> World:
    """Targets of up to 300 m/s with accelerations of 1 m/s^2 in a square, all of them there from the first scan on."""
    rng, dt = np.random.default_rng([seed, 0]), 1.0
    motion = ConstantVelocity(1.0)
    matrix = motion.transition(torch.tensor(dt).double()).numpy()
    speed, course = rng.uniform(50, 300, count), rng.uniform(0, 2 * np.pi, count)
    velocity = speed[:, None] * np.stack([np.sin(course), np.cos(course)], -1)
    state, rows = np.concatenate([rng.uniform(0, width, (count, 2)), velocity], -1), []
    for _ in range(scans):
        push = rng.standard_normal((count, 2))
        state = state @ matrix.T + np.concatenate([push / 2, push], -1)
        rows.append(state)
    corners = torch.zeros(2).double(), torch.full((2,), width).double()
    return _world(torch.from_numpy(np.stack(rows, 1)), corners, seed, dt, q=1.0, speed=350.0)


def _world(truth: Tensor, corners: tuple[Tensor, Tensor], seed: int, dt: float, q: float, speed: float) -> World:
    """Scans in any order of what is measured of the truth, and of false measurements anywhere."""
    rng, (low, high), scans = np.random.default_rng([seed, 1]), corners, []
    for position in truth[..., :2].unbind(1):
        measured = position[~position.isnan().any(-1)].numpy()
        measured = measured[rng.random(len(measured)) < DETECTION]
        measured = measured + STD * rng.standard_normal(measured.shape)
        false = rng.uniform(low.numpy(), high.numpy(), (rng.poisson(FALSE), 2))
        scans.append(torch.from_numpy(rng.permutation(np.concatenate([measured, false]))))
    clutter = Clutter(volume=float((high - low).prod()), rate=float(FALSE))
    f = presets.jpda(ConstantVelocity(q), Position(STD), clutter=clutter, detection=DETECTION, gate=ChiSquare(0.99999))
    manager = Targets(f, birth=TwoPoint(speed), deletion=Deletion(5), merging=Merging())
    return World(truth, scans, dt, manager, 10 * STD)


def swiss_traffic() -> list[Recording]:
    """All flights of a day over Switzerland, of the sample tracks that come with the package ``traffic``.

    Gaps of a minute split them, and their time stamps are mended: ``torchfra.readers.flyable``.

    Raises:
        ImportError: the package is not installed.
    """
    (file,) = (file for file in readers.samples("collections") if file.name.startswith("switzerland"))
    return [piece for recording in readers.read(file) for piece in readers.flyable(recording, max_gap=60.0)]
