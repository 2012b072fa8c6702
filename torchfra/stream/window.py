"""The recent measurements of a track in the order of their times, with the states after them, and its clock."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Mapping
from operator import attrgetter
from typing import NamedTuple

from torch import Tensor

from torchfra.gaussian.inputs import Measurements
from torchfra.sensors.base import Sensor
from torchfra.steps.recursion import HasBelief
from torchfra.types import Alarm, Gaussian

_key, _time = attrgetter("key"), attrgetter("time")
Key = tuple[float, int, tuple[tuple[bool, float], ...]]


class At(NamedTuple):
    """An estimate and its time."""

    time: float
    """s."""
    belief: Gaussian


class Known(NamedTuple):
    """State of the filter and alarms after a measurement."""

    state: HasBelief
    alarms: tuple[Alarm, ...]
    """The alarm of each sensor at its last measurement; empty for filters without alarms."""


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
    state: Known | None = None
    """None until it is in a window."""

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

    def after(self, time: float, sensor: Sensor | None) -> Measurements:
        """The inputs of a step from ``time`` to this measurement, by another ``sensor`` than the filter's or None."""
        return Measurements(self.z, self.time - time, self.u, self.std, self.noise, sensor)


class Window:
    """The states that a late measurement may still change.

    Args:
        time: of the state before all of them.
        state: that state.
    """

    def __init__(self, time: float, state: Known) -> None:
        self.time, self.state = time, state
        self.entries: list[Entry] = []
        self.forgot = False

    @property
    def newest(self) -> float:
        """The time of the newest state."""
        return self.entries[-1].time if self.entries else self.time

    def before(self, place: int) -> tuple[float, Known]:
        """Time and state before the entry at a place."""
        if place == 0:
            return self.time, self.state
        entry = self.entries[place - 1]
        assert entry.state is not None
        return entry.time, entry.state

    def precedes(self, time: float) -> bool:
        """Whether a time is before the window, so that no entry can be inserted there."""
        return time < self.time or (time == self.time and self.forgot)

    def place(self, entry: Entry) -> int:
        """The index at which an entry belongs."""
        if entry.time > self.newest:
            return len(self.entries)
        return bisect_left(self.entries, entry.key, key=_key)

    def at(self, time: float) -> tuple[float, Known]:
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
            (self.time, self.state), self.forgot = self.before(1), True
            entries.pop(0)


def _equal(a: Tensor | None, b: Tensor | None) -> bool:
    """Whether two arguments are the same, NaN included."""
    if a is None or b is None:
        return a is b
    return a.shape == b.shape and bool(((a == b) | (a.isnan() & b.isnan())).all())


class Clock:
    """Converts times of an outside clock, which may be set back, to those of the track, which never go back.

    Args:
        jump: a time that is so many seconds before the newest comes from a clock that was set back; None if it never
            is.
    """

    def __init__(self, jump: float | None) -> None:
        self.jump = jump
        self.behind, self.before = 0.0, 0.0
        """Seconds that the outside clock is behind that of the track, now and before it was set back last."""
        self.back = -math.inf
        """Time in the track, s, when that was noticed."""
        self.gap = 0.0
        """Seconds of the last step."""

    def inside(self, time: float, newest: float) -> tuple[float, bool]:
        """The time in the track of a measurement, and whether it shows that the clock was set back.

        After that, a time at least ``jump`` after the newest is read by the clock before it was set back, if that gives
        a time within the last ``jump`` seconds.
        """
        inside, earlier = time + self.behind, time + self.before
        if self.jump is None:
            return inside, False
        if inside <= newest - self.jump:
            return newest + self.gap, True
        of_late = newest - self.jump < earlier < self.back
        return (earlier if of_late and inside >= newest + self.jump else inside), False

    def outside(self, inside: float) -> float:
        """A time in the track, by the outside clock."""
        return inside - self.behind

    def tick(self, time: float, inside: float, newest: float, jumped: bool) -> None:
        """Advances to a measurement that was used, after the one that was ``newest``."""
        if jumped:
            self.before, self.back, self.behind = self.behind, inside, inside - time
        elif inside > newest:
            self.gap = inside - newest

    def state_dict(self) -> dict[str, float]:
        """All values but ``jump``."""
        return {"behind": self.behind, "before": self.before, "back": self.back, "gap": self.gap}

    def load_state_dict(self, values: Mapping[str, float]) -> None:
        """Takes the values that were saved.

        Raises:
            KeyError: one is not there.
            TypeError: one is no number.
        """
        numbers = [values[x] for x in ("behind", "before", "back", "gap")]
        if not all(isinstance(x, int | float) for x in numbers):
            raise TypeError
        self.behind, self.before, self.back, self.gap = numbers
