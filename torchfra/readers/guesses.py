"""Guesses which columns of a table may hold a track where their names do not say it, for error messages."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from torchfra.readers.clocks import FRAMES, days_of
from torchfra.readers.columns import Array, Head, number
from torchfra.readers.options import METRES
from torchfra.readers.spelling import found, plain, unit
from torchfra.readers.times import form_of

_DEGREES = re.compile(r"\s*[+-]?[0-9]{1,3}[.,][0-9]{4,}\s*")
"""A latitude or longitude to 10 m or better."""
_NORTH = re.compile(r"nor[dt]|(?:^|[^a-z])[yn](?:$|[^a-z])")
"""In the name of a column of northings."""
_RANGE, _BEARING = re.compile("(?:slant|ground)?range|distance|rho$|r$"), re.compile("azimuth|bearing|azi?$|theta$")
"""In the names of what a radar measures."""
_WEEK = 604_800
_FEW = 4
"""Columns of numbers up to which the first two may be x and y."""


def looks_like(head: Head, known: Collection[str] = ()) -> str:
    """What options the columns look like: "; looks like --time 1 --lat 2 --lon 3", or "" where they look like nothing.

    Args:
        head: of the table.
        known: columns that are understood; where there are any, only the time is guessed.
    """
    names = [name for name in head.names if name not in known]
    cells = {name: [cell for cell in head.cells(name) if cell is not None and str(cell).strip()] for name in names}
    values = {name: column for name in names if len(column := _numbers(cells[name]))}
    time = next((name for name in names if name not in values and _is_time(cells[name])), "")
    likely = [name for name in values if plain(name) in FRAMES]  # each comes once for every target
    growing = [name for name, column in values.items() if len(column) > 1 and (np.diff(column) > 0).all()]
    time = time or next(iter(likely + growing), "")
    weeks = found(head.names, "week") and time in values and values[time].max() <= _WEEK
    form = "gps" if weeks else days_of(values[time], time) if time in values else ""
    of_frames = plain(time) in FRAMES
    frames = ", if a second has 25 frames" if of_frames else ""
    form = "25fps" if of_frames else form
    option = f" --time-format {form}" if form else ""
    if known:
        when = f"; looks like --time {time}{option}{frames}"
        return when if time else "; rows need a time, such as seconds since the first of them"
    if polar := _polar(values):
        return polar
    places = _places({name: column for name, column in values.items() if name != time}, cells)
    return f"; looks like --time {time}{option} {places}{frames}" if time and places else ""


def _places(values: dict[str, Array], cells: dict[str, list[Any]]) -> str:
    """Options for two columns of numbers; "" where none can be positions."""
    fine = {name: sum(_DEGREES.fullmatch(str(cell)) is not None for cell in cells[name]) for name in values}
    small = [name for name, column in values.items() if np.abs(column).max() <= 180 and not _is_length(name)]
    degrees = [name for name in small if 2 * fine[name] > len(values[name])]
    if len(degrees) >= 2:
        lat, lon = degrees[:2] if np.abs(values[degrees[0]]).max() <= 90 else degrees[1::-1]
        return f"--lat {lat} --lon {lon}"
    moving = [name for name, column in values.items() if len(np.unique(column)) > 1]
    if not 2 <= len(moving) < _FEW:
        return ""
    x, y = moving[:2] if _NORTH.search(moving[1].lower()) or not _NORTH.search(moving[0].lower()) else moving[1::-1]
    miles = " --units nmi" if x.lower().endswith("nm") else ""
    return f"--x {x} --y {y}{miles}"


def _polar(values: Collection[str]) -> str:
    """What to do with columns of ranges and bearings; "" without such columns."""
    ranges, bearings = ([name for name in values if form.match(plain(name))] for form in (_RANGE, _BEARING))
    if not ranges or not bearings:
        return ""
    return (
        f"; {ranges[0]} and {bearings[0]} must be turned into x and y: from north clockwise, x = range * sin(bearing), "
        "y = range * cos(bearing), of the range on the ground; and their std, which grows with it, into a column sigma"
    )


def _is_length(name: str) -> bool:
    """Whether a name ends in a unit of length."""
    return unit(name, asked=True) in METRES or name.lower().endswith("nm")


def _numbers(cells: Sequence[Any]) -> Array:
    """The cells as numbers; none where one is something else."""
    with suppress(ValueError, TypeError, OverflowError):
        return np.array([number(cell.replace(",", ".") if isinstance(cell, str) else float(cell)) for cell in cells])
    return np.empty(0)


def _is_time(cells: Sequence[Any]) -> bool:
    """Whether these are texts that tell times."""
    texts = [cell for cell in cells if isinstance(cell, str)]
    with suppress(ValueError):
        return len(texts) == len(cells) and form_of(texts) is not None
    return True  # of which the day may be the month
