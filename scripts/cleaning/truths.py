"""True tracks: smoothed recorded flights, simulated ships and drones, and walked paths."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cleaning.simulated import MANNERS, OUTINGS, along_streets, animal, drone, resting, ship
from torchfra import readers
from torchfra.readers.columns import Array
from torchfra.readers.grid import hermite
from torchfra.readers.recording import Recording
from torchfra.readers.smoothing import smoothed

GROUPS = {
    "calibration": ("calibration",),
    "gliders": ("gliders",),
    "circling": ("tv_relay",),
    "others": ("surveillance", "military", "ambulances", "surveys", "featured", "onground", "noisy", "collections"),
}
"""Kinds of flights, and the folders of the sample package that hold them."""
KINDS = (*GROUPS, "ships", "drones", "ranges")
HARDER = ("late", "lasting", "heights", "animals", "slow", "rare", "bursts", "gaps")
"""Kinds whose errors are not white: ships with wrong time stamps and with time-correlated errors, drones with the
heights of a transponder; animals, with hours and hundreds of metres in place of seconds and metres; who walks, cycles,
drives, flies a drone or sails, with errors some of which are slow; those whose fixes are rare or come in bursts; and
the former with white errors and an hour without a fix now and then."""
MOVING = *MANNERS, "drone", "boat"
"""Those who are always on their way."""
SLOW = ((0.0, 0.0), *((seconds, size) for size in (0.5, 1.0) for seconds in (10.0, 20.0, 40.0)))
"""Correlation times of slow errors, s, and their standard deviations in units of the white noise beside them."""
PER_FILE, FIXES = 3, 4000
"""Most flights of one file, and fixes of each that are looked at."""
JERK, OWN = (0.3, 0.003), 5.0
"""Density of the jerk that a smooth flight has, across the ground and in height, m^2/s^5, and its own noise, m."""
STRIDE, WAVERING = 1.0, 0.02
"""Density of the jerk of a walked path, m^2/s^5, and its own noise, m."""
SLOWEST = 3.0
"""Speed below which nothing flies, m/s."""
FASTEST = 1.8
"""Share of a piece's median speed above which it was not flown, but recorded late."""
SHORTEST, LONGEST = 60, 6000
"""Fixes of the shortest track, and seconds of the longest truth."""
SCALE, PACE = 0.02, 0.125
"""Noise and outliers of a path that was walked, and its periods, as shares of those of the others."""
HERD, HOURS = 100 / 3, 1440.0
"""Factors on noise and periods of animals: 15 m become 500 m, and 5 s become 2 h."""
RARE = 360.0
"""Factor on periods of those who rest between their ways: 5 s are 30 min."""
BURST, OFTEN, PAUSE = 3, 4.0, 3600.0
"""Fixes of a burst, the factor on the periods between them, and seconds from one burst to the next."""
PIECE, PIECES, SELDOM = 40, 5, 3.0
"""Fixes between two gaps, the number of such pieces, and the factor on periods: 5 s are 15 s."""
PACES = 0.0, 0.2, 0.8
"""Shares of its mean speed at which a target goes elsewhere in a gap."""


@dataclass(frozen=True, eq=False)
class Truth:
    """A true track."""

    kind: str
    name: str
    dt: float
    """Seconds from one position to the next."""
    position: Array
    """``(k, d)`` m."""
    moved: float = 0.0
    """By how much the recorded positions were moved to make them smooth, RMS per axis of the ground, m."""
    scale: float = 1.0
    """Factor on noise and outliers."""
    pace: float = 1.0
    """Factor on periods."""
    word: str = "target"
    """The kind of target in the file."""
    late: float = 0.0
    """Standard deviation of one time stamp in five, s; the others have a tenth of it."""
    lasting: float = 0.0
    """Correlation time of the errors, s."""
    size: float = 1.0
    """Standard deviation of the correlated errors, in units of the noise of the case."""
    white: float = 0.1
    """Standard deviation of the white noise beside them, in units of the noise of the case."""
    coarse: float = 0.0
    """Resolution of the heights, m, of which one in ten is missing."""
    in_a_row: int = 0
    """Fixes from one pause to the next; 0 where there are no pauses."""

    @property
    def plain(self) -> bool:
        """Whether its errors are white noise alone."""
        return not (self.late or self.lasting or self.coarse)

    def window(self, period: float, steps: int) -> NDArray[np.intp] | None:
        """Which positions are fixes: ``steps`` in the middle, one each period or between pauses; None if too few."""
        step = max(1, round(self.pace * period / self.dt))
        if self.in_a_row:
            begins = np.arange(0, len(self.position) - self.in_a_row * step, round(PAUSE / self.dt))
            every = (begins[:, None] + step * np.arange(self.in_a_row)).ravel()
        else:
            every = np.arange(0, len(self.position), step)
        first = max(0, (len(every) - steps) // 2)
        return every[first : first + steps] if len(every) >= SHORTEST else None


def truths(kinds: Sequence[str], most: int, folder: Path | None = None) -> list[Truth]:
    """At most so many of each kind.

    Raises:
        ValueError: an unknown kind.
    """
    known = (*KINDS, *HARDER)
    if unknown := set(kinds) - set(known):
        raise ValueError(f"kinds: expected some of {', '.join(known)}, received {', '.join(sorted(unknown))}")
    found: list[Truth] = []
    for kind in kinds:
        if kind in GROUPS:
            found += _flights(kind, most)
        elif kind == "slow":
            found += [truth for i in range(most) for truth in _slow(i)]
        elif kind == "gaps":
            found += [_with_gaps(who, i) for who in MOVING for i in range(most)]
        elif kind in ("rare", "bursts"):
            found += [_at_times(kind, who, i) for who in OUTINGS for i in range(most)]
        elif kind == "ranges":
            found += [] if folder is None else [_walked(place) for place in readers.range_folders(folder)][:most]
        else:
            found += [_simulated(kind, f"{kind}-{i}", np.random.default_rng(i)) for i in range(most)]
    return found


def _simulated(kind: str, name: str, rng: np.random.Generator) -> Truth:
    """A ship, a drone or an animal."""
    if kind == "animals":
        dt = HOURS / 4
        return Truth(kind, name, dt, animal(rng, 4 * LONGEST, dt), scale=HERD, pace=HOURS, word="animal")
    if kind in ("drones", "heights"):
        return Truth(kind, name, 1.0, drone(rng, LONGEST), coarse=25 * 0.3048 if kind == "heights" else 0.0)
    path = ship(rng, LONGEST)
    if kind == "late":  # as fast as a ferry, so that a second is many metres
        return Truth(kind, name, 1.0, 1.7 * path, word="ship", late=2.0)
    return Truth(kind, name, 1.0, path, lasting=20.0 if kind == "lasting" else 0.0)


def _slow(number: int) -> list[Truth]:
    """One target of each kind, with time-correlated errors of each of the times and sizes."""
    found = []
    for who in MOVING:
        path = _path_of(who, np.random.default_rng(number))
        for seconds, size in SLOW:
            kind = f"{seconds:g} s, {size:g}" if seconds else "white"
            found.append(Truth(kind, f"{who}-{number}", 1.0, path, lasting=seconds, size=size, white=1.0))
    return found


def _path_of(who: str, rng: np.random.Generator) -> Array:
    """Positions every second of one of those that are always on their way."""
    if who == "boat":
        return ship(rng, LONGEST)
    return drone(rng, LONGEST)[:, :2] if who == "drone" else along_streets(rng, LONGEST, MANNERS[who])


def _with_gaps(who: str, number: int) -> Truth:
    """A path in pieces of which only the first fixes are received; between two pieces it rests or goes elsewhere."""
    rng = np.random.default_rng(number)
    pieces = _path_of(who, rng)[:LONGEST].reshape(PIECES, -1, 2)
    length = pieces.shape[1]
    speed = np.linalg.norm(np.diff(pieces, axis=1), axis=2).mean()
    course = rng.uniform(-np.pi, np.pi, PIECES)
    way = speed * (PAUSE - length) * rng.choice(PACES, PIECES)
    moved = np.cumsum(way[:, None] * np.stack([np.cos(course), np.sin(course)], 1), 0)
    places = (pieces + moved[:, None]).reshape(-1, 2)
    times = (PAUSE * np.arange(PIECES)[:, None] + np.arange(length)).ravel()
    grid = np.arange(PIECES * PAUSE)
    path = np.stack([np.interp(grid, times, along) for along in places.T], 1)
    return Truth(f"gaps {who}", f"{who}-{number}", 1.0, path, pace=SELDOM, in_a_row=PIECE)


def _at_times(kind: str, who: str, number: int) -> Truth:
    """Somebody who rests between ways of minutes to hours, whose fixes are rare or come in bursts."""
    bursts, word = kind == "bursts", who if who in ("ship", "animal") else "target"
    pace, dt, seconds = (OFTEN, OFTEN, 200 * PAUSE) if bursts else (RARE, RARE / 4, RARE * LONGEST)
    path = resting(np.random.default_rng(number), round(seconds / dt), dt, OUTINGS[who])
    return Truth(f"{kind} {who}", f"{who}-{number}", dt, path, pace=pace, word=word, in_a_row=BURST * bursts)


def _flights(kind: str, most: int) -> list[Truth]:
    """Flights of this kind, spread evenly over its files."""
    files = [file for group in GROUPS[kind] for file in readers.samples(group)]
    found = []
    for index in np.linspace(0, len(files) - 1, min(most, len(files))).round().astype(int):
        file = files[index]
        try:
            recordings = readers.read(file)
        except ValueError:
            continue  # not every sample is a file of tracks
        longest = sorted(recordings, key=lambda recording: -len(recording.time))
        for number, recording in enumerate(longest[: 1 if most <= len(files) else PER_FILE]):
            name = f"{file.name.removesuffix('.json.gz')}-{number}"
            found += _flight(kind, name, recording)
    return found[:most]


def _flight(kind: str, name: str, recording: Recording) -> list[Truth]:
    """The longest stretch of a flight without a stop or a gap, time stamps mended; empty if it is short."""
    first = Recording(name, recording.time[:FIXES], recording.position[:FIXES], None, {})
    stretches = [stretch for piece in readers.flyable(first) for stretch in _moving(piece)]
    time, position = max(stretches, key=lambda stretch: np.ptp(stretch[0]), default=(np.zeros(1), np.zeros((1, 3))))
    if np.ptp(time) < SHORTEST:
        return []
    time = time - time[0] - int(max(0.0, np.ptp(time) - LONGEST) / 2)
    grid = np.arange(int(min(np.ptp(time), LONGEST)) + 1.0)
    rough = hermite(time, position, grid)
    near = np.unique(np.round(time).astype(int))  # grid points within half a second of a fix
    fixes = np.isin(np.arange(len(grid)), near)
    smooth = _smooth(grid, rough, fixes)
    moved = _rms(smooth[fixes, :2] - rough[fixes, :2])
    return [Truth(kind, name, 1.0, smooth, moved)]


def _moving(piece: Recording) -> Iterator[tuple[Array, Array]]:
    """Times and positions of each stretch in which it flies, no slower and no faster than it can."""
    speed = np.linalg.norm(np.diff(piece.position[:, :2], axis=0), axis=1) / np.diff(piece.time)
    flies = (speed >= SLOWEST) & (speed <= FASTEST * np.median(speed))
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flies.astype(int), [0]])))
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        yield piece.time[begin : end + 1], piece.position[begin : end + 1]


def _smooth(grid: Array, rough: Array, fixes: NDArray[np.bool_]) -> Array:
    """Positions ``(k, d)`` with steady accelerations, near those at the fixes and free between them."""
    weight = np.where(fixes, OWN**-2, 0.0)
    flat = smoothed(grid, rough[:, :2], weight, limit=np.inf, roughness=1 / JERK[0])
    if rough.shape[1] == 2:
        return flat
    around = np.lib.stride_tricks.sliding_window_view(np.pad(rough[:, 2], 30, mode="edge"), 61)
    spike = np.abs(rough[:, 2] - np.median(around, axis=1)) > 300.0  # an altitude of another aircraft, or none
    weight = np.where(spike, 0.0, weight)
    return np.column_stack([flat, smoothed(grid, rough[:, 2:], weight, limit=np.inf, roughness=1 / JERK[1])])


def _walked(place: Path) -> Truth:
    """The reference path of a recording of ranges, on a grid of an eighth of a second."""
    recording = readers.read_ranges(place)
    if recording.reference is None:
        raise ValueError(f"ranges: expected a reference path for each, received none for {place}")
    time, position = recording.reference.time, recording.reference.position[:, :2]
    grid = time[0] + 0.125 * np.arange(int(np.ptp(time) / 0.125) + 1)
    path = np.stack([np.interp(grid, time, axis) for axis in position.T], 1)
    weight = np.full(len(grid), WAVERING**-2)
    smooth = smoothed(grid - grid[0], path, weight, limit=np.inf, roughness=1 / STRIDE)
    return Truth("ranges", "-".join(place.parts[-3:]), 0.125, smooth, _rms(smooth - path), SCALE, PACE)


def _rms(moves: Array) -> float:
    return float(np.sqrt(np.square(moves).mean()))
