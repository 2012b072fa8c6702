"""Simulated fixes of a truth, with noise and outliers, some of them in bursts."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cleaning.simulated import lasting
from cleaning.truths import Truth
from torchfra.readers.columns import Array
from torchfra.readers.recording import Recording, Source

SHARE, SIZES, LENGTHS = 0.03, (100.0, 10_000.0), (2, 5)
"""Of the fixes that are outliers, their least and greatest size in m, and of how many fixes bursts are."""
GHOSTS = 0.5
"""Share of the bursts whose fixes all have one offset: a target beside the target."""


class Case(NamedTuple):
    """A truth with a period and a noise."""

    truth: Truth
    period: float
    """Period, s, before the factor of the truth."""
    noise: float
    """Standard deviation of a fix per axis, m, before the factor of the truth."""

    @property
    def name(self) -> str:
        """Of the case."""
        return f"{self.truth.kind}/{self.truth.name} {self.period:g} s {self.noise:g} m"

    @property
    def sigma(self) -> float:
        """Standard deviation per axis, m."""
        return self.noise * self.truth.scale


@dataclass(frozen=True, eq=False)
class Measured:
    """A run of a case."""

    case: Case
    window: NDArray[np.intp]
    """``(k,)`` which positions of the truth are fixes."""
    noise: Array
    """``(k, d)`` m, of every fix."""
    offset: Array
    """``(k, d)`` of outliers, m; 0 elsewhere."""
    no_height: NDArray[np.bool_] | None = None
    """``(k,)`` which heights are missing; None if all are there."""

    @property
    def truth(self) -> Array:
        """``(k, d)`` m."""
        return self.case.truth.position[self.window]

    @property
    def time(self) -> Array:
        """``(k,)`` seconds."""
        return self.case.truth.dt * (self.window - self.window[0])

    @property
    def outlier(self) -> NDArray[np.bool_]:
        """``(k,)``."""
        return np.asarray(self.offset.any(1))

    @property
    def far(self) -> NDArray[np.bool_]:
        """``(k,)`` outliers beyond 6 sigma."""
        return np.asarray(np.linalg.norm(self.offset, axis=1) > 6 * self.case.sigma)

    def recording(self) -> Recording:
        """The recording that is cleaned."""
        position, source = self.truth + self.noise + self.offset, Source(word=self.case.truth.word)
        return Recording(self.case.name, self.time, position, None, {}, source=source, filled=self.no_height)


def measured(case: Case, steps: int, seed: int, ghosts: float = GHOSTS) -> Measured | None:
    """One run, in which this share of the bursts has one offset; None if the truth is too short for the period.

    A seed and a name fix the random numbers, so that a case is the same whichever others are run beside it.
    """
    window = case.truth.window(case.period, steps)
    if window is None:
        return None
    rng = np.random.default_rng([seed, zlib.crc32(case.name.encode())])
    shape = len(window), case.truth.position.shape[1]
    noise = case.sigma * rng.standard_normal(shape)
    run = Measured(case, window, noise, case.truth.scale * _offsets(rng, ghosts, *shape))
    return run if case.truth.plain else _harder(run, rng)


def _harder(run: Measured, rng: np.random.Generator) -> Measured:
    """The run with time-correlated errors, wrong time stamps, or heights of a transponder, as its truth has them."""
    truth, noise, count = run.case.truth, run.noise, len(run.window)
    if truth.lasting:
        step = truth.dt * float(run.window[1] - run.window[0])
        slow = run.case.sigma * lasting(rng, noise.shape, step, truth.lasting)
        noise = truth.size * slow + truth.white * noise
    if truth.late:
        late = truth.late * np.where(rng.random(count) < 0.2, 1.0, 0.1) * rng.standard_normal(count)
        seen = np.clip(run.window + late / truth.dt, 0, len(truth.position) - 1)
        at = np.stack([np.interp(seen, np.arange(len(axis)), axis) for axis in truth.position.T], 1)
        noise = noise + at - run.truth
    if not truth.coarse:
        return replace(run, noise=noise)
    noise = noise.copy()
    height = run.truth[:, 2] + noise[:, 2]
    noise[:, 2] += np.round(height / truth.coarse) * truth.coarse - height
    return replace(run, noise=noise, no_height=rng.random(count) < 0.1)


def _offsets(rng: np.random.Generator, ghosts: float, steps: int, dims: int) -> Array:
    """Outliers ``(steps, dims)`` of any direction, half of them in bursts."""
    offset, low, high = np.zeros((steps, dims)), *np.log(SIZES)
    mean = sum(range(LENGTHS[0], LENGTHS[1] + 1)) / (LENGTHS[1] - LENGTHS[0] + 1)
    single, burst = SHARE / 2, SHARE / 2 / mean

    def draw(count: int) -> Array:
        direction = rng.standard_normal((count, dims))
        size = np.exp(rng.uniform(low, high, (count, 1)))
        return np.asarray(size * direction / np.linalg.norm(direction, axis=1, keepdims=True))

    step = 0
    while step < steps:
        chance = rng.random()
        length = (
            1 if chance < single else int(rng.integers(LENGTHS[0], LENGTHS[1] + 1)) if chance < single + burst else 0
        )
        if length:
            drawn = draw(1) if length > 1 and rng.random() < ghosts else draw(length)
            offset[step : step + length] = np.broadcast_to(drawn, (length, dims))[: steps - step]
        step += max(length, 1)
    return offset
