"""PLT of OziExplorer: the tracks of old receivers, and of GeoLife."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchfra.readers.columns import number, short
from torchfra.readers.sheets import Sheet, points_sheet, whole_text
from torchfra.readers.times import DAY_OF_1970, written

_DAY, _LATEST = 86_400.0, 2.5e11
"""Seconds; of the year 9892, past which there are no dates."""
_LINES = 6
"""Before the first fix."""
_NO_ALTITUDE = "-777"


def is_plt(start: bytes, suffix: str) -> bool:
    """Whether a file that begins so is PLT."""
    return suffix == ".plt" or start.startswith((b"OziExplorer Track", b"Geolife trajectory"))


def plt_sheet(file: Any, max_bytes: int, encoding: str) -> Sheet:
    """The fixes of a file: latitude, longitude, whether a piece begins, altitude in feet, days since 1899-12-30.

    Raises:
        ValueError: a line is something else.
    """
    lines = whole_text(file, max_bytes, "PLT", encoding).splitlines()
    if not lines:
        raise ValueError("expected a track, received an empty file")
    columns: dict[str, list[Any]] = {"time": [], "latitude": [], "longitude": [], "altitude_ft": []}
    for i, line in enumerate(lines[_LINES:], _LINES + 1):
        cells = [cell.strip() for cell in line.split(",")]
        if cells == [""]:
            continue
        try:
            latitude, longitude, _, feet, days, *_ = cells
            time = _iso(number(days))
        except ValueError:
            said = f"expected latitude, longitude, 0 or 1, feet and days in line {i}, received {short(line)}"
            raise ValueError(said) from None
        height = "" if feet.partition(".")[0] == _NO_ALTITUDE else feet
        for column, cell in zip(columns.values(), (time, latitude, longitude, height), strict=True):
            column.append(cell)
    return points_sheet(columns, ("PLT: times from days since 1899-12-30, altitudes in feet",))


def _iso(days: float) -> str:
    """ISO text to the millisecond.

    Raises:
        ValueError: there is no such day.
    """
    moment = round((days - DAY_OF_1970["excel"]) * _DAY, 3)
    if not 0 <= moment < _LATEST:
        raise ValueError
    return written(np.array([moment]), "iso")[0]
