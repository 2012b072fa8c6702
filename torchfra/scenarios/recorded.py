"""Recorded tracks as the truth, and a simulated sensor that looks at them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchfra.motion.bank import aircraft
from torchfra.motion.polynomial import ConstantAcceleration
from torchfra.readers.grid import resample
from torchfra.readers.recording import Recording
from torchfra.scenarios.base import BLOCK, Scenario, Tracks
from torchfra.sensors.direction import Bearings, RangeBearing
from torchfra.sensors.position import Position
from torchfra.types import Gaussian

_ROOT = torch.tensor([100.0, 100.0, 10.0, 10.0, 2.0, 2.0], dtype=torch.float64).diag()
_SHORTEST = 20


def recorded(
    recordings: Sequence[Recording],
    sensor: str = "bearings",
    *,
    dt: float = 5.0,
    steps: int = 120,
    max_gap: float = 30.0,
    std: float | Sequence[float] | None = None,
    outliers: str = "covariance",
    share: float = 0.05,
    size: float = 10.0,
    q: float = 0.25,
) -> Scenario:
    """A simulated sensor on recorded tracks, in the horizontal plane.

    Tracks are resampled to a regular step, split at gaps and cut into windows; run i takes window i modulo their
    number (``settings["windows"]``), with its own noise.  Velocity and acceleration of the truth are differences of the
    positions.  A window that ends early has NaN from there on.

    Args:
        recordings: from ``torchfra.readers.read``.
        sensor: ``"bearings"`` of two stations south of each window, a ``"radar"`` there for range and bearing, or the
            ``"position"`` itself, as an aircraft reports it.
        dt: seconds per step.
        steps: measurements in a window.
        max_gap: seconds without a position that split a track.
        std: of the sensor: rad for bearings (0.1 degrees unless given), (m, rad) for the radar (50 m, 0.1 degrees), m
            for the position (30 m).
        outliers: what grows in an outlier: ``"covariance"`` or ``"std"``, or ``"none"``.
        share: of the measurements that are outliers.
        size: how many times it grows.
        q: variance of the change of acceleration per step that filters assume, m^2/s^4; also of the bank
            (``torchfra.bank.aircraft``).

    Raises:
        ValueError: an argument out of its range, or no track long enough.
    """
    if outliers not in ("covariance", "std", "none"):
        raise ValueError(f"outliers: expected 'covariance', 'std' or 'none', received {outliers!r}")
    if sensor not in ("bearings", "radar", "position"):
        raise ValueError(f"sensor: expected 'bearings', 'radar' or 'position', received {sensor!r}")
    if steps < _SHORTEST or not 0 <= share <= 1 or not size >= 1:
        raise ValueError(
            f"steps, share, size: expected {_SHORTEST} or more, in [0, 1], 1 or more, received {steps}, {share}, {size}"
        )
    windows = _windows(recordings, dt, steps, max_gap)
    centre, reach = _frame(windows)
    angle = math.radians(0.1)
    model: Bearings | RangeBearing | Position
    south = centre - reach * torch.tensor([0.0, 1.5], dtype=torch.float64)
    if sensor == "bearings":
        model = Bearings(angle if std is None else torch.as_tensor(std, dtype=torch.float64))
        aside = reach * torch.tensor([1.0, 0.0], dtype=torch.float64)
        places = torch.cat([south - aside, south + aside], -1)
    elif sensor == "position":
        model, places = Position(30.0 if std is None else torch.as_tensor(std, dtype=torch.float64)), None
    else:
        model = RangeBearing(torch.as_tensor((50.0, angle) if std is None else std, dtype=torch.float64))
        places = south
    assert model.std is not None
    sigma, grown = model.std(), {"covariance": math.sqrt(size), "std": size, "none": 1.0}[outliers]

    def block(rng: np.random.Generator, numbers: Tensor) -> Tracks:
        window = numbers % len(windows)
        draw = torch.from_numpy(rng.standard_normal((BLOCK, 6 + steps * model.size)))
        wild = torch.from_numpy(rng.random((BLOCK, steps, 1))) < share
        truth = windows[window]
        u = None if places is None else places[window].unsqueeze(1).expand(-1, steps, -1)
        noise = draw[:, 6:].unflatten(1, (steps, model.size)) * torch.where(wild, grown, 1.0)
        start = truth[:, 0] * torch.tensor([1.0, 1.0, 1.0, 1.0, 0.0, 0.0], dtype=torch.float64)
        truth = truth[:, 1:]
        return Tracks(truth, model(truth, u) + sigma * noise, u, Gaussian(start + draw[:, :6] @ _ROOT, _ROOT))

    settings = {
        "sensor": sensor, "windows": len(windows), "recordings": len(recordings), "max_gap": max_gap,
        "std": sigma.tolist(), "outliers": outliers, "share": share, "size": size, "q": q,
    }  # fmt: skip
    motion = ConstantAcceleration(q)
    centre_of_all = Gaussian(windows[0, 0] * torch.tensor([1.0] * 4 + [0.0] * 2, dtype=torch.float64), _ROOT)
    return Scenario("recorded", motion, model, centre_of_all, dt, steps, block, settings, aircraft(q))


def _windows(recordings: Sequence[Recording], dt: float, steps: int, max_gap: float) -> Tensor:
    """States ``(W, steps + 1, 6)`` of all windows, NaN behind the end of a track."""
    windows = []
    for recording in recordings:
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
