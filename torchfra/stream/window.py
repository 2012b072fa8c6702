"""The measurements of late, in the order of their times, each with the state after it."""

from __future__ import annotations

import math
from bisect import bisect_left
from typing import Any, NamedTuple

from torch import Tensor

from torchfra.gaussian.inputs import Measurements
from torchfra.types import Gaussian

Key = tuple[float, int, tuple[tuple[bool, float], ...]]


class At(NamedTuple):
    """An estimate and its time."""

    time: float
    """s."""
    belief: Gaussian


class Entry(NamedTuple):
    """A measurement, and the state after it."""

    time: float
    """s, by the clock of the track."""
    sensor: int
    """The number of its sensor."""
    z: Tensor
    u: Tensor | None
    std: Tensor | None
    noise: Tensor | None
    state: Any = None

    @property
    def key(self) -> Key:
        """Its place among others: by time, at one instant by sensor, and of one sensor by what was measured."""
        values = ((math.isnan(x), 0.0 if math.isnan(x) else x) for x in self.z.flatten().tolist())
        return self.time, self.sensor, tuple(values)

    def same(self, other: Entry) -> bool:
        """Whether the other is this one once more."""
        parts = zip(self[2:6], other[2:6], strict=True)
        return self[:2] == other[:2] and all(_equal(a, b) for a, b in parts)

    def after(self, time: float) -> Measurements:
        """What a step from ``time`` is given."""
        return Measurements(self.z, self.time - time, self.u, self.std, self.noise)


class Window:
    """States that may still change, as measurements before them may come.

    Args:
        time: of the state before all of them.
        state: that state.
    """

    def __init__(self, time: float, state: Any) -> None:
        self.time, self.state = time, state
        self.entries: list[Entry] = []
        self.forgot = False

    @property
    def newest(self) -> float:
        """The time of the newest state."""
        return self.entries[-1].time if self.entries else self.time

    def before(self, place: int) -> tuple[float, Any]:
        """Time and state before the entry at a place."""
        if place == 0:
            return self.time, self.state
        return self.entries[place - 1].time, self.entries[place - 1].state

    def precedes(self, time: float) -> bool:
        """Whether a time is one that no entry can be put in at any more."""
        return time < self.time or (time == self.time and self.forgot)

    def place(self, entry: Entry) -> int:
        """Where an entry belongs."""
        return bisect_left(self.entries, entry.key, key=lambda x: x.key)

    def at(self, time: float) -> tuple[float, Any]:
        """Time and state of the last entry up to a time."""
        return self.before(sum(entry.time <= time for entry in self.entries))

    def holds(self, entry: Entry) -> bool:
        """Whether an entry has been put in before."""
        return any(entry.same(other) for other in self.entries if other.time == entry.time)

    def trim(self, since: float, steps: int | None) -> None:
        """Forgets entries before a time, and all but the last ``steps``; the newest stays."""
        while len(self.entries) > 1 and (
            self.entries[0].time < since or (steps is not None and len(self.entries) > steps)
        ):
            first = self.entries.pop(0)
            self.time, self.state, self.forgot = first.time, first.state, True


def _equal(a: Tensor | None, b: Tensor | None) -> bool:
    """Whether two arguments are the same, NaN included."""
    if a is None or b is None:
        return a is b
    return a.shape == b.shape and bool(((a == b) | (a.isnan() & b.isnan())).all())
