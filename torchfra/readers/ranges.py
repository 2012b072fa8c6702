"""What a recording of ranges is, and how it comes onto a regular grid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from torchfra.readers.columns import Array
from torchfra.readers.recording import Recording

_LONGEST = 10_000_000
"""Most steps of a grid; of more a time or a unit is wrong."""


class RangeGrid(NamedTuple):
    """Ranges on a regular grid."""

    time: Array
    """``(T,)`` seconds."""
    ranges: Array
    """``(T, k)`` metres; NaN where none came."""
    reference: Array | None
    """``(T, d)`` the reference path, m, straight from fix to fix; None without one."""
    dropped: int
    """Ranges that gave way to a later one of the same anchor in the same step."""


@dataclass(frozen=True, eq=False)
class RangeRecording:
    """Ranges of one target from ``k`` anchors."""

    name: str
    """The file or folder that it was read from."""
    names: tuple[str, ...]
    """Of the anchors: what the column says, or the stem of each one's file."""
    anchors: Array
    """``(k, 2)`` or ``(k, 3)`` where they are, m."""
    times: tuple[Array, ...]
    """For each anchor, when ranges came: seconds, strictly increasing; since 1970 if the file counts so."""
    ranges: tuple[Array, ...]
    """For each anchor, as many metres."""
    reference: Recording | None
    """The path that the target took, if it is known."""
    repairs: dict[str, int]
    """Each kind of repair, and the number of rows; empty if there was none.  Those of the path: its own."""

    def on_grid(self, dt: float = 0.1) -> RangeGrid:
        """The ranges at regular times, each at the nearest step; of two in a step the later one counts.

        The grid lasts from the first range to the last one, and no longer than the reference path.

        Args:
            dt: seconds from step to step.

        Raises:
            ValueError: ``dt`` is not above 0, or so small that there are more than ten million steps; or no range came
                while the reference path was recorded.
        """
        if not 0 < dt < math.inf:
            raise ValueError(f"dt: expected seconds above 0, received {dt}")
        begin, end = min(t[0] for t in self.times), max(t[-1] for t in self.times)
        if self.reference is not None:
            begin, end = max(begin, self.reference.time[0]), min(end, self.reference.time[-1])
        if begin > end:
            raise ValueError(f"{self.name}: expected ranges while the reference path was recorded, received none")
        if (end - begin) / dt > _LONGEST:
            raise ValueError(
                f"{self.name}: expected at most {_LONGEST} steps, received {end - begin:.6g} s in steps of {dt:g} s"
            )
        time = begin + dt * np.arange(math.floor((end - begin) / dt + 1e-5) + 1)
        ranges, dropped = np.full((len(time), len(self.names)), np.nan), 0
        for of_anchor, seconds, metres in zip(ranges.T, self.times, self.ranges, strict=True):
            step = np.round((seconds - begin) / dt)
            inside = (step >= 0) & (step < len(time))
            steps = step[inside].astype(np.intp)
            of_anchor[steps] = metres[inside]  # in order of time: the last one stays
            dropped += len(steps) - len(np.unique(steps))
        return RangeGrid(time, ranges, None if self.reference is None else _path(self.reference, time), dropped)


def _path(reference: Recording, time: Array) -> Array:
    """Positions ``(T, d)`` of the reference path."""
    return np.stack([np.interp(time, reference.time, x) for x in reference.position.T], 1)
