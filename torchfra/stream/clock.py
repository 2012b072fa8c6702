"""The clock of a track, which never goes back, beside the one outside, which may be set back."""

from __future__ import annotations

import math
from collections.abc import Mapping


class Clock:
    """Converts times of an outside clock to those of the track and back.

    Args:
        jump: seconds that a time is before the newest where the clock outside was set back; None if it never is.
    """

    def __init__(self, jump: float | None) -> None:
        self.jump = jump
        self.behind, self.before = 0.0, 0.0  # of the clock outside, now and before it was set back last
        self.back = -math.inf  # s in the track when that was noticed
        self.gap = 0.0  # seconds of the last step

    def inside(self, time: float, newest: float) -> tuple[float, bool]:
        """The time in the track of a measurement, and whether it says that the clock was set back.

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
        """A time in the track, by the clock outside."""
        return inside - self.behind

    def tick(self, time: float, inside: float, newest: float, jumped: bool) -> None:
        """Goes on to a measurement that was taken in, after the one that was ``newest``."""
        if jumped:
            self.before, self.back, self.behind = self.behind, inside, inside - time
        elif inside > newest:
            self.gap = inside - newest

    def state_dict(self) -> dict[str, float]:
        """All of it but what it was made with."""
        return {"behind": self.behind, "before": self.before, "back": self.back, "gap": self.gap}

    def load_state_dict(self, values: Mapping[str, float]) -> None:
        """Goes on as the one that was saved."""
        self.behind, self.before, self.back, self.gap = (values[x] for x in ("behind", "before", "back", "gap"))
