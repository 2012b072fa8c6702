"""Filters recorded positions themselves: what stands behind ``torchfra track``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchfra.app.progress import progress_bar
from torchfra.catalogue import make_filter
from torchfra.filters import Filter
from torchfra.hyper import Value
from torchfra.motion.bank import Bank, aircraft
from torchfra.motion.polynomial import ConstantAcceleration
from torchfra.readers.recording import Recording
from torchfra.sensors.position import Position
from torchfra.types import Estimate, Gaussian

Array = NDArray[np.float64]


GATE = {2: 13.816, 3: 16.266}
"""Normalised innovation squared that one good fix in 1000 exceeds, by dimensions of space (chi-square)."""


_TOGETHER = 32


@dataclass(frozen=True, eq=False)
class Filtered:
    """A recording after a filter; ``T`` steps, ``d`` dimensions of space."""

    recording: Recording
    time: Array
    """``(T,)`` seconds since the first fix."""
    raw: Array
    """``(T, d)`` positions as recorded, m; NaN at steps between fixes."""
    position: Array
    """``(T, d)`` m."""
    velocity: Array
    """``(T, d)`` m/s."""
    std: Array
    """``(T, d)`` standard deviation of the position, m."""
    nis: Array
    """``(T,)`` normalised innovation squared."""
    flags: dict[str, NDArray[np.bool_]]
    """``missing``, ``outlier``, ``manoeuvre``: ``(T,)`` each."""
    models: tuple[str, ...] = ()
    """Names of the models, where some interact."""
    leading: NDArray[np.intp] | None = None
    """``(T,)`` the most probable of them."""

    def columns(self) -> dict[str, Any]:
        """The columns of a table, by name; with latitude and longitude where the recording has an origin."""
        axes = "xyz"[: self.raw.shape[1]]
        table: dict[str, Any] = {"time": self.recording.time[0] + self.time}
        for prefix, values in (("raw_", self.raw), ("", self.position), ("v", self.velocity), ("std_", self.std)):
            table |= {prefix + axis: values[:, i] for i, axis in enumerate(axes)}
        if self.recording.origin is not None:
            table |= self._geodetic(self.recording.origin)
        table |= {"nis": self.nis} | {name: flag.astype(int) for name, flag in self.flags.items()}
        return table if self.leading is None else table | {"model": np.array(self.models)[self.leading]}

    def csv(self) -> str:
        """The table as text; an empty cell is no number."""
        table = self.columns()
        digits = {"time": 3, "latitude": 7, "longitude": 7}
        cells = [
            [str(v) if v.dtype.kind in "iU" else "" if np.isnan(v) else f"{v:.{digits.get(name, 3)}f}" for v in column]
            for name, column in table.items()
        ]
        return "\n".join([",".join(table), *(",".join(row) for row in zip(*cells, strict=True))]) + "\n"

    def summary(self) -> dict[str, Any]:
        """What happened, in numbers."""
        counts = {name: int(flag.sum()) for name, flag in self.flags.items()}
        off = np.linalg.norm(self.raw - self.position, axis=1)
        return {
            "name": self.recording.name,
            "steps": len(self.time),
            "seconds": float(self.time[-1]),
            **counts,
            "median_correction": float(np.nanmedian(off)),
            "largest_correction": float(np.nanmax(off)),
            "failed": bool(~np.isfinite(self.position).all()),
            "repairs": self.recording.repairs,
            **({} if self.leading is None else {"steps_led": self._steps_led(self.leading)}),
        }

    def _steps_led(self, leading: NDArray[np.intp]) -> dict[str, int]:
        counts = np.bincount(leading, minlength=len(self.models)).tolist()
        return dict(zip(self.models, counts, strict=True))

    def _geodetic(self, origin: tuple[float, float, float]) -> dict[str, Array]:
        from pymap3d import enu2geodetic  # there, or the recording could not have been read

        up = self.position[:, 2] if self.position.shape[1] == 3 else 0.0
        latitude, longitude, _ = enu2geodetic(self.position[:, 0], self.position[:, 1], up, *origin)
        return {"latitude": latitude, "longitude": longitude}


def track(
    recordings: Sequence[Recording],
    name: str = "fra",
    *,
    dt: float | None = None,
    sigma: float = 25.0,
    q: float = 1.0,
    compile: bool = False,
    progress: bool = False,
) -> list[Filtered]:
    """Recordings through a filter with a position sensor and constant acceleration, or a bank of motions.

    Args:
        recordings: from ``torchfra.readers.read``.
        name: of the filter, out of ``torchfra.evaluate.FILTERS``.
        dt: seconds; also estimates at every multiple of it after the first fix, beside those at the fixes.
        sigma: standard deviation of a recorded position per axis, m.
        q: variance of the change of acceleration per step, m^2/s^4.
        compile: whether to run compiled (``Filter.compile``); needs a C++ compiler.
        progress: whether to show a bar.

    Raises:
        ValueError: an unknown filter, or a value out of its range.
    """
    _filter(name, 2, sigma, q)
    if dt is not None and not dt > 0:
        raise ValueError(f"dt: expected seconds above 0, received {dt}")
    order = sorted(range(len(recordings)), key=lambda i: (recordings[i].position.shape[1], len(recordings[i].time)))
    done: dict[int, Filtered] = {}
    groups = [order[i : i + _TOGETHER] for i in range(0, len(order), _TOGETHER)]
    for group in progress_bar(groups, "group", progress):
        for d in (2, 3):
            part = [i for i in group if recordings[i].position.shape[1] == d]
            if part:
                done |= zip(part, _together([recordings[i] for i in part], name, d, dt, sigma, q, compile), strict=True)
    return [done[i] for i in range(len(recordings))]


def _together(
    recordings: list[Recording], name: str, d: int, dt: float | None, sigma: float, q: float, compile: bool
) -> list[Filtered]:
    """Recordings of ``d`` dimensions as one batch; the shorter ones are missing data at their end."""
    grids = [_grid(r, dt) for r in recordings]
    steps = max(len(time) for time, _ in grids)
    z = torch.full((len(grids), steps, d), torch.nan, dtype=torch.float64)
    gaps = torch.ones(len(grids), steps, dtype=torch.float64)
    for i, (time, raw) in enumerate(grids):
        z[i, : len(time)] = torch.from_numpy(raw)
        gaps[i, 1 : len(time)] = torch.from_numpy(np.diff(time))
    gaps_of = [np.diff(r.time) if len(r.time) > 1 else [1.0] for r in recordings]
    period = torch.tensor([np.quantile(g, 0.9) for g in gaps_of], dtype=torch.float64)
    f = _filter(name, d, sigma, q, period)
    f = f.compile() if compile else f
    start = torch.cat([z[:, 0], torch.zeros(len(z), 2 * d, dtype=torch.float64)], -1)
    first = torch.tensor([10 * sigma, 300.0, 5.0], dtype=torch.float64).repeat_interleave(d).diag()
    with torch.no_grad():
        estimate: Estimate = f(z, Gaussian(start, first), dt=gaps)
    outlier, manoeuvre = _flags(estimate, GATE[d])
    std = estimate.scale_tril.square().sum(-1).sqrt()
    models = tuple(f.motion.names) if isinstance(f.motion, Bank) else ()
    results = []
    for i, (recording, (time, raw)) in enumerate(zip(recordings, grids, strict=True)):
        k = len(time)
        flags = {
            "missing": np.isnan(raw[:, 0]),
            "outlier": outlier[i, :k].numpy(),
            "manoeuvre": manoeuvre[i, :k].numpy(),
        }
        mean, nis = estimate.mean[i, :k].numpy(), estimate.nis[i, :k].numpy()
        position, velocity, spread = mean[:, :d], mean[:, d : 2 * d], std[i, :k, :d].numpy()
        leading = estimate.info.probabilities[i, :k].argmax(-1).numpy() if models else None
        results.append(Filtered(recording, time, raw, position, velocity, spread, nis, flags, models, leading))
    return results


def _filter(name: str, d: int, sigma: float, q: float, period: Value = 1.0) -> Filter:
    """The filter of this name for positions in ``d`` dimensions, where nearly all fixes come within ``period``."""
    options = {"gate": GATE[d]} if "fra" in name else {"longest": 60.0, "period": period} if name == "alphabeta" else {}
    return make_filter(name, ConstantAcceleration(q, d), Position(sigma, dims=d), aircraft(q, d), **options)


def _grid(recording: Recording, dt: float | None) -> tuple[Array, Array]:
    """Times since the first fix ``(T,)`` and positions there ``(T, d)``, NaN between fixes."""
    time = recording.time - recording.time[0]
    if dt is None:
        return time, recording.position
    regular: Array = dt * np.arange(int(time[-1] / dt) + 1, dtype=np.float64)
    between = regular[np.abs(regular - time[_nearest(time, regular)]) > 1e-6 * dt]
    both = np.concatenate([time, between])
    raw = np.concatenate([recording.position, np.full((len(between), recording.position.shape[1]), np.nan)])
    order = np.argsort(both, kind="stable")
    return both[order], raw[order]


def _nearest(time: Array, at: Array) -> NDArray[np.intp]:
    right = np.searchsorted(time, at).clip(1, len(time) - 1)
    nearest: NDArray[np.intp] = right - (at - time[right - 1] < time[right] - at)
    return nearest


def _flags(estimate: Estimate, gate: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Outliers and manoeuvres ``(..., T)``: as FRA decided, or by the gate and the fading factors of another filter."""
    info = estimate.info
    if hasattr(info, "rejected"):
        return info.rejected.any(-1), (info.manoeuvre & ~info.rejected).any(-1)
    if hasattr(info, "abnormal"):
        return info.abnormal & ~info.adaptive, info.abnormal & info.adaptive
    abnormal, fading = estimate.nis > gate, getattr(info, "fading", None)
    adapted = torch.zeros_like(abnormal) if fading is None else abnormal & (fading > 1)
    return abnormal & ~adapted, adapted
