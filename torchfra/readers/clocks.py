"""Which column tells the time, and how."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchfra.readers.columns import Array, Head, Kind, joined, short, texts_of, values_of
from torchfra.readers.formats import Format
from torchfra.readers.names import TIMES, found, in_brackets, name_words, plain, unit
from torchfra.readers.options import AskError, ReadOptions
from torchfra.readers.times import (
    SINCE_1970,
    STARTS,
    UNITS,
    WEEK,
    WEEKS,
    count_of,
    counted,
    forms_of,
    is_clock,
    per_second,
    seconds_of,
)

YEAR_1980 = 315_532_800.0
"""Seconds since 1970; nothing was recorded before."""
_YEAR_2036, _YEAR_2286 = 2.1e9, 1e10
_LATEST = 1e7
"""Seconds since a start that a recording may have, 115 days; more without a unit are another unit, or no count."""
_DAY = 86_400.0
_DATED = {"timestamp", "utc", "timeutc", "utctime", "unixtime", "unix", "epoch", "unixtimestamp", "timestamputc",
          "date", "day"}  # fmt: skip
"""Names of times that are a date too."""
_ABOVE = {"year", "month", "hour", "hours", "minute", "minutes", "min"}
_BELOW = {"msec", "msecs", "usec", "usecs", "nsec", "nsecs", "nanosec", "nanosecs", "nanoseconds", "nanos", "micros"}
"""Last words of names of columns that hold parts of a time, of more than a second or of less."""
_PARTS = ("year", "month", "day", "hour", "minute", "second")
_FEW = 0.1
"""Share of the times of a clock that may not have been set yet."""
_NO_UNITS = {"utc", "gmt", "zulu", "local", "unix", "epoch", "elapsed", "relative", "since", "start", "gps", "time"}
"""What may stand in brackets behind times and is no unit."""
_LOCAL = {"local", "lmt", "lcl"}
"""Words of names of times that are not UTC."""
_FRAMES = {"frame", "frameid", "frames", "framenumber", "frameidx", "frameindex", "frameno", "coords"}


@dataclass(frozen=True)
class Clock:
    """How a column, or several that are joined, tell the time."""

    columns: tuple[str, ...]
    kind: Kind
    dated: bool
    """Whether it tells the date too."""

    @property
    def form(self) -> str:
        """How it is written, as ``ReadOptions.time_format`` says it."""
        return self.kind.form

    @property
    def said(self) -> str:
        """A word or two for a person."""
        form = self.form
        if form == "iso":
            return "ISO text"
        if per_second(form) and form not in UNITS:
            return f"frames, {per_second(form):g} a second"
        since = " since 1970" if self.dated and form in UNITS else ""
        return "times of the day" if is_clock(form) else form + since

    @property
    def column(self) -> str:
        """What the times are called in a table."""
        return " ".join(self.columns)

    def whole(self, time: Array) -> Array:
        """Times ``(rows,)``; those of a clock go on after midnight.

        Raises:
            ValueError: they are of years before 1980.
        """
        rows = np.flatnonzero(np.isfinite(time))
        if is_clock(self.form):
            time[rows] += _DAY * np.cumsum(np.diff(time[rows], prepend=time[rows[:1]]) < -_DAY / 2)
        elif self.dated and len(rows) and np.median(time[rows]) < YEAR_1980:
            raise AskError(f"column {self.column}: expected years from 1980 on, received earlier ones, which look like "
                           "times since a start: name another column, or their unit, such as ",
                           {"time_format": "seconds"})  # fmt: skip
        return time


def clock_of(
    head: Head, options: ReadOptions, asked: Mapping[str, tuple[str, ...]], format: Format | None
) -> tuple[Clock, list[str]]:
    """The column of times, and other columns of times, which are not used.

    Args:
        head: of the table, without the columns of positions.
        options: of the caller.
        asked: columns by what they hold, as the caller or the format says.
        format: that is recognised.

    Raises:
        LookupError: no column of times.
        ValueError: times that are not understood.
    """
    form = options.time_format or (format.time if format else "")
    if "time" in asked:
        return _clock(asked["time"], head, form, sure=options.time is not None), []
    candidates, clocks, refusals = found(head.names, "time"), list[Clock](), dict[str, ValueError]()
    for name in candidates:
        try:
            clocks.append(_clock((name,), head, form))
        except ValueError as error:
            refusals[name] = error
    if not clocks:
        raise _in_parts(head.names) or next(iter(refusals.values()), LookupError("time"))
    best = min(clocks, key=lambda clock: (not clock.dated, count_of(clock.form) is not None,
                                          bool(_LOCAL & {*name_words(clock.columns[-1])})))  # fmt: skip
    if refusals and not best.dated and candidates[0] in refusals:
        raise refusals[candidates[0]]
    dates = [one for one in found(head.names, "date") if len(values_of(head.cells(one)))]
    _check_whole(best, head, candidates, dates)
    return best, [name for name in candidates if name not in best.columns]


def _check_whole(clock: Clock, head: Head, whole: list[str], dates: list[str]) -> None:
    """Refuses times of which other columns hold a part."""
    front, parts = name_words(clock.column)[:-1], list[str]()
    day = clock.form == "iso" and len(texts_of(head.cells(clock.columns[-1]))[0]) == 10
    coarse = day or (clock.form in ("seconds", "minutes", "hours") and not clock.dated)
    for name in head.names:
        *before, last = name_words(name) or [""]
        if before in ([], front) and ((last in _BELOW and name not in whole) or (last in _ABOVE and coarse) or (
                clock.form in ("minutes", "hours") and TIMES.get(last) == "seconds")):  # fmt: skip
            parts += [name] if name not in clock.columns else []
    if not clock.dated and clock.form == "seconds" and plain(clock.column) == "time":
        parts += dates
    if parts:
        above = {"time": ",".join((*parts, clock.column)), "time_format": "%Y%m%d %H%M%S"}
        finer = any(name_words(part)[-1] in _BELOW for part in parts)
        raise _in_parts(head.names) or AskError(
            f"column {clock.column}: expected whole times, received a part beside {', '.join(parts)}: write one "
            "column, or say ", {"time": clock.column}, " if it is whole", *([] if finer else [", or such as ", above])
        )  # fmt: skip


def _in_parts(names: list[str]) -> AskError | None:
    """The error for years, months, days, hours, minutes and seconds in columns of their own."""
    known = dict[tuple[str, ...], dict[str, str]]()
    for name in names:
        *front, last = name_words(name) or [""]
        known.setdefault((*front,), {})[{"min": "minute", "sec": "second"}.get(last, last.removesuffix("s"))] = name
    for one in known.values():
        if {*_PARTS} <= one.keys():
            words = {"time": ",".join(one[part] for part in _PARTS), "time_format": "%Y %m %d %H %M %S"}
            return AskError("expected times in one column, received parts of them: say ", words)
    return None


def _clock(columns: tuple[str, ...], head: Head, form: str, *, sure: bool = False) -> Clock:
    """How columns tell the time.

    Args:
        columns: one, or several that are joined.
        head: of the table.
        form: as ``time_format`` says it, or several with bars between; "" where cells tell.
        sure: whether the caller names the columns.
    """
    name = columns[-1]
    cells = head.cells(name) if len(columns) == 1 else joined(head.cells, columns)
    if isinstance(cells, np.ndarray) and cells.dtype.kind == "M":
        return Clock(columns, Kind(form="iso"), True)
    texts = texts_of(cells)
    if form:
        return _of_form(columns, head, form, texts)
    if (weeks := found(head.names, "week")) and plain(name) in ("tow", "itow", "timeofweek", "sow") and not sure:
        form = "gps_ms" if _unit(name) == "ms" else "gps"
        if (values_of(texts) > WEEK * WEEKS[form]).any():
            raise AskError(f"column {name}: expected seconds of a week, received {texts[0]}: write seconds, or say ",
                           {"time": f"{weeks[0]},{name}", "time_format": "gps_ms"}, " if they are ms")  # fmt: skip
        return _text((weeks[0], name), form, texts)
    values = values_of(texts)
    rates = [rate for column in found(head.names, "rate") for rate in texts_of(head.cells(column))[:1]]
    counts = bool(rates and len(values)) and not (_unit(name) or _size(values) or (values % 1).any())
    if plain(name) in _FRAMES or counts:
        raise AskError(f"column {name}: expected times, received numbers of frames: say how many a second has: ",
                       {"time_format": f"{(rates or ['25'])[0]}fps"})  # fmt: skip
    if 2 * len(values) >= len(texts) and len(columns) == 1:  # what is none is refused by its row
        return _numeric(name, values, sure)
    forms = forms_of(texts) or forms_of(texts[:1])
    if forms and is_clock(forms[0]) and not sure:
        alike = ["date" if word == "time" else word for word in name_words(name)]
        dates = [date for date in found(head.names, "date") if date not in columns]
        for date in sorted(dates, key=lambda date: name_words(date) != alike):  # that of the same clock first
            return _chosen((date, *columns), texts_of(joined(head.cells, (date, *columns))))
    return _chosen(columns, texts)


def _chosen(columns: tuple[str, ...], texts: list[str]) -> Clock:
    """The clock of texts that are written in one form.

    Raises:
        ValueError: in none that is known, in several, or in a zone that the name of the column says.
    """
    name, forms = ",".join(columns), forms_of(texts) or forms_of(texts[:1])
    choices = [part for form in forms for part in (" or ", {"time_format": form})][1:]
    if len(forms) > 1:
        raise AskError(f"column {name}: {texts[0]!r} may have the day or the month first: say ", *choices)
    if not forms:
        other = next(text for text in texts if not forms_of([text]))
        raise AskError(f"column {name}: expected times such as 2024-05-06 10:31:05, received {short(other)}: say how "
                       "they are written, such as ", {"time": name, "time_format": "%d.%m.%y %H:%M:%S"},
                       ", or name another column")  # fmt: skip
    if zone := re.search(r"[\[(]([A-Z]{2,4}T|MSK)[\])]", columns[-1]):
        raise AskError(f"column {name}: zone {zone[1]} has several meanings, changes with the season or is not UTC: "
                       "write an offset such as -06:00 behind each time, or use ", *choices,
                       ", which reads the times as UTC")  # fmt: skip
    return _text(columns, forms[0], texts)


def _text(columns: tuple[str, ...], form: str, texts: list[str]) -> Clock:
    """The clock of texts in a form."""
    said = "ms since 1970 or ISO text" if form == "iso" else f"a time such as {texts[0][:40] if texts else form}"
    kind = Kind(said, limit=math.inf, form=form, joined=columns if len(columns) > 1 else ())
    return Clock(columns, kind, not is_clock(form))


def _of_form(columns: tuple[str, ...], head: Head, form: str, texts: list[str]) -> Clock:
    """The clock of a form that is said; with the column of the date or the week, where both are needed."""
    forms, values = form.split("|"), values_of(texts)
    for one in forms:
        if count_of(one):
            since_1970 = one in SINCE_1970 and len(values) > 0 and _size(values) == one
            middle = np.median(counted(values, one)) if len(values) else 0.0
            if len(columns) == 1 and (
                one == form or (2 * len(values) >= len(texts) and YEAR_1980 < middle < _YEAR_2036)
            ):
                return Clock(columns, _count(one, since_1970), since_1970 or one in STARTS)
            continue
        for front in ((), *((date,) for date in found(head.names, "week" if one in WEEKS else "date"))):
            whole = (*front, *columns) if not {*front} & {*columns} else columns
            cells = texts_of(head.cells(whole[0]) if len(whole) == 1 else joined(head.cells, whole))
            try:
                seconds_of(cells[0], one)
            except (ValueError, IndexError):
                continue
            return _text(whole, one, cells)
    return _text(columns, forms[-1], texts)  # which names the first cell of another form


def _unit(name: str) -> str:
    """The unit of times that a name states."""
    return "ms" if plain(name) in ("itow", "ms", "millis") else TIMES.get(unit(name), "")


def _size(values: Array) -> str:
    """The unit of counts since 1970, by their size; "" of other counts."""
    middle = np.median(values)
    form = next((form for form in SINCE_1970 if YEAR_1980 <= middle / UNITS[form] < _YEAR_2286), "")
    early = np.abs(values) < YEAR_1980 * UNITS.get(form, 1.0)  # of a clock that was not set yet
    return form if not early[0] or early.mean() < _FEW else ""


def _count(form: str, since_1970: bool) -> Kind:
    """The kind of counts."""
    per, _ = count_of(form) or (1.0, 0.0)
    if form == "seconds":
        advice = ", which is too large for seconds: milliseconds must be divided by 1000"
        return Kind("a number", limit=_YEAR_2286, advice=advice, form=form)
    said = {"us": "microseconds", "ns": "nanoseconds"}.get(form, "a number")
    said = "ms since 1970 or ISO text" if form == "ms" and since_1970 else said
    between = (YEAR_1980, _YEAR_2286 * per / 1e3) if since_1970 else (math.inf, math.inf)
    return Kind(said, limit=_YEAR_2286 * per, between=between, advice="; all times must be in one unit", form=form)


def _numeric(name: str, values: Array, sure: bool) -> Clock:
    """The clock of numbers: by the end of the name, or by their size since 1970; or else seconds since a start."""
    size, stated = _size(values) if len(values) else "", _unit(name)
    if size and (name_words(name)[0] == "gps" or {"gps", "epoch"} <= {*name_words(name)}):
        write = "write seconds and say " * (size != "seconds")
        raise AskError(f"column {name}: expected {size} since 1970 or, with leap seconds, since 1980, received "
                       f"{values[0]:.15g}, which may be either: say ", {"time_format": size}, f" or {write}",
                       {"time_format": "gps_seconds"})  # fmt: skip
    if size and (not stated or stated == size):
        return Clock((name,), _count(size, True), True)
    if stated:
        return Clock((name,), _count(stated, False), False)
    bracketed = in_brackets(name)
    cause = (
        f"looks like a clock in one number ({packed})" if (packed := _packed(values))
        else "is no time since 1970" if plain(name) in _DATED and not sure and len(values) > 1
        else f"is in ({bracketed})" if bracketed and not {*name_words(bracketed)} <= _NO_UNITS and not sure
        else "is another unit, or a date or a clock in one number" if len(values) and np.median(values) > _LATEST
        else ""
    )  # fmt: skip
    if cause:
        middle = float(np.median(values))
        likely = [packed] if packed else ["excel"] if 3e4 < middle < 6e4 else ["seconds", "ms", "%H%M%S%f", "100fps"]
        asks: list[Any] = [part for form in likely for part in (" or ", {"time": name, "time_format": form})][1:]
        raise AskError(f"column {name}: expected seconds since a start or since 1970, received {values[0]:.15g}, "
                       f"which {cause}: say ", *asks, ", or name another column")  # fmt: skip
    return Clock((name,), _count("seconds", False), False)


def _packed(values: Array) -> str:
    """The form of numbers whose digits are a clock, which counts of seconds would leave at 60; "" of others."""
    moments = np.unique(values)
    for parts, form in ((1.0, "%H%M%S"), (1e3, "%H%M%S%f"), (1e2, "%H%M%S%f"), (1e-2, "%H%M")):
        digits = moments / parts
        if len(moments) < 20 or digits[0] < 0 or digits[-1] >= 240_000 or digits[-1] // 100 == digits[0] // 100:
            continue
        minutes, seconds = digits // 100 % 100, digits % 100
        if (minutes < 60).all() and (seconds < 60).all():
            clock = np.diff(3600 * (digits // 10_000) + 60 * minutes + seconds)
            if np.ptp(clock) < 0.5 * np.ptp(np.diff(digits)):
                return form
    return ""
