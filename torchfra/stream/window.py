"""The recent measurements in the order of their times, each with the state after it."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from operator import attrgetter
from typing import Any, NamedTuple

from torch import Tensor

from torchfra.gaussian.inputs import Measurements
from torchfra.types import Gaussian

_key, _time = attrgetter("key"), attrgetter("time")
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
        """The sort key: time, at one instant the sensor, and for one sensor the measured values."""
        numbers = (x.flatten().tolist() for x in (self.z, self.std, self.noise, self.u) if x is not None)
        values = ((math.isnan(x), 0.0 if math.isnan(x) else x) for part in numbers for x in part)
        return self.time, self.sensor, tuple(values)

    def same(self, other: Entry) -> bool:
        """Whether both are the same measurement."""
        parts = zip(self[2:6], other[2:6], strict=True)
        return self[:2] == other[:2] and all(_equal(a, b) for a, b in parts)

    def with_state(self, state: Any) -> Entry:
        """The measurement with the state after it."""
        return Entry(*self[:-1], state)

    def after(self, time: float) -> Measurements:
        """The inputs of a step from ``time`` to this measurement."""
        return Measurements(self.z, self.time - time, self.u, self.std, self.noise)


class Window:
    """The states that a late measurement may still change.

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
        """Whether a time is before the window, so that no entry can be inserted there."""
        return time < self.time or (time == self.time and self.forgot)

    def place(self, entry: Entry) -> int:
        """The index at which an entry belongs."""
        if entry.time > self.newest:
            return len(self.entries)
        return bisect_left(self.entries, entry.key, key=_key)

    def at(self, time: float) -> tuple[float, Any]:
        """Time and state of the last entry up to a time."""
        return self.before(bisect_right(self.entries, time, key=_time))

    def holds(self, entry: Entry) -> bool:
        """Whether an entry has been put in before."""
        first, last = (where(self.entries, entry.time, key=_time) for where in (bisect_left, bisect_right))
        return any(entry.same(other) for other in self.entries[first:last])

    def trim(self, since: float, steps: int | None) -> None:
        """Forgets entries before a time, and all but the last ``steps``; those of the newest instant stay."""
        entries, newest = self.entries, self.newest
        while (
            entries
            and entries[0].time < newest
            and (entries[0].time < since or (steps is not None and len(entries) > steps))
        ):
            first = entries.pop(0)
            self.time, self.state, self.forgot = first.time, first.state, True


def _equal(a: Tensor | None, b: Tensor | None) -> bool:
    """Whether two arguments are the same, NaN included."""
    if a is None or b is None:
        return a is b
    return a.shape == b.shape and bool(((a == b) | (a.isnan() & b.isnan())).all())
