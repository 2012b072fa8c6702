"""Filters recorded positions: the work of ``torchfra track``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchfra.app.compiling import Fallback, compiled
from torchfra.app.filtered import Array, Filtered
from torchfra.app.progress import progress_bar
from torchfra.catalogue import FILTERS, make_filter
from torchfra.filters import GPB, AlphaBetaInfo, Filter, FRAInfo, GPBInfo, Info
from torchfra.hyper import Value
from torchfra.motion.bank import Bank, aircraft
from torchfra.motion.polynomial import ConstantAcceleration
from torchfra.readers.recording import Recording
from torchfra.sensors.position import Position
from torchfra.types import Estimate, Gaussian

GATE = {2: 13.816, 3: 16.266}
"""Normalised innovation squared that one good fix in 1000 exceeds, by dimensions of space (chi-square)."""
DEFAULT = "gpb"
"""The filter that is used unless told otherwise."""
LONGEST_GAP = 60.0
"""Seconds without a usable fix after which a filter of constant gains restarts."""
_TOGETHER = 32
"""Recordings that are filtered as one batch."""
_MOST_STEPS = 10**7
"""Of a grid between fixes."""


def track(
    recordings: Sequence[Recording],
    name: str = DEFAULT,
    *,
    dt: float | None = None,
    sigma: float = 25.0,
    q: float = 1.0,
    compile: bool = False,
    fallback: Fallback | None = None,
    progress: bool = False,
) -> list[Filtered]:
    """Recordings through a filter with a position sensor and constant acceleration, or a bank of motions.

    Args:
        recordings: from ``torchfra.readers.read``.
        name: of the filter, out of ``catalogue.track_filters()``.
        dt: seconds; also estimates at every multiple of it after the first fix, beside those at the fixes.
        sigma: standard deviation of a recorded position per axis, m.
        q: variance of the change of acceleration per step, m^2/s^4.
        compile: whether to run compiled (``Filter.compile``); needs a C++ compiler.
        fallback: called if the filter cannot be compiled, and runs interpreted; None raises the error.
        progress: whether to show a bar.

    Raises:
        ValueError: an unknown filter, or a value out of its range.
        CompileError: the filter cannot be compiled, and there is no ``fallback``.
    """
    check_settings(name, dt, sigma, q)
    done: dict[int, Filtered] = {}
    for group in progress_bar(_groups(recordings), "group", progress):
        part = [recordings[i] for i in group]
        grids = [_grid(r, dt) for r in part]
        z, gaps = _padded(grids)
        f, prior = _make(name, z.shape[-1], sigma, q, _periods(part)), _prior(z, sigma)
        if compile:
            few = partial(_run, z=z[:, :2], gaps=gaps[:, :2], prior=prior)  # makes the kernel
            interpreted, f = f, compiled({name: f}, few, fallback=fallback)[name]
            compile = f is not interpreted  # a kernel that is refused once is not tried again
        done |= zip(group, _split(part, grids, _run(f, z, gaps, prior), _models(f)), strict=True)
    return [done[i] for i in range(len(recordings))]


def check_settings(name: str, dt: float | None, sigma: float, q: float) -> None:
    """Checks arguments of ``track``.

    Raises:
        ValueError: an unknown filter, or a value out of its range.
    """
    if not 0 < sigma < math.inf:
        raise ValueError(f"sigma: expected metres above 0, received {sigma}")
    if not 0 <= q < math.inf:
        raise ValueError(f"q: expected m^2/s^4 of 0 or more, received {q}")
    if dt is not None and not 0 < dt < math.inf:
        raise ValueError(f"dt: expected seconds above 0, received {dt}")
    _make(name, 2, sigma, q)


def successive_steps(recordings: Sequence[Recording]) -> int:
    """Steps that a filter takes one after the other at the fixes, where recordings of similar length are one batch."""
    return sum(max(len(recordings[i].time) for i in group) for group in _groups(recordings))


def _groups(recordings: Sequence[Recording]) -> list[list[int]]:
    """Numbers of the recordings that are filtered together: of the same dimensions and similar length."""
    groups = []
    for d in (2, 3):
        part = [i for i, recording in enumerate(recordings) if recording.position.shape[1] == d]
        part.sort(key=lambda i: len(recordings[i].time))
        groups += [part[i : i + _TOGETHER] for i in range(0, len(part), _TOGETHER)]
    return groups


def _padded(grids: Sequence[tuple[Array, Array]]) -> tuple[Tensor, Tensor]:
    """Positions ``(B, T, d)`` and steps ``(B, T)`` of all as one batch; the shorter ones end in NaN."""
    steps, d = max(len(time) for time, _ in grids), grids[0][1].shape[1]
    z = torch.full((len(grids), steps, d), torch.nan, dtype=torch.float64)
    gaps = torch.ones(len(grids), steps, dtype=torch.float64)
    for i, (time, raw) in enumerate(grids):
        z[i, : len(time)] = torch.from_numpy(raw)
        gaps[i, 1 : len(time)] = torch.from_numpy(np.diff(time))
    return z, gaps


def _periods(recordings: Sequence[Recording]) -> Tensor:
    """Seconds ``(B,)`` within which nearly all fixes of each recording follow each other."""
    gaps = [np.diff(r.time) if len(r.time) > 1 else [1.0] for r in recordings]
    return torch.tensor([np.quantile(g, 0.9) for g in gaps], dtype=torch.float64)


def _prior(z: Tensor, sigma: float) -> Gaussian:
    """At the first fix, of any speed."""
    d = z.shape[-1]
    mean = torch.cat([z[:, 0], torch.zeros(len(z), 2 * d, dtype=torch.float64)], -1)
    std = torch.tensor([10 * sigma, 300.0, 5.0], dtype=torch.float64).repeat_interleave(d)
    return Gaussian(mean, std.diag())


def _run(f: Filter, z: Tensor, gaps: Tensor, prior: Gaussian) -> Estimate:
    with torch.no_grad():
        estimate: Estimate = f(z, prior, dt=gaps)
    return estimate


def _make(name: str, d: int, sigma: float, q: float, period: Value = 1.0) -> Filter:
    """The filter of this name for positions in ``d`` dimensions, where nearly all fixes come within ``period``."""
    entry, options = FILTERS.get(name), dict[str, Value]()
    if entry is not None and entry.gated:
        options["gate"] = GATE[d]
    if entry is not None and entry.constant_gains:
        options |= {"longest": LONGEST_GAP, "period": period}
    return make_filter(name, ConstantAcceleration(q, d), Position(sigma, dims=d), aircraft(q, d), **options)


def _models(f: Filter) -> tuple[str, ...]:
    """Names of what the filter weighs at each step: motions, or the regimes of these; none if it has one motion."""
    motions = tuple(f.motion.names) if isinstance(f.motion, Bank) else ()
    if not isinstance(f, GPB):
        return motions
    first, *others = motions
    return f"calm {first}", f"agile {first}", *others, "jump"


def _split(
    recordings: Sequence[Recording], grids: Sequence[tuple[Array, Array]], estimate: Estimate, models: Sequence[str]
) -> list[Filtered]:
    """What is known of each recording after they were filtered as one batch."""
    d = grids[0][1].shape[1]
    outlier, manoeuvre, decided = _flags(estimate, GATE[d])
    std = estimate.scale_tril.square().sum(-1).sqrt()
    info = estimate.info
    weights = info.regimes if isinstance(info, GPBInfo) else info.probabilities if models else None
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
        leading = None if weights is None else weights[i, :k].argmax(-1).numpy()
        arrays = (time, raw, position, velocity, spread, nis)
        results.append(Filtered(recording, *arrays, flags, decided, tuple(models), leading))
    return results


def _grid(recording: Recording, dt: float | None) -> tuple[Array, Array]:
    """Times since the first fix ``(T,)`` and positions there ``(T, d)``, NaN between fixes."""
    time = recording.time - recording.time[0]
    if dt is None:
        return time, recording.position
    if time[-1] > _MOST_STEPS * dt:
        raise ValueError(f"dt: expected at most {_MOST_STEPS:,} steps, received {dt} s in a track of {time[-1]:g} s")
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


def _flags(estimate: Estimate, gate: float) -> tuple[Tensor, Tensor, bool]:
    """Outliers and manoeuvres ``(..., T)``, and whether the filter tells one from the other.

    As it decided, or by the probability of an outlier in any block, or else by the gate and its fading factors.
    """
    abnormal, adapted = estimate.nis > gate, torch.zeros_like(estimate.nis, dtype=torch.bool)
    match estimate.info:
        case AlphaBetaInfo(rejected=rejected, manoeuvre=manoeuvre):  # of each axis
            return rejected.any(-1), (manoeuvre & ~rejected).any(-1), True
        case FRAInfo(abnormal=abnormal, adaptive=adaptive, plain=plain):
            return abnormal & ~adaptive & ~plain, abnormal & adaptive, True
        case object(outlier=Tensor() as probability):
            outlier = (probability > 0.5).any(-1)
            return outlier, abnormal & ~outlier, True
        case Info(fading=Tensor() as fading):
            adapted = abnormal & (fading > 1)
    return abnormal & ~adapted, adapted, False
