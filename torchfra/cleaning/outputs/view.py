"""What a picture of a cleaned track shows, whoever draws it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchfra.cleaning import Cleaned, Segment
from torchfra.cleaning.outputs.course import course
from torchfra.cleaning.outputs.times import dates
from torchfra.geodesy import to_geodetic
from torchfra.readers.columns import Array
from torchfra.tables import duration, metres

SURE = 2.0
"""Standard deviations to each side that a band is wide."""
MOST_STD = 6.0
"""Of an innovation, up to which it is shown."""
_ROOM = 0.5
"""How far kept fixes may widen the map of the path, as a share of it."""
_REGIMES = 5
"""That are shown by themselves, with the calm one."""
_LEAST_SHARE = 0.01
"""Mean probability of a regime that is shown by itself."""


_UNITS = {"turn": "deg/s", "climb": "m/s", "descend": "m/s"}
"""Of the rate of a manoeuvre, by a word of its kind; of others it is m/s^2."""


class Band(NamedTuple):
    """A quantity over time, each ``(T,)``."""

    mean: Array
    std: Array
    recorded: Array | None = None
    """NaN between fixes; None where it is not recorded."""

    def limits(self) -> tuple[float, float]:
        """Of an axis: the quantity, and its band where that is as wide as usual."""
        mean, std = self.mean[np.isfinite(self.mean)], self.std[np.isfinite(self.std)]
        if not len(mean):
            return 0.0, 1.0
        margin = max(0.08 * float(np.ptp(mean)), 1.5 * SURE * float(np.median(std)) if len(std) else 0.0, 1e-3)
        return float(mean.min()) - margin, float(mean.max()) + margin


class View(NamedTuple):
    """Numbers of a picture; ``T`` steps."""

    title: str
    unit: str
    """Of the map, with ``metres`` in one."""
    metres: float
    path: Array
    """``(T, 2)`` east and north, in ``unit``."""
    sides: Array
    """``(T, 2, 2)`` the edges of the band around it, left and right."""
    recorded: Array
    """``(T, 2)``; NaN between fixes."""
    rejected: NDArray[np.bool_]
    """``(T,)`` which of them are outliers."""
    window: tuple[Array, Array]
    """Lower left and upper right of the map."""
    time: Array
    """``(T,)`` in the unit that ``clock`` names."""
    clock: str
    speed: Band
    altitude: Band | None
    innovation: Array
    """``(T,)`` in standard deviations per axis: 1 is as expected; NaN between fixes."""
    manoeuvres: list[tuple[float, float, str]]
    """Begin and end in units of ``time``, and what it was."""
    regimes: dict[str, Array]
    """Probabilities ``(T,)`` by name, the calm one first."""

    def shades(self) -> list[tuple[float, float]]:
        """Begin and end of the time with any manoeuvre."""
        spans: list[tuple[float, float]] = []
        for begin, end, _ in sorted(self.manoeuvres):
            if spans and begin <= spans[-1][1]:
                spans[-1] = spans[-1][0], max(end, spans[-1][1])
            else:
                spans.append((begin, end))
        return spans


def view(cleaned: Cleaned) -> View:
    """What there is to be seen of a track."""
    moved, d = course(cleaned), cleaned.raw.shape[1]
    rejected = cleaned.flag == "outlier"
    low, high = _corners(cleaned, rejected)
    unit, size = ("km", 1000.0) if (high - low).max() >= 2000 else ("m", 1.0)
    clock, seconds = _clock(cleaned)
    path = cleaned.position[:, :2]
    return View(
        title=_title(cleaned, rejected),
        unit=unit,
        metres=size,
        path=path / size,
        sides=_sides(cleaned, moved.across) / size,
        recorded=cleaned.raw[:, :2] / size,
        rejected=rejected,
        window=(low / size, high / size),
        time=cleaned.time / seconds,
        clock=clock,
        speed=Band(moved.speed, moved.speed_std),
        altitude=_altitude(cleaned, moved.up),
        innovation=np.where(cleaned.row >= 0, np.sqrt(cleaned.nis / d), np.nan),
        manoeuvres=[(of.begin / seconds, of.end / seconds, named(of)) for of in cleaned.segments],
        regimes=_regimes(cleaned),
    )


def named(segment: Segment) -> str:
    """What a manoeuvre was, and how hard."""
    unit = next((unit for word, unit in _UNITS.items() if word in segment.kind), "m/s²")
    return f"{segment.kind}, {abs(segment.rate):.2g} {unit}"


def beyond(of: View, low: Array, high: Array) -> tuple[Array, Array, list[str]]:
    """Rejected fixes that are not on a map from ``low`` to ``high``: where they would leave it, and how far they are.

    Returns:
        Points ``(k, 2)`` on the edge, directions ``(k, 2)`` of length 1, and what to say of each, the farthest first.
    """
    steps = np.flatnonzero(of.rejected & np.isfinite(of.path).all(1))
    fixes = of.recorded[steps]
    out = ((fixes < low) | (fixes > high)).any(1)
    steps, fixes = steps[out], fixes[out]
    off = of.metres * np.linalg.norm(fixes - of.path[steps], axis=1)
    order = np.argsort(-off, kind="stable")
    steps, fixes, off = steps[order], fixes[order], off[order]
    centre, half = (low + high) / 2, (high - low) / 2
    way = fixes - centre
    edge = centre + way / np.maximum(np.abs(way) / half, 1e-12).max(1, keepdims=True)
    said = [f"{metres(far)} off" for far in off]
    return edge, way / np.linalg.norm(way, axis=1, keepdims=True), said


def _title(cleaned: Cleaned, rejected: NDArray[np.bool_]) -> str:
    fixes = f"{(cleaned.row >= 0).sum():,} fixes in {duration(float(cleaned.time[-1]))}"
    how = f"{cleaned.found.filter}, {'smoothed' if cleaned.found.smooth else 'as on line'}"
    return f"{cleaned.recording.name}: {fixes}, {rejected.sum():,} rejected; {how}; bands of {SURE:g} std"


def _clock(cleaned: Cleaned) -> tuple[str, float]:
    """The name of the axis of time, and seconds in its unit."""
    unit, seconds = "seconds", 1.0
    if cleaned.time[-1] >= 300:
        unit, seconds = ("minutes", 60.0) if cleaned.time[-1] < 3 * 3600 else ("hours", 3600.0)
    stamps = dates(cleaned)
    return (unit if stamps is None else f"{unit} since {stamps[0][:19].replace('T', ' ')} UTC"), seconds


def _sides(cleaned: Cleaned, across: Array) -> Array:
    """``(T, 2, 2)`` m: the path, moved to its left and to its right by how unsure it is."""
    velocity = cleaned.velocity[:, :2]
    ahead = velocity / np.maximum(np.linalg.norm(velocity, axis=1, keepdims=True), 1e-12)
    left = SURE * across[:, None] * np.stack([-ahead[:, 1], ahead[:, 0]], 1)
    sides: Array = cleaned.position[:, None, :2] + np.stack([left, -left], 1)
    return sides


def _altitude(cleaned: Cleaned, std: Array | None) -> Band | None:
    """Altitude, or up of the origin where there is no latitude, m; None in the plane."""
    origin = cleaned.recording.origin
    if std is None:
        return None
    mean, raw = (of[:, 2] if origin is None else to_geodetic(of, origin)[2] for of in (cleaned.position, cleaned.raw))
    return Band(mean, std, raw)


def _corners(cleaned: Cleaned, rejected: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Lower left and upper right, m: the path where it was measured, and the fixes that are not too far from it."""
    path, fixes = cleaned.position[:, :2], cleaned.raw[:, :2]
    finite, kept = np.isfinite(path).all(1), (cleaned.row >= 0) & ~rejected
    of = path[finite & kept] if (finite & kept).any() else path[finite] if finite.any() else np.zeros((1, 2))
    low, high = of.min(0), of.max(0)
    return corners(low, high, fixes, _ROOM * max((high - low).max(), 1.0))


def corners(low: Array, high: Array, fixes: Array, room: float) -> tuple[Array, Array]:
    """Lower left and upper right, with a margin, of a path and of the fixes that are at most ``room`` away from it."""
    near = fixes[((fixes > low - room) & (fixes < high + room)).all(1)]
    points = np.concatenate([[low], [high], near])
    low, high = points.min(0), points.max(0)
    margin = 0.04 * max((high - low).max(), 1.0)
    return low - margin, high + margin


def _regimes(cleaned: Cleaned) -> dict[str, Array]:
    """Those that matter, and the others as one."""
    if not cleaned.regimes:
        return {}
    share = np.nan_to_num(np.nanmean(cleaned.regime, 0)) if np.isfinite(cleaned.regime).any() else np.zeros(0)
    order = [i for i in np.argsort(-share, kind="stable") if i and share[i] >= _LEAST_SHARE][: _REGIMES - 1]
    shown = [0, *sorted(order)]
    named = {cleaned.regimes[i]: cleaned.regime[:, i] for i in shown}
    rest = [i for i in range(len(cleaned.regimes)) if i not in shown]
    return named | ({"others": cleaned.regime[:, rest].sum(1)} if rest else {})
