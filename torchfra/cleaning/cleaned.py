"""What cleaning gives back of a track."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchfra.cleaning.closed_form import Levels, OutlierModel, as_gpb
from torchfra.filters.alarms import LIKELY
from torchfra.filters.gpb import GPB
from torchfra.readers.columns import Array
from torchfra.readers.recording import Recording

FLAGS = ("", "outlier", "manoeuvre", "unclear")
"""What a step can be: usual, a fix that is wrong, a target that does what its calm motion does not, or either."""


class Segment(NamedTuple):
    """A manoeuvre."""

    begin: float
    """Seconds since the first fix."""
    end: float
    kind: str
    """``"left turn"``, ``"right turn"``, ``"speeding up"``, ``"slowing down"``, ``"climbing"``, ``"descending"``."""
    rate: float
    """How hard: deg/s of a turn, counter-clockwise positive; m/s^2 of a change of speed; m/s of a climb."""


class Used(NamedTuple):
    """What the default filter was run with on some axes of a track."""

    dims: int
    """How many axes."""
    levels: Levels
    """Of the process noise, ``(J, 1)``."""
    sigma: Tensor
    """``(1,)`` standard deviation of a fix, m; where fixes have their own, the median."""
    model: OutlierModel
    """How likely outliers are."""


@dataclass(frozen=True)
class Found:
    """What a track was cleaned with; each value was given, or found from the track's likelihood."""

    filter: str
    smooth: bool
    bank: str
    """The kind of target, such as ``"aircraft"`` (``cleaning.kinds``), or ``"own"`` of one that was handed in."""
    sigma: float
    """Standard deviation of a fix per axis, m; where each fix has its own, a factor on those."""
    q: float
    """Density of the process noise per second, m^2/s^3 of motions of constant velocity."""
    nis: float
    """Mean normalised innovation squared per element of the fixes that are no outliers: 1 if both are right."""
    found: frozenset[str] = frozenset()
    """Which of ``sigma``, ``q`` and ``bank`` were found and not given."""
    said: tuple[str, ...] = ()
    """Lines for a person: why this bank, sigma of the height, time stamps that were off, time-correlated errors."""
    stated: bool = False
    """Whether the file states how good each fix is, so that sigma is a factor on that."""
    doubt: str = ""
    """Why sigma is hardly known, where it was found; "" if it is."""
    failure: str = ""
    """Why the track could not be cleaned at all; "" if it was."""


@dataclass(frozen=True, eq=False, repr=False)
class Cleaned:
    """A recording after cleaning; ``T`` steps, ``d`` dimensions of space, ``R`` regimes."""

    recording: Recording
    time: Array
    """``(T,)`` seconds since the first fix; one step for each fix, and others between them where they were asked."""
    row: NDArray[np.int64]
    """``(T,)`` which fix of the recording it is, whose row in the file ``recording.row`` has; -1 between fixes."""
    raw: Array
    """``(T, d)`` positions as recorded, m; NaN at steps between fixes."""
    mean: Array
    """``(T, 2 d)`` position and velocity, m and m/s."""
    covariance: Array
    """``(T, 2 d, 2 d)`` of these."""
    nis: Array
    """``(T,)`` normalised innovation squared of the filter."""
    outlier: Array
    """``(T,)`` probability that the fix is an outlier; NaN of filters that do not say."""
    manoeuvre: Array
    """``(T,)`` probability of a regime other than the calm one; NaN where unknown."""
    flag: NDArray[np.str_]
    """``(T,)`` of ``FLAGS``."""
    found: Found
    segments: tuple[Segment, ...] = ()
    regimes: tuple[str, ...] = ()
    """Names of the regimes."""
    regime: Array = field(default_factory=lambda: np.empty((0, 0)))
    """``(T, R)`` their probabilities."""
    behind: float = 0.0
    """Seconds by which the path is behind the fixes, as times were cut."""
    used: tuple[Used, ...] = ()
    """What the default filter was run with: across the ground, and of the height where there is one."""

    def filters(self) -> tuple[GPB, ...]:
        """The default filter with what was found, as a module for each part of ``used``; none of other filters.

        Each takes the positions of its axes, of a batch of one track, and continues from any belief of these and their
        velocities.
        """
        return tuple(as_gpb(part.levels, part.sigma, part.model, part.dims) for part in self.used)

    def __repr__(self) -> str:
        """What was found, in a line."""
        fixes, outliers = (int(x.sum()) for x in (self.row >= 0, self.flag == "outlier"))
        found = self.found.failure or f"sigma {self.found.sigma:.3g}"
        return f"Cleaned({self.recording.name!r}: {fixes} fixes, {outliers} outliers, {found})"

    @property
    def position(self) -> Array:
        """``(T, d)`` m."""
        return self.mean[:, : self.raw.shape[1]]

    @property
    def velocity(self) -> Array:
        """``(T, d)`` m/s."""
        return self.mean[:, self.raw.shape[1] :]

    @property
    def std(self) -> Array:
        """``(T, d)`` standard deviation of the position, m."""
        d = self.raw.shape[1]
        variance: Array = np.diagonal(self.covariance, axis1=1, axis2=2)[:, :d]
        return np.sqrt(variance)

    @property
    def off(self) -> Array:
        """``(T,)`` m from the fix to the cleaned position; NaN between fixes.  An altitude may be missing.

        Where times were cut, it is the position when the fix was made, which the path reaches later.
        """
        apart = self.raw - (self.position + self.behind * self.velocity)
        distance: Array = np.linalg.norm(np.column_stack([apart[:, :2], np.nan_to_num(apart[:, 2:])]), axis=1)
        return distance

    @property
    def wrong_for(self) -> Array:
        """``(T,)`` seconds since the first of the fixes in a row that are more likely wrong than right.

        NaN where the last fix is right, or the filter does not say.
        """
        step = np.arange(len(self.time))
        last = np.maximum.accumulate(np.where(np.isnan(self.off), 0, step))
        wrong = self.outlier[last] > LIKELY
        begins = wrong & ~np.concatenate([[False], wrong[:-1]])
        first = np.maximum.accumulate(np.where(begins, step, 0))
        lasted: Array = np.where(wrong, self.time - self.time[first], np.nan)
        return lasted

    @property
    def failed(self) -> NDArray[np.bool_]:
        """``(T,)`` which steps have an estimate that is not finite."""
        finite = np.isfinite(self.mean).all(1) & np.isfinite(self.covariance).all((1, 2))
        return np.asarray(~finite)
