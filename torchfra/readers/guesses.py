"""Guesses which columns of a table may hold a track where their names do not say it, for error messages."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from shlex import quote
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchfra.readers.clocks import FRAMES, YEAR_1980, days_of
from torchfra.readers.columns import Array, Head, is_missing, joined, number
from torchfra.readers.identities import counts_rows, likely_ids, option
from torchfra.readers.spelling import NAMES, RARER_UNITS, UNITS, found, name_words, plain, unit
from torchfra.readers.times import form_of, seconds_of

_DEGREES = re.compile(r"\s*[+-]?[0-9]{1,3}[.,][0-9]{4,}\s*")
"""A latitude or longitude to 10 m or better."""
_OTHERWISE = re.compile(
    r"speed|veloc|accel|course|heading|angle|azimuth|bearing|direction|orient|rotat|quaternion|counte?r?\b|offset|"
    r"sequence|temperature|pressure|humid|volt|satel|signal|sigma|error|accura|covar|score|likelihood|confidence|size|"
    r"width|length|distance|dop\b|\b(?:v|vel|acc|gyro|mag|sog|cog|hdg|yaw|roll|pitch|rot|dir|elevation|ranges?|rssi|snr|"
    r"seq|index|idx|g?id|no|num|number|partition|temp|std|sd|err|cov|sats?|rate|age)\b"
)
"""In the words of a name, what is no position."""
_RANGE, _BEARING = re.compile("(?:slant|ground)?range|distance|rho$|r$"), re.compile("azimuth|bearing|azi?$|theta$")
"""In the names of what a radar measures."""
_TIMES = {"time", "timestamp", "ts", "date", "datetime", "stamp"}
"""Words in names of times."""
_STARTS = {"start", "begin", "end", "scheduled", "planned"}
"""Words in names of times that are not those of a fix."""
_OF_THE_DAY = re.compile(r"[0-9]{1,2}:[0-9]{2}(?::[0-9]{2}(?:[.,][0-9]+)?)?(?: ?[AaPp][Mm])?")
_SQUARE = re.compile(r"\s*(?:[0-9]{1,2}[C-HJ-NP-X])?\s*[A-HJ-Z]{2}\s*[0-9]{2,5}\s*[0-9]{2,5}\s*")
"""A square of a national grid, or of MGRS, and where in it."""
_WEEK = 604_800
_NEAR = 2e-3
"""Degrees between neighbouring fixes, of which metres, for robots, are more."""
_LISTED = 8
"""Columns that a message lists at most."""


def looks_like(head: Head, known: Collection[str] = ()) -> str:
    """What options the columns look like: "; looks like --time 1 --lat 2 --lon 3", or "" where they look like nothing.

    Args:
        head: of the table.
        known: columns that are understood; where there are any, only the time is guessed.
    """
    names = [name for name in head.names if name not in known]
    cells = {
        name: [cell for cell in head.cells(name) if cell is not None and not is_missing(str(cell))] for name in names
    }
    values = {name: column for name in names if len(column := _numbers(cells[name]))}
    times = [name for name in names if name not in values and _is_time(cells[name])]
    time = next((name for name in times if not _STARTS & {*name_words(name)}), "")
    places = _by_names(values)
    likely = [name for name in values if plain(name) in FRAMES]  # each comes once for every target
    dated = [name for name, column in values.items() if YEAR_1980 < column.min() < column.max()]
    newest_first = [name for name in dated if _grows(values[name][::-1])]
    growing = newest_first + [name for name, column in values.items() if _grows(column)]
    growing = [name for name in growing if not _is_other(name) and name not in places.values()]
    named = [name for name in values if {*name_words(name)} & _TIMES]
    sure = [name for name in named if name in dated or name in growing] or found(values, "time")
    time = time or next(iter(sure or likely + growing + named + times), "")
    asked = _with_date(time, [name for name in names if name not in values and name != time], head)
    weeks = found(head.names, "week") and time in values and values[time].max() <= _WEEK
    form = "gps" if weeks else days_of(values[time], time) if time in values else ""
    of_frames = plain(time) in FRAMES
    frames = ", if a second has 25 frames" if of_frames else ""
    form = "25fps" if of_frames else form
    form_said = f" --time-format {form}" if form else ""
    if known:
        when = f"; looks like --time {quote(asked)}{form_said}{frames}"
        return when if time else "; rows need a time, such as seconds since the first of them"
    if said := cartesian(values):
        return said
    for name in names:  # a row for each coordinate, as databases of time series write them
        words = {*map(str, cells[name])} if name not in values else set()
        if rows := [*found(words, "latitude"), *found(words, "longitude")]:
            return f"; {rows[0]} is in rows of {name}: pivot the table, so that each coordinate has a column"
    if squares := [name for name in names if cells[name] and all(_SQUARE.fullmatch(str(cell)) for cell in cells[name])]:
        return f"; {squares[0]} holds references such as {cells[squares[0]][0]}: convert them to degrees, or metres"
    rest = {name: column for name, column in values.items() if name != time}
    places = places or _by_degrees(rest, cells)
    for name in names if not places else []:
        if any(isinstance(cell, list) or str(cell).lstrip().startswith(("[[", "LINESTRING")) for cell in cells[name]):
            return f"; {name} holds several records, or places, in a cell: write a row for each time and place"
    if not time or not places:
        return _ranges(asked, rest)
    target = _target(head, time, places)
    pixels = "; read mm in the results as pixels" if _is_of_pixels(next(iter(places.values()))) else ""
    several = "" if head.said else _several(time, [name for name in rest if not _is_other(name)])
    return f"; looks like --time {quote(asked)}{form_said} {_said(places)}{target}{frames}{pixels}{several}"


def side_by_side(time: str, pairs: str, more: str = "") -> str:
    """What makes a row for each target and time of pairs of columns: a line of Python.

    Args:
        time: the column of times.
        pairs: an expression for the pairs of columns of the table ``t``.
        more: arguments of ``pandas.read_csv``.
    """
    return (
        f"one target of several side by side, and all are read from long.csv after: t = pandas.read_csv(FILE{more}); "
        f"pandas.concat({{a: t[[{time!r}, a, b]].set_axis([{time!r}, 'x', 'y'], axis=1) for a, b in {pairs}}}, "
        "names=['id']).reset_index('id').to_csv('long.csv', index=False)"
    )


def _several(time: str, names: Sequence[str]) -> str:
    """What to do with pairs of x and y of several targets, whose names end alike; "" where there is one pair.

    Names as they stand in the file: without lines that were left out.
    """
    ends = Counter[tuple[str, str]]()
    for x, y in _alike(names, "x", "y"):
        start = next((i for i, (a, b) in enumerate(zip(x, y, strict=False)) if a != b), min(len(x), len(y)))
        ends[x[start:], y[start:]] += 1
    (x, y), count = max(ends.items(), key=lambda item: item[1], default=(("", ""), 0))
    pairs = f"((n, n.removesuffix({x!r}) + {y!r}) for n in t if n.endswith({x!r}))"
    return f"; this is {side_by_side(time, pairs)}" if count > 1 else ""


def _with_date(time: str, names: Sequence[str], head: Head) -> str:
    """The time as ``--time`` takes it: with the column of its date in front, where it is one of the day."""
    clock = joined(head.cells, (time,)) if time else []
    if not any(clock) or not all(_OF_THE_DAY.fullmatch(cell) for cell in clock if cell):
        return time
    dates = (name for name in names if _is_time([*filter(None, joined(head.cells, (name, time)))]))
    return ",".join([*list(dates)[:1], time])


def _target(head: Head, time: str, places: Mapping[str, str]) -> str:
    """The option for the column that names the target of a row; "" where none is needed, or its name says it."""
    if any(not counts_rows(name, head) for name in found(head.names, "id")):
        return ""
    order = _in_order(head.cells(time))
    place = np.stack([_or_missing(head.cells(name)) for name in places.values()], 1)
    ids = likely_ids(head, order, place, [name for name in head.names if name not in (time, *places.values())])
    return f" {option(ids[0])} (if that names the target)" if ids else ""


def _in_order(cells: Sequence[Any] | NDArray[Any]) -> Array:
    """Times as numbers that grow with them; NaN where missing."""
    values = _or_missing(cells)
    if np.isfinite(values).any():
        return values
    texts = ["" if cell is None else str(cell).strip() for cell in cells]
    with suppress(ValueError):
        if (form := form_of([*filter(None, texts)])) is not None:
            return np.array([seconds_of(text, form[0]) if text else np.nan for text in texts])
    return np.full(len(texts), np.nan)


def _or_missing(cells: Sequence[Any] | NDArray[Any]) -> Array:
    """The cells as numbers; NaN where they are none."""
    values = np.full(len(cells), np.nan)
    for i, cell in enumerate(cells):
        with suppress(ValueError, TypeError, OverflowError):
            values[i] = number(cell.replace(",", ".")) if isinstance(cell, str) else float(cell)
    return values


def _said(places: Mapping[str, str]) -> str:
    """Options for columns by what they hold."""
    first, *_ = places.values()
    return " ".join(f"--{role} {quote(name)}" for role, name in places.items()) + _units(first)


def _by_names(values: Collection[str]) -> dict[str, str]:
    """Two columns that names say are positions, by the options for them; none where none do."""
    names = [name for name in values if not _is_other(name)]
    for roles, options in (
        (("latitude", "longitude", "altitude"), ("lat", "lon", "alt")),
        (("x", "y", "z"), ("x", "y", "z")),
    ):
        if pair := alike(names, *roles[:2]):
            heights = [height for place, height in _alike(names, roles[0], roles[2]) if place == pair[0]]
            return dict(zip(options, [*pair, *heights[:1]], strict=False))
    return {}


def _by_degrees(values: Mapping[str, Array], cells: Mapping[str, Sequence[Any]]) -> dict[str, str]:
    """The only two columns of fine degrees, by the options for them; none where there are others."""
    degrees = [name for name, column in values.items() if _may_be_degrees(name, column, cells[name])]
    if len(degrees) != 2 or max(np.abs(values[name]).max() for name in degrees) < 1:  # as of a robot in its room
        return {}
    lat, lon = degrees if np.abs(values[degrees[0]]).max() <= 90 else degrees[::-1]
    return {"lat": lat, "lon": lon}


def _may_be_degrees(name: str, column: Array, cells: Sequence[Any]) -> bool:
    """Whether these are fine degrees of neighbouring places, of which the name says nothing else."""
    fine = sum(_DEGREES.fullmatch(str(cell)) is not None for cell in cells)
    if _is_other(name) or unit(name, asked=True) or 2 * fine <= len(column) or np.abs(column).max() > 180:
        return False
    return bool(np.median(np.abs(np.diff(column, prepend=column[0]))) < _NEAR)


def _ranges(time: str, values: Mapping[str, Array]) -> str:
    """Columns of numbers and their ranges, for a person to choose from; "" where fewer than two change."""
    moving = [(name, column.min(), column.max()) for name, column in values.items() if len(np.unique(column)) > 1]
    if len(moving) < 2:
        return ""
    said = ", ".join(f"{name} ({least + 0.0:.6g} to {most + 0.0:.6g})" for name, least, most in moving[:_LISTED])
    more = f" and {len(moving) - _LISTED} more" if len(moving) > _LISTED else ""
    return f"; say --time{time and f' {quote(time)}'} with --lat and --lon, or --x and --y, of the columns {said}{more}"


def _units(name: str) -> str:
    """The option for lengths in this column, where the end of its name says less than it has to."""
    return " --units nmi" if name.lower().endswith("nm") else " --units mm" if _is_of_pixels(name) else ""


def _is_of_pixels(name: str) -> bool:
    return name_words(name)[-1:] == ["px"]


def _grows(column: Array) -> bool:
    return len(column) > 1 and bool((np.diff(column) > 0).all())


def alike(names: Sequence[str], one: str, other: str) -> tuple[str, str] | None:
    """Two names that differ in words for these roles alone, such as ``Local_X`` and ``Local_Y``."""
    return next(_alike(names, one, other), None)


def _alike(names: Sequence[str], one: str, other: str) -> Iterator[tuple[str, str]]:
    """All such names: each with the best one for the other role."""
    words = {_without_unit(name): name for name in reversed(names)}
    for several, name in reversed(words.items()):
        for i in (i for i, word in enumerate(several) if word in NAMES[one]):
            pairs = ((*several[:i], word, *several[i + 1 :]) for word in NAMES[other])
            if pair := next((words[pair] for pair in pairs if pair in words), None):
                yield name, pair


def _without_unit(name: str) -> tuple[str, ...]:
    """The words of a name in the singular, without a unit at its end."""
    words = name_words(name)
    words = words[:-1] if len(words) > 1 and words[-1] in {*UNITS, *RARER_UNITS} else words
    return tuple(word.removesuffix("s") for word in words)


def polar(names: Collection[str]) -> tuple[str, str] | None:
    """A column of ranges and one of bearings; None without such columns."""
    ranges, bearings = ([name for name in names if form.match(plain(name))] for form in (_RANGE, _BEARING))
    return (ranges[0], bearings[0]) if ranges and bearings else None


def cartesian(names: Collection[str]) -> str:
    """What to do with columns of ranges and bearings; "" without such columns."""
    if (pair := polar(names)) is None:
        return ""
    return (
        f"; {pair[0]} and {pair[1]} must be turned into x and y: from north clockwise, x = range * sin(bearing), "
        "y = range * cos(bearing), of the range on the ground; and their std, which grows with it, into a column sigma"
    )


def _is_other(name: str) -> bool:
    """Whether a name says that its column is no position."""
    return _OTHERWISE.search(" ".join(name_words(name))) is not None


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
