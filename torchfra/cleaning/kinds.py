"""What targets there are, and how hard they can manoeuvre."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchfra.motion.bank import aircraft, people, ships, vehicles
from torchfra.readers.recording import Recording


class Kind(NamedTuple):
    """A kind of targets."""

    acceleration: float
    """Of its hardest manoeuvres, m/s^2."""
    climb: float
    """The same in height, m/s^2."""
    fastest: float
    """Speed up to which a target may be of this kind, m/s."""


KINDS = {
    "person": Kind(3.0, 1.0, 6.0),
    "ship": Kind(0.5, 0.5, 30.0),
    "vehicle": Kind(6.0, 2.0, 60.0),
    "aircraft": Kind(10.0, 2.0, 1000.0),
}
"""By name, the slowest first."""
BANKS = {"person": people, "ship": ships, "vehicle": vehicles, "aircraft": aircraft}
"""The motions of each, for filters of several."""
_ACROSS = 30.0
"""Seconds over which speeds are taken, so that noise does not count."""


def check_kind(name: str) -> None:
    """Checks the name of a kind.

    Raises:
        ValueError: there is none of this name.
    """
    if name not in KINDS:
        raise ValueError(f"bank: expected one of {', '.join(KINDS)} or a Bank, received {name!r}")


def kind_of(recording: Recording) -> tuple[str, str]:
    """The name of the kind of a target, and why: as the file says, or by its speed."""
    if recording.source.word in KINDS:
        return recording.source.word, "as the file says"
    speed = _usual_speed(recording)
    name = next(
        name for name, kind in KINDS.items() if name != "ship" and (speed <= kind.fastest or name == "aircraft")
    )
    return name, f"at {speed:.3g} m/s"


def _usual_speed(recording: Recording) -> float:
    """Speed across the ground that nine in ten do not exceed, m/s; 0 of a single fix."""
    time, position = recording.time, recording.position[:, :2]
    later = np.searchsorted(time, time + _ACROSS).clip(max=len(time) - 1)
    passed = time[later] - time
    there = passed > 0
    if not there.any():
        return 0.0
    speed = np.linalg.norm(position[later] - position, axis=1)[there] / passed[there]
    return float(np.nanquantile(speed, 0.9))
