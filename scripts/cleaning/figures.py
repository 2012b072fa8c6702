"""Figures of cleaned runs, from counts that are summed over runs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cleaning.constant_velocity import best
from cleaning.measured import Case, Measured
from torchfra.cleaning import Cleaned, Segment
from torchfra.cleaning.segments import inside
from torchfra.readers.columns import Array

BANDS = {68: 0.994457883, 95: 1.959963985}
"""Standard deviations to either side that hold so many percent of a normal distribution."""
RATE, LASTING, SLACK = 1.5, 10.0, 0.5
"""Turns that count: deg/s or more for so many seconds; what turns at this share of it is no turn, and no false one."""
SHARES = {
    "outlier_precision": ("right", "flagged"), "outlier_recall": ("found", "far"),
    "turn_precision": ("true", "listed"), "turn_recall": ("met", "turning"),
    "band_68": ("within_68", "values"), "band_95": ("within_95", "values"),
}  # fmt: skip
"""Figures that are shares, and of what: fields of ``Counts``."""
SLOWEST = 1.0
"""Speed below which there is no direction that could turn, m/s, before the truth's scale."""


@dataclass
class Counts:
    """Sums over the steps of all runs."""

    steps: int = 0
    squared: float = 0.0
    """Squared errors across the ground, m^2."""
    fixes: int = 0
    """Fixes that are no outliers."""
    squared_there: float = 0.0
    """Squared errors of these after cleaning, m^2."""
    raw: float = 0.0
    """Squared errors of these before cleaning, m^2."""
    squared_all: float = 0.0
    raw_all: float = 0.0
    """Squared errors in all dimensions, m^2."""
    squared_up: float = 0.0
    raw_up: float = 0.0
    """Squared errors of the heights that are not missing, m^2."""
    far: int = 0
    """Outliers beyond 6 sigma."""
    found: int = 0
    """Outliers beyond 6 sigma that are flagged."""
    flagged: int = 0
    right: int = 0
    """Flagged fixes, and of them those that are outliers."""
    turning: float = 0.0
    met: float = 0.0
    """Seconds of true turns, and of them those in a segment."""
    listed: float = 0.0
    true: float = 0.0
    """Seconds of listed turns, and of them those in which the truth turns that way."""
    values: int = 0
    within_68: int = 0
    within_95: int = 0
    """Coordinates, and how many of the true ones lie within each band."""
    sigma: list[float] = field(default_factory=list)
    """Ratio of the estimated to the true sigma, of each run."""
    failed: int = 0
    """Runs without an estimate."""


def add(counts: Counts, run: Measured, cleaned: Cleaned) -> None:
    """Adds a run."""
    at = np.flatnonzero(cleaned.row >= 0)
    error = np.full_like(run.truth, np.inf)
    error[cleaned.row[at]] = cleaned.position[at] - run.truth[cleaned.row[at]]
    good = ~run.outlier
    counts.failed += not np.isfinite(error).all()
    error = np.where(np.isfinite(error), error, 1e6)  # far off, and still a number in JSON
    counts.steps += len(error)
    counts.squared += float(np.square(error[:, :2]).sum())
    counts.squared_there += float(np.square(error[good, :2]).sum())
    counts.squared_all += float(np.square(error[good]).sum())
    counts.fixes += int(good.sum())
    counts.raw += float(np.square(run.noise[good, :2]).sum())
    counts.raw_all += float(np.square(run.noise[good]).sum())
    tall = good if run.no_height is None else good & ~run.no_height
    counts.squared_up += float(np.square(error[tall, 2:]).sum())
    counts.raw_up += float(np.square(run.noise[tall, 2:]).sum())
    flagged = np.zeros(len(good), bool)
    flagged[cleaned.row[at]] = cleaned.flag[at] == "outlier"
    counts.far += int(run.far.sum())
    counts.found += int((run.far & flagged).sum())
    counts.flagged += int(flagged.sum())
    counts.right += int((flagged & run.outlier).sum())
    std = np.full_like(run.truth, np.nan)
    std[cleaned.row[at]] = cleaned.std[at]
    counts.values += error.size
    counts.within_68 += int((np.abs(error) <= BANDS[68] * std).sum())
    counts.within_95 += int((np.abs(error) <= BANDS[95] * std).sum())
    counts.sigma.append(cleaned.found.sigma / run.case.sigma)
    _add_turns(counts, run, cleaned.segments)


def _add_turns(counts: Counts, run: Measured, segments: Sequence[Segment]) -> None:
    """Adds the seconds of true and of listed turns to either side."""
    truth = run.case.truth
    if truth.pace != 1.0:
        return  # who walks turns on the spot
    seconds = np.arange(run.window[0], run.window[-1] + 1)
    rate = turn_rates(truth.position, truth.dt, SLOWEST * truth.scale)[seconds]
    time = truth.dt * (seconds - seconds[0])
    for name, side in (("left turn", 1), ("right turn", -1)):
        true, slack = lasting(side * rate >= RATE, round(LASTING / truth.dt)), side * rate >= SLACK * RATE
        turns = [segment for segment in segments if segment.kind == name]
        counted = [one for one in turns if abs(one.rate) >= RATE and one.end - one.begin >= LASTING]
        met, listed = inside(time, turns), inside(time, counted)
        counts.turning += truth.dt * float(true.sum())
        counts.met += truth.dt * float((true & met).sum())
        counts.listed += truth.dt * float(listed.sum())
        counts.true += truth.dt * float((listed & slack).sum())


def turn_rates(path: Array, dt: float, slowest: float) -> Array:
    """Deg/s ``(k,)`` across the ground, to the left positive; 0 where it is too slow to have a direction."""
    velocity = np.gradient(path[:, :2], dt, axis=0)
    heading = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
    rate = np.degrees(np.gradient(heading, dt))
    return np.where(np.linalg.norm(velocity, axis=1) >= slowest, rate, 0.0)


def lasting(on: NDArray[np.bool_], steps: int) -> NDArray[np.bool_]:
    """Where ``on (k,)`` holds for so many steps or more."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], on.astype(int), [0]])))
    kept = np.zeros(len(on), bool)
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        kept[begin:end] = end - begin >= steps
    return kept


def figures(case: Case, counts: Counts, runs: Sequence[Measured]) -> dict[str, object]:
    """The figures of a case; None where there is nothing to divide by."""
    truth = runs[0].truth[:, :2]
    z = np.stack([run.truth[:, :2] + run.noise[:, :2] for run in runs])
    sigma = case.sigma if case.truth.plain else math.sqrt(np.mean([np.square(run.noise[:, :2]).mean() for run in runs]))
    to_beat = best(z, np.stack([~run.outlier for run in runs]), case.period * case.truth.pace, sigma, truth)
    rmse = math.sqrt(counts.squared / counts.steps)
    speed = float(np.median(np.linalg.norm(np.diff(truth, axis=0), axis=1))) / case.period / case.truth.pace
    return {
        "case": case.name, "kind": case.truth.kind, "name": case.truth.name, "period": case.period,
        "noise": case.noise, "sigma": case.sigma, "runs": len(runs), "steps": len(truth), "speed": speed,
        "moved": case.truth.moved, "rmse": rmse,
        "of_raw": math.sqrt(counts.squared_there / counts.raw),
        "of_raw_at_outliers_too": rmse / math.sqrt(counts.raw / counts.fixes),
        "of_raw_in_space": math.sqrt(counts.squared_all / counts.raw_all),
        "of_raw_up": math.sqrt(counts.squared_up / counts.raw_up) if counts.raw_up else None,
        "of_best": rmse / to_beat.rmse, "best_q": to_beat.q,
        "best_of_raw": to_beat.there / math.sqrt(counts.raw / counts.fixes),
        "sigma_found": float(np.mean(counts.sigma)), "sigma_least": min(counts.sigma), "sigma_most": max(counts.sigma),
        **shares(counts), "failed": counts.failed, "counts": vars(counts),
    }  # fmt: skip


def shares(counts: Counts) -> dict[str, float | None]:
    """The shares of a case; None where the denominator is 0."""
    of = vars(counts)
    return {name: of[part] / of[whole] if of[whole] else None for name, (part, whole) in SHARES.items()}
