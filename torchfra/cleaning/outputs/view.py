"""The numbers in a picture of a cleaned track, for matplotlib and for pages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchfra.cleaning import Cleaned, Segment
from torchfra.cleaning.flags import MATTERS
from torchfra.cleaning.outputs.course import course
from torchfra.cleaning.outputs.times import dates
from torchfra.cleaning.segments import CLIMBS
from torchfra.geodesy import to_geodetic
from torchfra.pictures import corners
from torchfra.readers.columns import Array
from torchfra.tables import duration, metres, printable

SURE = 2.0
"""Standard deviations to each side that a band is wide."""
_ROOM = 0.5
"""Share of the path's size by which kept fixes may widen the map."""
_MEDIAN, _SPIKE = 5, 3.0
"""Steps of running medians; and how many times as wide as these values may spread before their spikes do not count."""
_MOST_OFF = 4.5
"""Times the median distance of what is recorded from an estimate for which an axis has room: three standard deviations
of a Gaussian."""
_NAME = 40
"""Characters of a target's name in a title."""
_UNITS = {"turn": "deg/s", "climb": "m/s", "descend": "m/s"}
"""Units of a manoeuvre's rate, by a word of its kind; the unit of all others is m/s^2."""


class Band(NamedTuple):
    """A quantity over time, each ``(T,)``."""

    mean: Array
    std: Array
    recorded: Array | None = None
    """NaN between fixes; None where it is not recorded."""
    rejected: NDArray[np.bool_] | None = None
    """Where what is recorded is off."""
    manoeuvres: Sequence[tuple[float, float, str]] = ()
    """Begin and end in units of ``View.time``, and a description."""

    def limits(self) -> tuple[float, float]:
        """Of an axis: the quantity without spikes, its band where that is as wide as usual, and most fixes."""
        mean, std = self.mean[np.isfinite(self.mean)], self.std[np.isfinite(self.std)]
        if not len(mean):
            return 0.0, 1.0
        (low,), (high,) = without_spikes(mean[:, None])
        margin = max(0.08 * (high - low), 1.5 * SURE * float(np.median(std)) if len(std) else 0.0, 1e-3)
        off = np.abs((self.mean if self.recorded is None else self.recorded) - self.mean)
        if (seen := np.isfinite(off)).any():
            margin = max(margin, _MOST_OFF * float(np.median(off[seen])))
        return float(low - margin), float(high + margin)


class View(NamedTuple):
    """The numbers in a picture; ``T`` steps."""

    title: str
    unit: str
    """The unit of the map, of ``metres`` m."""
    metres: float
    path: Array
    """``(T, 2)`` east and north, in ``unit``."""
    sides: Array
    """``(T, 2, 2)`` the edges of the band around it, left and right."""
    recorded: Array
    """``(T, 2)``; NaN between fixes."""
    rejected: NDArray[np.bool_]
    """``(T,)`` whether a fix is an outlier across the ground."""
    window: tuple[Array, Array]
    """Lower left and upper right of the map."""
    time: Array
    """``(T,)`` in the unit that ``clock`` names."""
    clock: str
    speed: Band
    altitude: Band | None
    manoeuvre: Array
    """``(T,)`` probability of one across the ground; NaN where unknown."""


def view(cleaned: Cleaned) -> View:
    """The numbers in a picture of a track."""
    moved = course(cleaned)
    outlier = cleaned.flag == "outlier"
    aside, above = _off(cleaned)
    rejected = outlier & (aside | ~above)
    low, high = _corners(cleaned, rejected)
    unit, size = ("km", 1000.0) if (high - low).max() >= 2000 else ("m", 1.0)
    clock, seconds = _clock(cleaned)
    level, climbs = (
        [(of.begin / seconds, of.end / seconds, named(of)) for of in cleaned.segments if (of.kind in CLIMBS) == climb]
        for climb in (False, True)
    )
    path = cleaned.position[:, :2]
    return View(
        title=_title(cleaned, outlier),
        unit=unit,
        metres=size,
        path=path / size,
        sides=_sides(cleaned, moved.across) / size,
        recorded=cleaned.raw[:, :2] / size,
        rejected=rejected,
        window=(low / size, high / size),
        time=cleaned.time / seconds,
        clock=clock,
        speed=Band(moved.speed, moved.speed_std, manoeuvres=level),
        altitude=_altitude(cleaned, moved.up, outlier & (above | ~aside), climbs),
        manoeuvre=cleaned.manoeuvre,
    )


def named(segment: Segment) -> str:
    """The kind of a manoeuvre and its rate."""
    unit = next((unit for word, unit in _UNITS.items() if word in segment.kind), "m/s²")
    return f"{segment.kind}, {abs(segment.rate):.2g} {unit}"


def beyond(of: View, low: Array, high: Array) -> tuple[Array, Array, str]:
    """Rejected fixes outside a map from ``low`` to ``high``, and a sentence on all fixes outside.

    Returns:
        Points ``(k, 2)`` on its edge, directions ``(k, 2)`` of length 1, and the sentence; "" if there are none.
    """
    outside = ((of.recorded < low) | (of.recorded > high)).any(1) & np.isfinite(of.path).all(1)
    fixes = of.recorded[outside & of.rejected]
    centre, half = (low + high) / 2, (high - low) / 2
    way = fixes - centre
    edge = centre + way / np.maximum(np.abs(way) / half, 1e-12).max(1, keepdims=True)
    said = []
    if len(fixes):
        most = of.metres * np.linalg.norm(fixes - of.path[outside & of.rejected], axis=1).max()
        said.append(f"{len(fixes):,} rejected, up to {metres(float(most))} off")
    if kept := int((outside & ~of.rejected).sum()):
        said.append(f"{kept:,} kept")
    return edge, way / np.linalg.norm(way, axis=1, keepdims=True), "; ".join(said) and f"outside: {'; '.join(said)}"


def placed(of: View, band: Band, letters: int) -> list[tuple[float, int, str]]:
    """Places for names of manoeuvres above a panel ``letters`` wide: in two rows, without overlap.

    Returns:
        The middle as a share of the width, the row, and the name.
    """
    end, taken, found = float(of.time[-1]) or 1.0, [0.0, 0.0], []
    for begin, last, kind in band.manoeuvres:
        half, middle = 0.5 * len(kind) / letters, 0.5 * (begin + last) / end
        middle = min(max(middle, half), 1 - half)
        row = 0 if middle - half >= taken[0] else 1
        if middle - half >= taken[row]:
            found.append((middle, row, kind))
            taken[row] = middle + half + 0.01
    return found


def _title(cleaned: Cleaned, rejected: NDArray[np.bool_]) -> str:
    name = printable(cleaned.recording.name, _NAME)
    fixes = f"{(cleaned.row >= 0).sum():,} fixes in {duration(float(cleaned.time[-1]))}"
    how = f"{cleaned.found.filter}, {'smoothed' if cleaned.found.smooth else 'as on line'}"
    return f"{name}: {fixes}, {rejected.sum():,} rejected; {how}; bands of {SURE:g} std"


def _clock(cleaned: Cleaned) -> tuple[str, float]:
    """The name of the axis of time, and seconds in its unit."""
    unit, seconds = "seconds", 1.0
    for name, size, least in (
        ("minutes", 60.0, 300.0),
        ("hours", 3600.0, 3 * 3600.0),
        ("days", 86_400.0, 3 * 86_400.0),
    ):
        if cleaned.time[-1] >= least:
            unit, seconds = name, size
    stamps = dates(cleaned)
    return (unit if stamps is None else f"{unit} since {stamps[0][:19].replace('T', ' ')} UTC"), seconds


def _sides(cleaned: Cleaned, across: Array) -> Array:
    """``(T, 2, 2)`` m: the path, moved to its left and to its right by ``SURE`` standard deviations."""
    velocity = cleaned.velocity[:, :2]
    ahead = velocity / np.maximum(np.linalg.norm(velocity, axis=1, keepdims=True), 1e-12)
    left = SURE * across[:, None] * np.stack([-ahead[:, 1], ahead[:, 0]], 1)
    sides: Array = cleaned.position[:, None, :2] + np.stack([left, -left], 1)
    return sides


def _off(cleaned: Cleaned) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which fixes are off across the ground, and which in height; of a filter that does not part them, all in both."""
    off = np.abs(cleaned.raw - cleaned.position)
    if len(cleaned.parameters) < 2:
        return np.ones(len(off), bool), np.full(len(off), off.shape[1] == 3)
    ground, height = (MATTERS * float(part.sigma) for part in cleaned.parameters)
    return np.linalg.norm(off[:, :2], axis=1) > ground, off[:, 2] > height


def _altitude(
    cleaned: Cleaned, std: Array | None, rejected: NDArray[np.bool_], climbs: list[tuple[float, float, str]]
) -> Band | None:
    """Altitude, or up of the origin where there is no latitude, m; None in the plane."""
    origin = cleaned.recording.origin
    if std is None:
        return None
    mean, raw = (of[:, 2] if origin is None else to_geodetic(of, origin)[2] for of in (cleaned.position, cleaned.raw))
    return Band(mean, std, raw, rejected, climbs)


def _corners(cleaned: Cleaned, rejected: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Lower left and upper right, m: the path where it was measured, and the fixes that are not too far from it."""
    path, fixes = cleaned.position[:, :2], cleaned.raw[:, :2]
    finite, kept = np.isfinite(path).all(1), (cleaned.row >= 0) & ~rejected
    of = path[finite & kept] if (finite & kept).any() else path[finite] if finite.any() else np.zeros((1, 2))
    low, high = without_spikes(of)
    return corners(low, high, fixes, _ROOM * max((high - low).max(), 1.0))


def without_spikes(values: Array) -> tuple[Array, Array]:
    """Least and largest values ``(c,)`` of ``(T, c)``; of their running medians where single ones are far beyond."""
    low, high = values.min(0), values.max(0)
    if len(values) < _MEDIAN:
        return low, high
    median = np.median(np.lib.stride_tricks.sliding_window_view(values, _MEDIAN, axis=0), -1)
    usual = median.min(0), median.max(0)
    far = (high - low).max() > _SPIKE * (usual[1] - usual[0]).max()
    return usual if far else (low, high)
