"""The result of cleaning a track."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchfra.cleaning.closed_form import Levels, OutlierModel
from torchfra.readers.columns import Array
from torchfra.readers.recording import Recording

if TYPE_CHECKING:
    from torchfra.filters.gpb import GPB

FLAGS = ("", "outlier", "manoeuvre", "unclear")
"""What a step can be: usual, an outlier, a manoeuvre, or unclear: perhaps an outlier."""


class Segment(NamedTuple):
    """A manoeuvre."""

    begin: float
    """Seconds since the first fix."""
    end: float
    kind: str
    """``"left turn"``, ``"right turn"``, ``"speeding up"``, ``"slowing down"``, ``"climbing"``, ``"descending"``."""
    rate: float
    """Deg/s of a turn, counter-clockwise positive; m/s^2 of a change of speed; m/s of a climb."""


class FilterParameters(NamedTuple):
    """Parameters of the default filter for some axes of a track."""

    dims: int
    """The number of axes."""
    levels: Levels
    """Levels of the process noise, ``(J, 1)``."""
    sigma: Tensor
    """``(1,)`` standard deviation of a fix, m; where fixes have their own, the median."""
    model: OutlierModel
    """How likely outliers are."""


@dataclass(frozen=True)
class Found:
    """The settings of a cleaned track; each value was given, or estimated by maximum likelihood."""

    filter: str
    smooth: bool
    bank: str
    """The kind of target, such as ``"aircraft"``; ``"any"`` if nobody says one, ``"own"`` for a ``Bank``."""
    sigma: float
    """Standard deviation of a fix per axis, m; where each fix has its own, a factor on those."""
    q: float
    """Density of the process noise per second, m^2/s^3 of motions of constant velocity."""
    nis: float
    """Mean normalised innovation squared per element of the fixes that are no outliers: 1 if both are right."""
    estimated: frozenset[str] = frozenset()
    """Which of ``sigma`` and ``q`` were estimated and not given."""
    notes: tuple[str, ...] = ()
    """Lines for a reader: sigma of the height, wrong time stamps, a sigma that varies."""
    stated: bool = False
    """Whether the file states the standard deviation of each fix, on which sigma is a factor."""
    sigma_unsure: str = ""
    """Why an estimated sigma is unsure; "" if it is not."""
    failure: str = ""
    """Why the track could not be cleaned at all; "" if it was."""


@dataclass(frozen=True, eq=False, repr=False)
class Cleaned:
    """A recording after cleaning; ``T`` steps, ``d`` dimensions of space."""

    recording: Recording
    time: Array
    """``(T,)`` seconds since the first fix; one step for each fix, and others between them if ``dt`` was given."""
    row: NDArray[np.int64]
    """``(T,)`` which fix of the recording it is, whose row in the file ``recording.row`` has; -1 between fixes."""
    raw: Array
    """``(T, d)`` positions as recorded, m; NaN at steps between fixes."""
    mean: Array
    """``(T, 2 d)`` position and velocity, m and m/s."""
    covariance: Array
    """``(T, 2 d, 2 d)`` of position and velocity."""
    nis: Array
    """``(T,)`` normalised innovation squared of the filter."""
    outlier: Array
    """``(T,)`` probability that the fix is an outlier; NaN for filters without such a probability."""
    manoeuvre: Array
    """``(T,)`` probability of a manoeuvre; NaN of other filters than the default one."""
    flag: NDArray[np.str_]
    """``(T,)`` of ``FLAGS``."""
    found: Found
    segments: tuple[Segment, ...] = ()
    parameters: tuple[FilterParameters, ...] = ()
    """Those of the default filter: across the ground, and of the height where there is one."""

    def filters(self) -> tuple[GPB, ...]:
        """The default filter as a module for each of ``parameters``; empty for other filters.

        Each takes the positions of its axes, of a batch of one track, and continues from any belief of these and their
        velocities.
        """
        from torchfra.cleaning.as_module import as_gpb  # the other filters take long to import

        return tuple(as_gpb(part.levels, part.sigma, part.model, part.dims) for part in self.parameters)

    def __repr__(self) -> str:
        """Name, counts and sigma, in a line."""
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
    def residual(self) -> Array:
        """``(T,)`` distance of the fix from the cleaned position, m; NaN between fixes.  An altitude may be missing."""
        gap = self.raw - self.position
        distance: Array = np.linalg.norm(np.column_stack([gap[:, :2], np.nan_to_num(gap[:, 2:])]), axis=1)
        return distance

    @property
    def failed(self) -> NDArray[np.bool_]:
        """``(T,)`` which steps have an estimate that is not finite."""
        finite = np.isfinite(self.mean).all(1) & np.isfinite(self.covariance).all((1, 2))
        return np.asarray(~finite)
