"""Correction of time stamps that are off, so that the speeds of a recorded track are possible."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from torchfra.readers.columns import Array
from torchfra.readers.grid import hermite
from torchfra.readers.recording import Recording
from torchfra.readers.smoothing import differences, smoothed

_JERK = 0.03
"""Spectral density of the jerk along the track, m^2/s^5: accelerations of half a m/s^2 that last ten seconds."""
_USUAL = 1.0
"""Acceleration along the track that nine in ten fixes may show before their time stamps are doubted, m/s^2."""
_HARDEST = 15.0
"""Turning acceleration of a path by more than a right angle at one fix: beyond it fixes are out of order, m/s^2."""
_KNOT = 5.0
"""Longest distance between the times of a result, s."""
_SLOWEST, _FASTEST = 10.0, 1000.0
"""Bounds on what is taken for the usual speed, m/s."""
_EXACT = 0.01
"""Standard deviation of positions along the track where time stamps are right, m."""


def flyable(
    recording: Recording, *, max_gap: float = 30.0, seconds: float = 5.0, along: float = 3.0, limit: float = 9.0
) -> list[Recording]:
    """Mends a recording of an aircraft whose time stamps are off by seconds, so that it can have been flown.

    Such recordings jump along the track while the path itself, with its turns, is right: positions arrive late, are
    held, or are interpolated between others.  So positions move along the path:

    1. A fix that turns the path back on itself faster than any aircraft turns is out of order and dropped.  The
       recording is split at gaps, and where the next fix is farther than the aircraft flies at its usual speed with
       both stamps off by ``seconds``.
    2. The distance flown along the path is smoothed over time: the more, the rougher it is, by no more than the path
       covers in ``seconds``, and with at most ``along`` of acceleration.  Where nine in ten fixes show no more than
       1 m/s^2 of it, distances stay as they are.
    3. Positions are taken from the path at these distances.  What then still has more than ``limit`` of acceleration,
       such as the corners of a path that was recorded as a polygon, is rounded by moving positions as little as
       possible.

    Heights follow the path.  Where fixes are more than 5 s apart, positions are added between them.

    Args:
        recording: of one aircraft, in metres.
        max_gap: seconds without a fix that split the recording.
        seconds: by how much a time stamp may be off.
        along: limit of the acceleration along the track, m/s^2.
        limit: of the whole horizontal acceleration, m/s^2; 9 is that of a turn with 43 degrees of bank.

    Returns:
        The pieces in order of time, each with the repairs of the whole recording; none where there are only single
        fixes.

    Raises:
        ValueError: an argument that is not above 0.
    """
    for name, value in (("max_gap", max_gap), ("seconds", seconds), ("along", along), ("limit", limit)):
        if not value > 0:
            raise ValueError(f"{name}: expected a value above 0, received {value}")
    kept = _in_order(recording.time, recording.position[:, :2])
    dropped = {"fixes out of order dropped": len(recording.time) - len(kept)}
    repairs = recording.repairs | {what: count for what, count in dropped.items() if count}
    time, position = recording.time[kept], recording.position[kept]
    breaks, pieces = _breaks(time, position, max_gap, seconds), []
    for part in zip(np.split(time, breaks), np.split(position, breaks), strict=True):
        mended = _mended(*part, seconds, along, limit) if len(part[0]) >= 2 else part
        if len(mended[0]) >= 2:
            pieces.append(Recording(recording.name, *mended, recording.origin, repairs))
    return pieces


def _breaks(time: Array, position: Array, max_gap: float, seconds: float) -> NDArray[np.intp]:
    """Indices of the fixes that start a piece."""
    step, leg = np.diff(time), _legs(position)
    usual = running_median(leg / step, 15).clip(_SLOWEST, _FASTEST)
    return np.flatnonzero((step > max_gap) | (leg > usual * (step + 2 * seconds))) + 1


def _in_order(time: Array, position: Array) -> NDArray[np.intp]:
    """Indices of the fixes that are left when those that turn the path back on itself are dropped, the worst first."""
    kept = np.arange(len(time))
    while len(kept) >= 4:
        t, p = time[kept], position[kept]
        step, leg, move = np.diff(t), _legs(p), np.diff(p, axis=0)
        speed = running_median(leg / step, 7)
        cross = move[:-1, 0] * move[1:, 1] - move[:-1, 1] * move[1:, 0]
        turn = np.abs(np.arctan2(cross, (move[:-1] * move[1:]).sum(1)))
        back = (turn > math.pi / 2) & (np.minimum(speed[1:], speed[:-1]) * turn > _HARDEST * (t[2:] - t[:-2]) / 2)
        detour = np.where(back, leg[1:] + leg[:-1] - np.linalg.norm(p[2:] - p[:-2], axis=1), 0.0)
        before, after = np.pad(detour, (1, 0))[:-1], np.pad(detour, (0, 1))[1:]
        worst = (detour > 0) & (detour >= before) & (detour > after)
        if not worst.any():
            break
        kept = np.delete(kept, np.flatnonzero(worst) + 1)
    return kept


def _mended(time: Array, position: Array, seconds: float, along: float, limit: float) -> tuple[Array, Array]:
    """Times and positions of a piece without breaks, at the fixes and between them."""
    path = position[:, :2]
    arc = _arc_length(path)
    knots = _knots(time)
    flown = _flown(time - time[0], arc, knots - time[0], seconds, along)
    # The aircraft may enter the path later than the first stamp says and leave it earlier than the last.
    inside = (flown > -1.0) & (flown < arc[-1] + 1.0)
    knots, flown = knots[inside], flown[inside].clip(0.0, arc[-1])
    flat = smoothed(knots - time[0], hermite(arc, path, flown), np.ones(len(knots)), limit=limit)
    heights = [np.interp(flown, arc, height) for height in position[:, 2:].T]
    return knots, np.column_stack([flat, *heights])


def _flown(time: Array, arc: Array, knots: Array, seconds: float, along: float) -> Array:
    """Metres along the path at the knots, increasing; below 0 or above ``arc[-1]`` where it is not on the path yet."""
    mean = (arc[-1] - arc[0]) / (time[-1] - time[0])
    ends = np.array([-seconds, time[-1] + seconds]), np.array([-mean * seconds, arc[-1] + mean * seconds])
    longer = np.hstack([ends[0][:1], time, ends[0][1:]]), np.hstack([ends[1][:1], arc, ends[1][1:]])
    bounds = np.interp(knots - seconds, *longer), np.interp(knots + seconds, *longer)
    recorded, fixes = np.interp(knots, time, arc), np.isin(knots, time)
    speed = np.full(len(knots), mean)
    for last in (False, False, True):  # the first rounds are for the speed
        doubt = min(_stamp_error(time, arc, np.interp(time, knots, speed)), seconds)
        weight = np.where(fixes, 1 / ((doubt * speed.clip(_SLOWEST, _FASTEST)) ** 2 + _EXACT**2), 0.0)
        limits = {"limit": along, "bounds": bounds} if last else {"limit": math.inf}
        flown = smoothed(knots, recorded[:, None], weight, roughness=1 / _JERK, **limits)[:, 0]
        speed = np.gradient(flown, knots).clip(0.0)
    return np.asarray(np.maximum.accumulate(flown.clip(*bounds)))


def _stamp_error(time: Array, arc: Array, speed: Array) -> float:
    """Standard deviation of the time stamps in seconds, from the accelerations along the track ``(k - 2,)``."""
    if len(time) < 3:
        return 0.0
    rows = differences(time, 2)
    acceleration = np.abs(rows[:, 0] * arc[:-2] + rows[:, 1] * arc[1:-1] + rows[:, 2] * arc[2:])
    step = (time[2:] - time[:-2]) / 2
    error = (acceleration - _USUAL).clip(0.0) * step**2 / speed[1:-1].clip(_SLOWEST)
    # The second difference of three independent errors has sqrt(6) times their standard deviation.  Where some fixes
    # are right (or interpolated) and others late, it is the larger differences that tell how late.
    return float(np.quantile(error, 0.9)) / math.sqrt(6)


def _arc_length(path: Array) -> Array:
    """Metres along the smooth curve through the fixes ``(k, 2)``, increasing strictly."""
    chord = np.append(0.0, np.cumsum(_legs(path).clip(1e-3)))
    parts = 8
    fine = np.interp(np.arange(parts * (len(path) - 1) + 1) / parts, np.arange(len(path)), chord)
    legs = _legs(hermite(chord, path, fine)).reshape(-1, parts).sum(1)
    return np.append(0.0, np.cumsum(legs.clip(1e-3)))


def _knots(time: Array) -> Array:
    """The times, with further ones wherever two are more than ``_KNOT`` apart."""
    parts = np.ceil(np.diff(time) / _KNOT - 1e-6).astype(int).clip(1)
    place = np.arange(parts.sum()) - np.repeat(parts.cumsum() - parts, parts)
    return np.append(np.repeat(time[:-1], parts) + place * np.repeat(np.diff(time) / parts, parts), time[-1])


def _legs(position: Array) -> Array:
    """Horizontal distances ``(k - 1,)`` between fixes."""
    return np.asarray(np.linalg.norm(np.diff(position[:, :2], axis=0), axis=1))


def running_median(values: Array, width: int) -> Array:
    """``(k,)`` the median of the ``width`` values around each value."""
    if not len(values):
        return values
    around = np.pad(values, width // 2, mode="edge")
    return np.asarray(np.median(np.lib.stride_tricks.sliding_window_view(around, width), axis=1))
