"""Kinds of targets, which a file or a caller says, and bounds on their manoeuvres."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from torchfra.cleaning.second_differences import second_differences, spread
from torchfra.readers.recording import Recording
from torchfra.readers.sanity import speed_across
from torchfra.readers.smoothing import differences


class Kind(NamedTuple):
    """A kind of targets."""

    acceleration: float
    """Horizontal acceleration of the hardest manoeuvres, m/s^2."""
    climb: float
    """Vertical acceleration of the hardest manoeuvres, m/s^2."""
    fastest: float
    """Speed up to which a target may be of this kind, m/s; no process noise changes its velocity by more in a step."""
    steady: float = math.inf
    """Seconds between fixes from which on it may keep a slow course, although it could stop between them."""


KINDS = {
    "person": Kind(3.0, 1.0, 6.0),
    "ship": Kind(0.5, 0.5, 30.0),
    "vehicle": Kind(6.0, 2.0, 60.0),
    "aircraft": Kind(10.0, 2.0, 1000.0),
    "marine": Kind(1.0, 1.0, 4.0, steady=1000.0),
    "animal": Kind(5.0, 2.0, 10.0, steady=1000.0),
    "bird": Kind(10.0, 3.0, 30.0),
}
"""Kinds by name.  Animals that swim or dive are marine; an animal may be of any species."""
UNKNOWN = "any"
"""Name of the kind of a target of which nobody says what it is."""
_OTHER_WORDS = {"marine animal": "marine", "glider": "aircraft", "drone": "aircraft"}
"""Kinds by other words of files for targets."""
USUAL = 0.2
"""Share of its hardest acceleration, along the track, that a target is below at four in five fixes."""
_FASTER = 5.0
"""Largest ratio of the speed of a target to that of its kind, if a user states the kind."""
_MANY = 25
"""Fixes from which on this ratio is checked."""
_CHANGES, _LEAST_CHANGE = 4.3, 6.0
"""Largest change of the velocity of an unknown target in a step, in units of its own speed, and m/s at least."""
_HARDEST = 2.8
"""Hardest acceleration of an unknown target at 1 m/s, m/s^2; it grows with the fourth root of the speed, from 3 m/s^2
of who walks to 10 m/s^2 of who flies."""
_HARDER, _GROWS, _DIFFERENCES = 4.0, 1.5, 20
"""How many times as hard as its usual acceleration the hardest one is; how many times as large second differences over
twice the time are at least, so that they are no noise; and the fewest of these."""


def check_kind(name: str) -> None:
    """Checks the name of a kind.

    Raises:
        ValueError: there is none of this name.
    """
    if name not in KINDS:
        raise ValueError(f"bank: expected one of {', '.join(KINDS)} or a Bank, received {name!r}")


def check_speeds(recordings: Sequence[Recording], name: str) -> None:
    """Checks that targets may be of a stated kind.

    Raises:
        ValueError: one is far too fast for it.
    """
    most = _FASTER * KINDS[name].fastest
    for recording in recordings:
        if len(recording.time) >= _MANY and (speed := speed_across(recording)) > most:
            raise ValueError(
                f"bank: expected speeds of a {name}, below {most:g} m/s, received {speed:.3g} m/s as the median of "
                f"{recording.name}: say the unit of times or lengths (time_format, units), or another kind"
            )


def kind_of(recording: Recording) -> tuple[str, Kind]:
    """The kind that the file says; else ``UNKNOWN``, whose changes of velocity are bounded by its own speed alone."""
    word = _OTHER_WORDS.get(recording.source.word, recording.source.word)
    if word in KINDS:
        return word, KINDS[word]
    speed = speed_across(recording, 0.9)
    hardest = max(min(max(_HARDEST * speed**0.25, 3.0), 10.0), _HARDER * _acceleration(recording))
    return UNKNOWN, Kind(hardest, 2.0, max(_CHANGES * speed, _LEAST_CHANGE))


def _acceleration(recording: Recording) -> float:
    """The usual acceleration per axis, m/s^2, as far as noise does not hide it; 0 where it does.

    It is what second differences over twice the time have more than those over the time itself: white noise has the
    same in both.  So lengths in a unit that nobody has said, as pixels, have accelerations of their own.
    """
    there = np.isfinite(recording.position[:, :2]).all(1)
    time, position = recording.time[there], recording.position[there, :2]
    most, before = 0.0, (0.0, 0.0)
    while len(time) >= _DIFFERENCES + 2:
        seen = float(np.median(1 / np.linalg.norm(differences(time, 2), axis=1)))  # of 1 m/s^2
        size = spread(second_differences(time, position), 0.5)
        if size > _GROWS * before[0] > 0:
            most = max(most, math.sqrt((size**2 - before[0] ** 2) / (seen**2 - before[1] ** 2)))
        time, position, before = time[::2], position[::2], (size, seen)
    return most
