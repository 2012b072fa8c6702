"""Boats in a harbour, seen by a radar and a lidar on a ferry, among land, buoys, wakes and false measurements."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchfra.hyper import one_of
from torchfra.numbers import fraction, is_integer, positive

KINDS = "beside", "turning", "crossing", "overtaking", "ship"
"""How boats move: see ``harbour``."""
SECONDS, GRID = 100.0, 0.1
"""Length of a recording and of a step of paths, s."""
RADAR, LIDAR = 1.68, 0.504
"""Seconds between the scans of each sensor."""
REACH = 70.0
"""How far the lidar sees, m."""
STD = {False: 1.0, True: 0.3}
"""Standard deviation of a detection from scan to scan, m: of the radar and, True, of the lidar."""
_LENGTHS = 4.0, 40.0
"""Shortest and longest boats, m; a ship has 20 m or more."""
_SPEEDS = 1.5, 4.0
"""Least and largest speeds, m/s."""
_RESOLUTION = 5.0
"""Metres up to which the radar has one detection of two."""
_JUMP, _BOTH = 0.05, 0.03
"""Probabilities that the radar goes over to the other end of a hull of 20 m or more, and that it shows both."""
_WAKE = 0.04
"""Probability of a detection of a wake in a scan of the radar, for each boat."""
_RATES = {False: 0.7, True: 0.1}
"""False measurements of a scan, in a square of 400 m."""
Array = NDArray[np.floating[Any]]


class Harbour(NamedTuple):
    """A simulated recording: T scans of B boats."""

    time: Tensor
    """``(T,)`` of each scan, s."""
    lidar: Tensor
    """``(T,)`` bool: the lidar's scans; the others are the radar's."""
    ferry: Tensor
    """``(T, 2)`` position of both sensors, m."""
    z: Tensor
    """``(T, J, 2)`` measured positions, m, in no order; NaN is none."""
    truth: Tensor
    """``(B, T, 4)`` positions, m, of the middle of each boat, and velocities, m/s."""
    length: Tensor
    """``(B,)`` lengths of the boats, m."""


def harbour(kind: str, *, seed: int, apart: float = 15.0, detection: float = 0.85) -> Harbour:
    """One recording of 100 s: a radar's scan each 1.68 s, a lidar's each 0.504 s.

    - ``"beside"``: two boats side by side, that part in the last quarter;
    - ``"turning"``: two boats side by side, that turn together;
    - ``"crossing"``: one boat passes ahead of the other, across its path;
    - ``"overtaking"``: one boat passes the other on its side;
    - ``"ship"``: one ship of 20 to 40 m, that turns.

    The radar has one detection of a boat, somewhere on its hull where it stays for long; a hull of 20 m and more shows
    the other end now and then, rarely both ends.  The lidar has several detections of a hull within 70 m.  Land and
    buoys are measured again and again where they are, wakes behind boats.

    Args:
        kind: one of those.
        seed: of the random numbers.
        apart: metres between two boats where they are nearest, or side by side.
        detection: probability that the radar detects a boat in a scan; of the lidar it is two thirds of that.

    Raises:
        ValueError: another kind, a seed that is no whole number from 0 on, a distance that is not above 0, or a
            probability that is not in (0, 1).
    """
    one_of(kind=(kind, KINDS))
    if not is_integer(seed, 0):
        raise ValueError(f"seed: expected a whole number from 0 on, received {seed!r}")
    apart, detection = positive("apart", apart, "finite metres"), fraction("detection", detection)
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    paths = _paths(rng, kind, apart)
    low, high = (20.0, _LENGTHS[1]) if kind == "ship" else (_LENGTHS[0], min(_LENGTHS[1], max(5.0, 2 * apart)))
    length = np.exp(rng.uniform(math.log(low), math.log(high), len(paths)))
    still = _still(rng)
    looks = sorted(
        [(t, False) for t in np.arange(1.0, SECONDS, RADAR)] + [(t, True) for t in np.arange(1.2, SECONDS, LIDAR)]
    )
    spots: Array = rng.uniform(-0.25, 0.25, len(paths))
    scans = []
    time, lidar = (np.array(x) for x in zip(*looks, strict=True))
    ferry = np.stack([0.3 * time, np.zeros_like(time)], -1)
    truth = np.stack([np.stack([np.interp(time, np.arange(len(p)) * GRID, x) for x in p.T], -1) for p in paths])
    for k in range(len(time)):
        boats = truth[:, k]
        if not lidar[k]:
            spots = _moved(rng, spots, length)
        found = [*_boats(rng, boats, length, spots, lidar[k], detection, ferry[k])]
        found += [x for x, often in still if rng.random() < often and _visible(x, lidar[k], ferry[k])]
        found = [x + STD[bool(lidar[k])] * rng.standard_normal(2) for x in found]
        found = found if lidar[k] else _resolved(found)
        found += [x for x in ferry[k] + rng.uniform(-200, 200, (rng.poisson(_RATES[bool(lidar[k])]), 2))
                  if _visible(x, lidar[k], ferry[k])]  # fmt: skip
        scans.append(rng.permutation(np.array(found).reshape(-1, 2)))
    z = np.full((len(scans), max(1, *map(len, scans)), 2), np.nan)
    for k, scan in enumerate(scans):
        z[k, : len(scan)] = scan
    return Harbour(*(torch.from_numpy(x) for x in (time, lidar, ferry, z, truth, length)))


def _paths(rng: np.random.Generator, kind: str, apart: float) -> list[Array]:
    """States ``(S, 4)`` of each boat on a fine grid of time."""
    time = np.arange(0, SECONDS + GRID, GRID)
    middle = time - SECONDS / 2
    course = rng.uniform(0, 2 * math.pi) + rng.normal(0, 0.002) * middle
    if kind in ("turning", "ship"):
        course = course + rng.choice([-1, 1]) * rng.uniform(1.0, 2.0) / (1 + np.exp(-middle / 4))
    heading = np.stack([np.cos(course), np.sin(course)], -1)
    left = np.stack([-heading[:, 1], heading[:, 0]], -1)
    velocity = rng.uniform(*_SPEEDS) * heading
    first = np.cumsum(velocity, 0) * GRID
    near = rng.uniform(40.0, 90.0) * heading[len(time) // 2] @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    first = first - first[len(time) // 2] + near  # passes the ferry at that distance
    positions = [first]
    if kind != "ship":
        along, across = _wander(rng, time), apart + _wander(rng, time)
        if kind == "beside":
            across = across + 1.0 * np.maximum(0.0, time - 0.75 * SECONDS)
        if kind == "crossing":
            along, across = apart + along, across - apart + rng.uniform(1.0, 2.0) * middle
        if kind == "overtaking":
            along = along + rng.uniform(1.0, 2.0) * middle
        positions.append(first + along[:, None] * heading + across[:, None] * left)
    return [np.concatenate([x, np.gradient(x, GRID, axis=0)], -1) for x in positions]


def _wander(rng: np.random.Generator, time: Array) -> Array:
    """Metres by which a helmsman is off, slowly."""
    phase, period = rng.uniform(0, 2 * math.pi, (2, 1)), rng.uniform(30.0, 80.0, (2, 1))
    found: Array = 0.5 * np.sin(phase + 2 * math.pi * time / period).sum(0)
    return found


def _still(rng: np.random.Generator) -> list[tuple[Array, float]]:
    """What stays where it is, with the probability that a scan has it: two shores and buoys."""
    far, slope = rng.uniform(100.0, 150.0, 2) * [1, -1], rng.normal(0, 0.1, 2)
    side = rng.integers(0, 2, 14)
    x = rng.uniform(-200.0, 200.0, 14)
    land = np.stack([x, far[side] + slope[side] * x], -1)
    buoys = rng.uniform(-100.0, 100.0, (3, 2))
    return [*zip(land, rng.uniform(0.02, 0.4, 14), strict=True), *zip(buoys, rng.uniform(0.3, 0.8, 3), strict=True)]


def _moved(rng: np.random.Generator, spots: Array, length: Array) -> Array:
    """Where on its hull the radar detects each boat, in lengths from the middle, a scan later."""
    spots = np.clip(0.95 * spots + 0.03 * rng.standard_normal(len(spots)), -0.45, 0.45)
    over = (rng.random(len(spots)) < _JUMP) & (length >= 20.0)
    return np.where(over, -np.sign(spots) * rng.uniform(0.2, 0.45, len(spots)), spots)


def _boats(
    rng: np.random.Generator, boats: Array, length: Array, spots: Array, lidar: bool, detection: float, ferry: Array
) -> Iterator[Array]:
    """Places of the detections of boats ``(B, 4)`` and of their wakes."""
    for boat, long, spot in zip(boats, length, spots, strict=True):
        ahead = boat[2:] / np.hypot(*boat[2:])
        if lidar:
            if rng.random() < 2 / 3 * detection and _visible(boat[:2], lidar, ferry):
                for s in rng.uniform(-0.5, 0.5, 1 + rng.poisson(long / 15.0)):
                    yield boat[:2] + s * long * ahead
            continue
        if rng.random() < detection:
            yield boat[:2] + spot * long * ahead
            if long >= 20.0 and rng.random() < _BOTH:
                yield boat[:2] - math.copysign(0.4, spot) * long * ahead
        if rng.random() < _WAKE:
            yield boat[:2] - (long / 2 + rng.uniform(5.0, 20.0)) * ahead + 2.0 * rng.standard_normal(2)


def _visible(x: Array, lidar: bool, ferry: Array) -> bool:
    """Whether a sensor sees a place."""
    return not lidar or float(np.hypot(*(x - ferry))) < REACH


def _resolved(found: list[Array]) -> list[Array]:
    """Detections ``(2,)``, of which two that are near each other are one in the middle."""
    left: list[Array] = []
    for x in found:
        near = [i for i, other in enumerate(left) if np.hypot(*(x - other)) < _RESOLUTION]
        if near:
            left[near[0]] = (left[near[0]] + x) / 2
        else:
            left.append(x)
    return left
