"""Manoeuvres of a track: their begin, end, kind and rate."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchfra.cleaning.cleaned import Segment
from torchfra.readers.columns import Array

_SURE = 3.0
"""Least change over a segment, in its standard deviations."""


class _Rule(NamedTuple):
    """Bounds on the changes of a quantity that are manoeuvres."""

    kinds: tuple[str, str]
    """Names of a rise and of a fall."""
    noise: float
    """Largest standard deviation of its rate, which determines the seconds over which the rate is taken."""
    low: float
    high: float
    """Bounds on the rate at which a segment begins and ends; in between it is half of the segment's own rate."""
    rate: float
    """Least mean rate."""
    lasting: float
    """Least duration, s."""
    change: float
    """Least change."""
    unsure: float = math.inf
    """Median standard deviation in a segment from which on the quantity is unknown."""
    longest: float = 10.0
    """Seconds over which the rate is taken at most."""


_TURN = _Rule(
    ("left turn", "right turn"), noise=0.5, low=0.5, high=1.5, rate=1.0, lasting=2.0, change=15.0, unsure=30.0
)
"""Changes of the course, degrees."""
_SLOW_TURN = _TURN._replace(noise=0.05, low=0.1, rate=0.15, lasting=20.0, change=30.0, longest=60.0)
"""Slow but large turns, of ships and airliners, degrees."""
_SPEED = _Rule(("speeding up", "slowing down"), noise=0.1, low=0.2, high=0.5, rate=0.5, lasting=4.0, change=4.0)
"""Changes of the speed, m/s."""
CLIMBS = ("climbing", "descending")
_CLIMB = _Rule(CLIMBS, noise=0.5, low=1.0, high=2.0, rate=2.5, lasting=10.0, change=30.0)
"""Changes of the height, m."""


def segments(time: Array, mean: Array, covariance: Array, height: Array | None = None) -> tuple[Segment, ...]:
    """The manoeuvres of a track, by the time at which they begin.

    Manoeuvres are turns of 15 degrees or more at 1 deg/s or more, or of 30 degrees at 0.15 deg/s, changes of speed of
    4 m/s or more at 0.5 m/s^2 or more, and climbs of 30 m or more at 2.5 m/s or more, each significant.  A segment
    begins and ends where the rate of that change passes half of what it is in the segment, or 1.5 deg/s, 0.5 m/s^2 and
    2 m/s if that is less.

    Args:
        time: ``(T,)`` seconds.
        mean: ``(T, 2 d)`` position and velocity, m and m/s; best if smoothed.
        covariance: ``(T, 2 d, 2 d)`` of these.
        height: ``(T,)`` m above the ground, which curves; None for the third axis.
    """
    finite = np.isfinite(mean).all(1) & np.isfinite(covariance).all((1, 2))
    time, mean, covariance = time[finite], mean[finite], covariance[finite]
    if len(time) < 3:
        return ()
    d = mean.shape[1] // 2
    velocity, spread = mean[:, d : d + 2], covariance[:, d : d + 2, d : d + 2]
    speed = np.linalg.norm(velocity, axis=1).clip(1e-6)
    ahead = velocity / speed[:, None]
    aside = np.stack([-ahead[:, 1], ahead[:, 0]], 1)
    along, across = (np.sqrt(np.einsum("ti,tij,tj->t", u, spread, u)) for u in (ahead, aside))
    heading = np.degrees(np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0])))
    unsure = np.degrees(across / speed).clip(max=180.0)
    found = [*_changes(time, heading, unsure, _TURN)]
    slow = [one for one in _changes(time, heading, unsure, _SLOW_TURN) if abs(one.rate) < _TURN.rate]
    found += [one for one in slow if not any(one.begin < turn.end and turn.begin < one.end for turn in found)]
    found += _changes(time, speed, along, _SPEED)
    if d == 3:
        above = mean[:, 2] if height is None else height[finite]
        found += _changes(time, above, np.sqrt(covariance[:, 2, 2]), _CLIMB)
    return tuple(sorted(found))


def inside(time: Array, listed: Iterable[Segment]) -> NDArray[np.bool_]:
    """Which times ``(T,)`` are in any of the segments."""
    within = np.zeros(len(time), bool)
    for segment in listed:
        within |= (time >= segment.begin) & (time <= segment.end)
    return within


def spans(listed: Iterable[tuple[Any, ...]]) -> list[tuple[float, float]]:
    """Begin and end of the union of segments, each of which begins with these."""
    found: list[tuple[float, float]] = []
    for begin, end, *_ in sorted(listed):
        if found and begin <= found[-1][1]:
            found[-1] = found[-1][0], max(end, found[-1][1])
        else:
            found.append((begin, end))
    return found


def _changes(time: Array, value: Array, std: Array, rule: _Rule) -> Iterator[Segment]:
    """Segments in which a value ``(T,)`` with standard deviations ``std (T,)`` rises or falls."""
    at = np.sort(np.concatenate([time, (time[1:] + time[:-1]) / 2]))
    level, unsure = np.interp(at, time, value), np.interp(at, time, std)
    half = (math.sqrt(2) * unsure / rule.noise).clip(np.median(np.diff(time)), rule.longest) / 2
    before, after = (at - half).clip(time[0]), (at + half).clip(max=time[-1])
    rate = (np.interp(after, time, value) - np.interp(before, time, value)) / (after - before)
    rate[unsure > 2 * rule.unsure] = 0.0
    for side, kind in zip((1, -1), rule.kinds, strict=True):
        for part in _above(side * rate, rule.low):
            there, fast, rise, std_there = at[part], side * rate[part], side * level[part], unsure[part]
            if there[-1] - there[0] < rule.lasting or rise[-1] - rise[0] < rule.change:
                continue
            edge = min(max(float(np.quantile(fast, 0.75)) / 2, rule.low), rule.high)
            for piece in _above(fast, edge):
                ends = _crossings(there[piece], fast[piece], edge)
                lasting, change = np.diff(ends)[0], np.diff(np.interp(ends, there, rise))[0]
                sure = _SURE * math.hypot(*np.interp(ends, there, std_there))
                known = np.median(std_there[piece]) < rule.unsure
                if known and lasting >= rule.lasting and change >= max(rule.change, sure, rule.rate * lasting):
                    yield Segment(*ends, kind, float(side * change / lasting))


def _above(rate: Array, edge: float) -> Iterator[slice]:
    """Each stretch in which a rate ``(T,)`` is above the edge, with the neighbours that are not."""
    turns = np.flatnonzero(np.diff(np.concatenate([[False], rate > edge, [False]])))
    for first, last in zip(turns[::2], turns[1::2], strict=True):
        yield slice(max(first - 1, 0), last + 1)


def _crossings(at: Array, rate: Array, edge: float) -> tuple[float, float]:
    """Times at which a rate ``(k,)`` first and last crosses the edge, by linear interpolation."""
    begin = at[0] if rate[0] > edge else np.interp(edge, rate[:2], at[:2])
    end = at[-1] if rate[-1] > edge else np.interp(edge, rate[:-3:-1], at[:-3:-1])
    return float(begin), float(end)
