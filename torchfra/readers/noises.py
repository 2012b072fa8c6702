"""Columns that say how good a fix is."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from torchfra.readers.columns import HEAD, Array, Head, Kind, values_of, word_of
from torchfra.readers.names import DEGREES, LENGTHS, METRES, found, in_brackets, name_words, plain
from torchfra.readers.names import unit as unit_of

RANGE_ERROR = 5.0
"""Standard deviation of the range to a satellite (UERE) that is assumed where a file has an HDOP, m."""
_PER_AXIS = 1 / math.sqrt(2)
"""An HDOP is of the distance on the map, and a standard deviation of one axis."""
_OF_A_RADIUS = 1 / math.sqrt(-2 * math.log(1 - 0.68))
"""From the radius around a fix that holds 68 % of the true positions."""
_CLASSES = {"3": 490.0, "2": 1010.0, "1": 1200.0, "0": 4180.0, "a": 6190.0, "b": 10_280.0, "z": 10_280.0, "g": 49.0}
"""Radius that holds 68 % of the fixes of each class of Argos, m.

Source: Costa et al. (2010), PLoS ONE 5, e8677, of seals and sea lions; Z is as B, and G (GPS) a tenth of 3, as in
aniMotum (Jonsen et al., 2023).
"""
_CLASS = Kind("a class of Argos", unit=_OF_A_RADIUS, words=tuple(_CLASSES.items()))
_UNKNOWN = (65_535.0, 655.35, 4_294_967_295.0, 4_294_967.295)
"""What receivers write for an accuracy that they do not know: a counter that is full, of metres or of parts of them."""
_NO_HDOP = (99.0, 99.9, 99.99, 100.0)
"""The same for an HDOP."""
_ELLIPSE = ("semi_major", "semi_minor", "orientation")
_COVARIANCE = re.compile(r"(?:(?:field|gps|gnss|fix|pose|position) )*covariance ?(?P<place>[0-9]{1,2})")
"""Words of names of columns with the entries of a covariance, row by row, as robots write them."""


class Noise(NamedTuple):
    """How good the fixes are."""

    columns: dict[str, Kind]
    """One for all axes or one for each, of which ``per_axis`` makes standard deviations in metres."""
    said: tuple[str, ...] = ()
    """Lines for a person."""
    per_axis: Callable[[list[Array]], list[Array]] = list
    argos: bool = False
    """Whether they are of Argos."""


def axes_of_ellipses(columns: Sequence[Array]) -> list[Array]:
    """Standard deviations east and north of the error ellipses of Argos, or of the classes of fixes without ellipses.

    Source: McClintock et al. (2015), Methods in Ecology and Evolution 6, 266: axes are standard deviations times the
    root of 2.

    Args:
        columns: the larger and the smaller axis, m, degrees from north to the larger one, and, if there are four, the
            standard deviation of the class, m.
    """
    larger, smaller, angle = columns[0] / math.sqrt(2), columns[1] / math.sqrt(2), np.radians(columns[2])
    known = (larger > 0) & (smaller > 0) & np.isfinite(angle)
    otherwise = columns[3] if len(columns) == 4 else np.full_like(larger, np.nan)
    east = np.hypot(larger * np.sin(angle), smaller * np.cos(angle))
    north = np.hypot(larger * np.cos(angle), smaller * np.sin(angle))
    return [np.where(known, east, otherwise), np.where(known, north, otherwise)]


def roots_of_variances(columns: Sequence[Array]) -> list[Array]:
    """Standard deviations of variances east, north and up; NaN where one is 0, of an unknown covariance.

    Source: ROS, sensor_msgs/NavSatFix.
    """
    return [np.where(variance > 0, np.sqrt(np.abs(variance)), np.nan) for variance in columns]


def noise_of(
    head: Head, asked: Mapping[str, tuple[str, ...]], unit: float, ships: bool, *, stated: bool = False,
    units: Mapping[str, str] = {},
) -> Noise:  # fmt: skip
    """The columns with the standard deviations of fixes, if there are any.

    Args:
        head: of the table.
        asked: columns by what they hold, as the caller or the format says.
        unit: metres in the unit of positions.
        ships: whether the file is of ships, whose "accuracy" is a mark and no distance.
        stated: whether the caller names a column of standard deviations.
        units: of the format, by column.
    """

    def metres(column: str, otherwise: float) -> float:
        return METRES.get(LENGTHS.get(unit_of(column), "") or units.get(plain(column), ""), otherwise)

    names = [name for name in head.names if not ("%" in (word := in_brackets(name)) or word in {"percent", *DEGREES})]
    if stated:
        (column,) = asked["sigma"]
        return Noise({column: Kind(unit=metres(column, unit))}, (f"sigma: {column}, per axis",))
    axes = [column for axis in "xyz" for column in found(names, f"sigma_{axis}")[:1]]
    if len(axes) >= 2 and "sigma" not in asked:
        return Noise({column: Kind(unit=metres(column, unit)) for column in axes}, (f"sigma: {', '.join(axes)}",))
    if "sigma" not in asked and (variances := _variances(head)):
        said = f"sigma: roots of {', '.join(variances)}"
        return Noise(dict.fromkeys(variances, Kind(unit=unit**2)), (said,), roots_of_variances)
    words = {
        column: {*map(word_of, head.cells(column))} - {""}
        for column in asked.get("argos_class", found(names, "argos_class")[:1])
    }
    classes = {column: _CLASS for column, every in words.items() if every and every <= _CLASSES.keys()}
    ellipse = [column for part in _ELLIPSE for column in found(names, part)[:1]]
    if "sigma" not in asked and len(ellipse) == len(_ELLIPSE):
        columns = dict.fromkeys(ellipse, Kind()) | classes
        return Noise(columns, (f"sigma: {', '.join(columns)} of Argos",), axes_of_ellipses, argos=True)
    if "sigma" not in asked and classes:
        return Noise(classes, tuple(f"sigma: {one}, errors of the classes of Argos" for one in classes), argos=True)
    for column in asked.get("sigma", found(names, "sigma")):
        cells, name = head.cells(column), plain(column)
        if "sigma" not in asked and len(cells) < HEAD and not any(word_of(cell).strip("0.,") for cell in cells):
            continue  # 0 everywhere says that nothing is known; a longer column may say it further on
        if name in ("hdop", "horizontaldilutionofprecision"):
            factor = RANGE_ERROR * _PER_AXIS
            said = f"sigma: {column} times {factor:.1f} m (ranges good to {RANGE_ERROR:g} m){_unknown(cells, _NO_HDOP)}"
            return Noise({column: Kind(unit=factor, absent=_NO_HDOP)}, (said,))
        if "acc" in name and not ships:
            factor = _OF_A_RADIUS * metres(column, 1.0)
            said = f"sigma: {column} times {_OF_A_RADIUS:.2f} (a radius of 68 %){_unknown(cells, _UNKNOWN)}"
            return Noise({column: Kind(unit=factor, absent=_UNKNOWN)}, (said,))
        if "acc" not in name:
            said = f"sigma: {column}, per axis{_unknown(cells, _UNKNOWN)}"
            return Noise({column: Kind(unit=metres(column, unit), absent=_UNKNOWN)}, (said,))
    return Noise({})


def _unknown(cells: Iterable[Any], numbers: tuple[float, ...]) -> str:
    """What is said where an accuracy is not known."""
    there = sorted({*values_of(cells)} & {*numbers})
    return f"; {there[0]:.10g} is no accuracy" if there else ""


def _variances(head: Head) -> list[str]:
    """Columns of the variances of x, y and z in a covariance of 3 or of 6 rows, if these are known."""
    matches = ((_COVARIANCE.fullmatch(" ".join(name_words(name))), name) for name in head.names)
    places = {int(match["place"]): name for match, name in matches if match}
    rows = math.isqrt(len(places))
    columns = [places.get(i * (rows + 1), "") for i in range(3)] if rows in (3, 6) else []
    unknown = [name for name in head.names if plain(name).endswith("covariancetype")]
    if any("0" in map(word_of, head.cells(name)) for name in unknown):
        return []
    known = all(one and any(word_of(cell).strip("0.") for cell in head.cells(one)) for one in columns)
    return columns if known else []
