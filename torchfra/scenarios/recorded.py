"""Recorded tracks as the truth, and a simulated sensor that measures them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import chain

import numpy as np
import torch
from torch import Tensor

from torchfra.hyper import one_of
from torchfra.motion.bank import aircraft
from torchfra.motion.polynomial import ConstantAcceleration, ConstantVelocity
from torchfra.readers.flyable import flyable
from torchfra.readers.grid import resample
from torchfra.readers.recording import Recording
from torchfra.scenarios.base import BLOCK, Scenario, Tracks
from torchfra.scenarios.law import Law, burst_information, mixed_information
from torchfra.scenarios.outliers import burst_factors
from torchfra.sensors.direction import Bearings, RangeBearing
from torchfra.sensors.position import Position
from torchfra.types import Gaussian

_ROOT = torch.tensor([100.0, 100.0, 10.0, 10.0, 2.0, 2.0], dtype=torch.float64).diag()
_KNOWN = torch.tensor([1.0, 1.0, 1.0, 1.0, 0.0, 0.0], dtype=torch.float64)
"""Components of the true state on which the prior is centred: all but the acceleration."""
LIMIT = 2000.0
"""Position error above which a run has diverged, m."""
_SHORTEST = 20
"""Steps of the shortest window."""
_Sensor = Bearings | RangeBearing | Position


def recorded(
    recordings: Sequence[Recording], sensor: str = "bearings", *, dt: float = 5.0, steps: int = 120,
    max_gap: float = 30.0, std: float | Sequence[float] | None = None, outliers: str = "covariance",
    share: float = 0.05, size: float = 10.0, q: float = 0.25, repair: bool = True,
) -> Scenario:  # fmt: skip
    """A simulated sensor on recorded tracks, in the horizontal plane.

    The time stamps of recorded flights have errors of seconds, so that the recorded accelerations are impossible for an
    aircraft, and a filter that follows every jump would seem best.  So they are corrected first by ``readers.flyable``:
    positions move along the path, its turns remain, and no acceleration exceeds about 1 g.  ``repair=False`` takes
    tracks as they are: for those of vehicles that are recorded exactly, or to see what the repair changes.

    Tracks are resampled to a regular step, split at gaps and cut into windows; run i takes window i modulo their
    number (``settings["windows"]``), with other random numbers.  Velocity and acceleration of the truth are differences
    of the positions.  A window that ends early has NaN from there on.

    Args:
        recordings: from ``torchfra.readers.read``.
        sensor: ``"bearings"`` of two stations south of each window, a ``"radar"`` there for range and bearing, or the
            ``"position"`` itself, as an aircraft reports it.
        dt: seconds per step.
        steps: measurements in a window.
        max_gap: seconds without a position that split a track.
        std: of the sensor: rad for bearings (0.1 degrees unless given), (m, rad) for the radar (50 m, 0.1 degrees), m
            for the position (30 m).
        outliers: what is ``size`` times larger in an outlier: ``"covariance"``, ``"std"``, or ``"none"``;
            ``"bursts"`` for outliers in standard deviation that come in runs of four steps.
        share: of the measurements that are outliers.
        size: the factor.
        q: variance of the change of acceleration per step that filters assume, m^2/s^4; also of the bank
            (``torchfra.motion.aircraft``).
        repair: whether to correct time stamps.

    Raises:
        ValueError: an argument out of its range, or no track long enough.
        TypeError: something else than recordings, such as names of files.
    """
    one_of(outliers=(outliers, ("covariance", "std", "bursts", "none")))
    if not 0 <= share <= 1 or not size >= 1:
        raise ValueError(f"share, size: expected a share in [0, 1] and a size of 1 or more, received {share}, {size}")
    _check(recordings, dt, max_gap, q)
    windows = _windows(recordings, dt, steps, max_gap, repair)
    model, places = _observed(sensor, std, windows)
    assert model.std is not None
    spread: Tensor = model.std()
    settings = {
        "sensor": sensor, "windows": len(windows), "recordings": len(recordings), "max_gap": max_gap,
        "std": spread.tolist(), "outliers": outliers, "share": share, "size": size, "q": q, "repair": repair,
    }  # fmt: skip

    def block(rng: np.random.Generator, numbers: Tensor) -> Tracks:
        window = numbers % len(windows)
        draw = torch.from_numpy(rng.standard_normal((BLOCK, 6 + steps * model.size)))
        start, truth = windows[window].split([1, steps], 1)
        u = None if places is None else places[window].unsqueeze(1).expand(-1, steps, -1)
        noise = draw[:, 6:].unflatten(1, (steps, model.size)) * _factors(rng, outliers, share, size, steps)
        return Tracks(truth, model(truth, u) + spread * noise, u,
                      Gaussian(start.squeeze(1) * _KNOWN + draw[:, :6] @ _ROOT, _ROOT))  # fmt: skip

    bursts = outliers == "bursts"
    fisher = burst_information(steps, share, size) if bursts else mixed_information(outliers, size, share, model.size)
    known = ("accelerations", "outliers") if bursts else ("accelerations",)
    law = Law(_ROOT, ConstantVelocity(0.0, orders=3), model, spread, None, fisher, known)
    prior = Gaussian(windows[0, 0] * _KNOWN, _ROOT)
    return Scenario("recorded", ConstantAcceleration(q), model, prior, dt, steps, block, settings, aircraft(q),
                    limit=LIMIT, law=law)  # fmt: skip


def _check(recordings: Sequence[Recording], dt: float, max_gap: float, q: float) -> None:
    for recording in recordings:
        if not isinstance(recording, Recording):
            raise TypeError(
                f"recordings: expected what torchfra.readers.read returns, received {type(recording).__name__}"
            )
    for name, value in (("dt", dt), ("max_gap", max_gap)):
        if not value > 0:
            raise ValueError(f"{name}: expected seconds above 0, received {value}")
    if not q >= 0:
        raise ValueError(f"q: expected m^2/s^4 of 0 or more, received {q}")


def _factors(rng: np.random.Generator, outliers: str, share: float, size: float, steps: int) -> Tensor:
    """Factors ``(BLOCK, steps, 1)`` on the standard deviation of the measurements."""
    if outliers == "bursts":
        return burst_factors(rng, BLOCK, steps, share=share, size=size)
    growth = {"covariance": math.sqrt(size), "std": size, "none": 1.0}[outliers]
    return torch.where(torch.from_numpy(rng.random((BLOCK, steps, 1))) < share, growth, 1.0)


def _observed(sensor: str, std: float | Sequence[float] | None, windows: Tensor) -> tuple[_Sensor, Tensor | None]:
    """The sensor, and the positions of its stations ``(W, k)`` for each window; None if it has no station."""
    one_of(sensor=(sensor, ("bearings", "radar", "position")))
    known = None if std is None else torch.as_tensor(std, dtype=torch.float64)
    if sensor == "position":
        return Position(30.0 if known is None else known), None
    angle = math.radians(0.1)
    centre, reach = _frame(windows)
    south = centre - reach * torch.tensor([0.0, 1.5], dtype=torch.float64)
    if sensor == "radar":
        return RangeBearing(torch.tensor((50.0, angle), dtype=torch.float64) if known is None else known), south
    aside = reach * torch.tensor([1.0, 0.0], dtype=torch.float64)
    return Bearings(angle if known is None else known), torch.cat([south - aside, south + aside], -1)


def _windows(recordings: Sequence[Recording], dt: float, steps: int, max_gap: float, repair: bool) -> Tensor:
    """States ``(W, steps + 1, 6)`` of all windows, NaN after the end of a track."""
    if steps < _SHORTEST:
        raise ValueError(f"steps: expected {_SHORTEST} or more, received {steps}")
    windows = []
    for recording in chain(*(flyable(r, max_gap=max_gap) if repair else [r] for r in recordings)):
        for time, position in resample(recording, dt, max_gap=max_gap):
            if len(time) <= _SHORTEST:
                continue
            velocity = np.gradient(position[:, :2], dt, axis=0)
            states = np.concatenate([position[:, :2], velocity, np.gradient(velocity, dt, axis=0)], 1)
            for first in range(0, len(states) - _SHORTEST, steps):
                part = states[first : first + steps + 1]
                windows.append(np.pad(part, ((0, steps + 1 - len(part)), (0, 0)), constant_values=np.nan))
    if not windows:
        raise ValueError(
            f"recordings: expected a track of more than {_SHORTEST * dt:g} s without a gap over {max_gap:g} s"
        )
    return torch.from_numpy(np.stack(windows))


def _frame(windows: Tensor) -> tuple[Tensor, Tensor]:
    """Centre ``(W, 2)`` and half width ``(W, 1)`` of each window, the latter at least 2 km."""
    position = windows[..., :2]
    low = position.nan_to_num(nan=torch.inf).amin(1)
    high = position.nan_to_num(nan=-torch.inf).amax(1)
    return (low + high) / 2, ((high - low) / 2).amax(-1, keepdim=True).clamp_min(2000.0)
