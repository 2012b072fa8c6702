"""Columns that say how good a fix is."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from torchfra.readers.spelling import found, plain
from torchfra.readers.spelling import unit as unit_of
from torchfra.readers.told import METRES

RANGE_ERROR = 5.0
"""Standard deviation of the range to a satellite (UERE) that is assumed where a file has an HDOP, m."""
_PER_AXIS = 1 / math.sqrt(2)
"""An HDOP is of the distance on the map, and a standard deviation of one axis."""
_OF_A_RADIUS = 1 / math.sqrt(-2 * math.log(1 - 0.68))
"""From the radius around a fix that holds 68 % of the true positions."""


class Noise(NamedTuple):
    """How good the fixes are."""

    columns: dict[str, float]
    """One for all axes or one for each, and what makes a standard deviation per axis in metres of its numbers."""
    said: tuple[str, ...] = ()
    """Lines for a person."""


def noise_of(names: list[str], asked: Mapping[str, str], unit: float, ships: bool) -> Noise:
    """The columns with the standard deviations of fixes; none if there are none.

    Args:
        names: of all columns.
        asked: by the caller: columns by what they hold.
        unit: metres in the unit of positions.
        ships: whether the file is of ships, whose "accuracy" is a mark and no distance.
    """

    def metres(column: str, otherwise: float) -> float:
        return METRES.get(unit_of(column, asked=True) or "", otherwise)

    if "sigma" in asked:
        return Noise({asked["sigma"]: metres(asked["sigma"], unit)}, (f"sigma: {asked['sigma']}, per axis",))
    axes = [column for axis in "xyz" for column in found(names, f"sigma_{axis}")[:1]]
    if len(axes) >= 2:
        return Noise({column: metres(column, unit) for column in axes}, (f"sigma: {', '.join(axes)}",))
    for column in found(names, "sigma"):
        name = plain(column)
        if name == "hdop":
            factor = RANGE_ERROR * _PER_AXIS
            return Noise(
                {column: factor}, (f"sigma: {column} times {factor:.1f} m (ranges good to {RANGE_ERROR:g} m)",)
            )
        if "acc" in name and not ships:
            factor = _OF_A_RADIUS * metres(column, 1.0)
            return Noise({column: factor}, (f"sigma: {column} times {_OF_A_RADIUS:.2f} (a radius of 68 %)",))
        if "acc" not in name:
            return Noise({column: metres(column, unit)}, (f"sigma: {column}, per axis",))
    return Noise({})
