"""Which column tells the time, and how."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from torchfra.readers.columns import Array, Head, Kind, joined, short, texts_of, values_of
from torchfra.readers.formats import Format
from torchfra.readers.names import TIMES, found, in_brackets, name_words, plain, unit
from torchfra.readers.options import AskError, ReadOptions
from torchfra.readers.times import (
    CLOCK,
    SINCE_1970,
    SPLIT,
    STARTS,
    STOPWATCH,
    UNITS,
    WEEKS,
    count_of,
    counted,
    forms_of,
    is_clock,
    iso_written,
    per_second,
    seconds_of,
)

YEAR_1980 = 315_532_800.0
"""Seconds since 1970; nothing was recorded before."""
_YEAR_2036, _YEAR_2286 = 2.1e9, 1e10
_LATEST = 1e7
"""Seconds since a start that a recording may have, 115 days; more without a unit are another unit, or no count."""
_DAY, _AWAY = 86_400.0, 3600.0
"""Seconds; and those for which rows may lack about midnight."""
_DATED = {"timestamp", "utc", "timeutc", "utctime", "unixtime", "unix", "epoch", "unixtimestamp", "timestamputc",
          "date", "day"}  # fmt: skip
"""Names of times that are a date too."""
_PARTS = {"date": "%Y-%m-%d", "year": "%Y", "month": "%m", "day": "%d", "hour": "%H", "minute": "%M", "min": "%M",
          "second": "%S", "seconds": "%S", "sec": "%S"}  # fmt: skip
_FEW, _FINER = 0.1, 2
"""Share of the times of a clock that may not have been set yet; how many times as many moments a
column of times has to have, to be taken although another has the date."""
_PARTS_OF_SECONDS = {"msec": "ms", "msecs": "ms", "usec": "us", "usecs": "us", "nsec": "ns", "nsecs": "ns",
                     "nanosec": "ns", "nanosecs": "ns", "nanoseconds": "ns", "nanos": "ns", "micros": "us"}  # fmt: skip
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
    form: str
    """How it is written: ``Source.time``."""
    dated: bool
    """Whether it tells the date too."""
    sure: bool = True
    """Whether the order of day and month is stated, or the same in all forms."""

    @property
    def is_local(self) -> bool:
        """Whether it may be put forward and back with the seasons: text that names no zone."""
        zone = any({"utc", "gmt", "zulu"} & {*name_words(column)} for column in self.columns)
        return "%" in self.form and not zone and not self.form.endswith(("Z", "UTC", "GMT", "%z"))

    @property
    def said(self) -> str:
        """A word or two for a person."""
        form = self.form
        if self.kind.form == "iso":
            return "ISO text"
        if per_second(form) and form not in UNITS:
            return f"frames, {per_second(form):g} a second"
        since = " since 1970" if self.dated and form in (*UNITS, *SPLIT) else ""
        return "times of the day" if is_clock(form) else form + since

    @property
    def column(self) -> str:
        """What the times are called in a table."""
        return " ".join(self.columns)

    def whole(self, time: Array) -> Array:
        """Times ``(rows,)``; those of a clock go on after midnight.

        Raises:
            ValueError: they are of years before 1980, or of a clock of 12 hours that does not say which half.
        """
        rows = np.flatnonzero(np.isfinite(time))
        if is_clock(self.form):
            steps = np.diff(time[rows], prepend=time[rows[:1]])
            hours = time[rows] // 3600
            if self.form == CLOCK and (steps <= _AWAY - _DAY / 2).any() and hours.min() == 1 and hours.max() == 12:
                raise ValueError(
                    f"column {self.column}: expected times of 24 hours, received 01 behind 12, as a clock of 12 hours "
                    "has it: add AM or PM, or a date"
                )
            time[rows] += _DAY * np.cumsum(steps < -_DAY / 2)
        elif self.dated and len(rows) and np.median(time[rows]) < YEAR_1980:
            raise AskError(
                f"column {self.column}: expected years from 1980 on, received earlier ones, which look like times "
                "since "
                "a start: name another column, or their unit, such as ", {"time_format": "seconds"},
            )  # fmt: skip
        return time

    def going_on(self, time: Array) -> Array:
        """Times ``(rows,)`` of a target; counts of the day or of the week go on where they begin anew."""
        steps = np.diff(time, prepend=time[:1])
        if self.dated or not per_second(self.form) or not ((steps < 0).any() and (steps > 0).any()):
            return time
        usual, ahead = np.median(np.abs(steps[steps != 0])), np.zeros(len(time))
        for whole in (_DAY, 7 * _DAY, 2**32 / per_second(self.form)):  # the last is that of a counter of 32 bits
            if time.max() <= whole:
                away = max(min(_AWAY, whole / 24), 3 * usual)
                begun = (steps < -whole / 2) & (np.abs(-steps - whole + usual) <= away)
                ahead[begun] = whole
        return np.asarray(time + np.cumsum(ahead))


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
    names = {plain(name): name for name in head.names}
    parts = [
        one for one in _PARTS if one in names and not any(":" in text for text in texts_of(head.cells(names[one])))
    ]
    candidates, clocks, refusals = found(head.names, "time"), list[Clock](), dict[str, ValueError]()
    apart = len(parts) > 2 or all(plain(one) in _PARTS for one in candidates)
    if {*parts} & {"hour", "minute", "min"} and len(parts) > 1 and apart:
        whole = {
            "time": ",".join(names[part] for part in parts),
            "time_format": " ".join(map(_PARTS.__getitem__, parts)),
        }
        raise AskError("times are in several columns: join them by ", whole)
    for name, other in permutations(candidates, 2):
        words = name_words(name)[:-1], _unit(name), name_words(other)[:-1], _unit(other)
        of_hour, of_minute = (values_of(head.cells(one)) for one in (other, name))
        if words == (words[2], "seconds", words[0], "minutes") and of_minute.max(initial=0.0) < 60 and (
                len({*of_hour}) > 1 and not (of_hour % 1).any()):  # fmt: skip
            raise AskError(f"column {name}: expected seconds since a start, received those of the minutes in {other}: "
                           "join them by ", {"time": f"{other},{name}", "time_format": "%M %S"})  # fmt: skip
    for name in candidates:
        try:
            clocks.append(_clock((name,), head, form))
        except ValueError as error:
            refusals[name] = error
    if not clocks:
        raise next(iter(refusals.values())) if refusals else LookupError("time")
    best = min(clocks, key=lambda clock: (not clock.dated, count_of(clock.form) is not None,
                                          bool(_LOCAL & {*name_words(clock.columns[-1])})))  # fmt: skip
    if refusals and not best.dated and candidates[0] in refusals:
        raise refusals[candidates[0]]
    days = [one for one in found(head.names, "date") if {len(text) for text in texts_of(head.cells(one))} <= {6, 8}
            and len(values_of(head.cells(one)))]  # fmt: skip
    if days and best.form == "seconds" and not best.dated and not form and plain(best.column) == "time":
        both = {"time": f"{days[0]},{best.column}", "time_format": "%d%m%Y %H%M"}
        raise AskError(f"column {best.column}: expected times, received numbers beside {days[0]}, whose digits are a "
                       "date, that may be a clock: say ", both, ", or ", {"time_format": "seconds"})  # fmt: skip
    moments = {clock: len({str(cell) for name in clock.columns for cell in head.cells(name)}) for clock in clocks}
    finest = max(clocks, key=lambda clock: moments[clock])
    if moments[finest] > _FINER * moments[best]:
        best = finest  # such as ms since a start beside a date of whole seconds: fixes of one moment would be lost
    return best, [name for name in candidates if name not in best.columns]


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
        return Clock(columns, Kind(form="iso"), "iso", True)
    texts = texts_of(cells)
    if form:
        return _of_form(columns, head, form, texts)
    weeks = found(head.names, "week") if plain(name) in ("tow", "itow", "timeofweek", "sow") and not sure else []
    if weeks:
        return _text((weeks[0], name), "gps_ms" if _unit(name) == "ms" else "gps", texts)
    values = values_of(texts)
    rates = [rate for column in found(head.names, "rate") for rate in texts_of(head.cells(column))[:1]]
    counts = bool(rates and len(values)) and not (_unit(name) or _size(values) or (values % 1).any())
    if plain(name) in _FRAMES or counts:
        raise AskError(f"column {name}: expected times, received numbers of frames: say how many a second has: ",
                       {"time_format": f"{(rates or ['25'])[0]}fps"})  # fmt: skip
    *front, last = name_words(name) or [""]
    for other in head.names if last in ("s", "sec", "secs", "second", "seconds") and len(columns) == 1 else ():
        *before, part = name_words(other) or [""]
        if front == before and part in _PARTS_OF_SECONDS:
            dated = bool(len(values) and values[0] >= YEAR_1980)
            return _text((name, other), f"s {_PARTS_OF_SECONDS[part]}", texts, dated=dated)
    if 2 * len(values) >= len(texts) and len(columns) == 1:  # what is none is refused by its row
        return _numeric(name, values, sure)
    forms = forms_of(texts) or forms_of(texts[:1])
    if forms and is_clock(forms[0]):
        alike = ["date" if word == "time" else word for word in name_words(name)]
        dates = [date for date in found(head.names, "date") if date not in columns] if not sure else []
        dates.sort(key=lambda date: name_words(date) != alike)  # that of the same clock first
        for date in dates:
            both = texts_of(joined(head.cells, (date, *columns)))
            if ways := forms_of(both):
                return _chosen((date, *columns), ways, both, name)
            raise AskError(f"column {date}: expected dates such as 2024-05-06, received "
                           f"{texts_of(head.cells(date))[:1]} "
                           "beside times of the day: say how both are written, such as ",
                           {"time": f"{date},{name}", "time_format": "%d%m%y %H:%M:%S"})  # fmt: skip
    return _chosen(columns, forms, texts, name)


def _chosen(columns: tuple[str, ...], forms: list[str], texts: list[str], name: str) -> Clock:
    """The clock of texts that are written in one of some forms.

    Raises:
        ValueError: in none of them, in several, or in a zone that is not known.
    """
    if not forms:
        other = next((text for text in texts if not forms_of([text])), texts[0])
        form = STOPWATCH if re.fullmatch("[0-9]{1,2}:[0-9]{2}[.,][0-9]+", other) else "%d.%m.%Y %H:%M:%S"
        raise AskError(f"column {name}: expected times, received {short(other)}: say how they are written, such as ",
                       {"time_format": form}, ", or name another column")  # fmt: skip
    if len(forms) > 1:
        choices = [part for form in forms for part in (" or ", {"time_format": form})]
        raise AskError(f"column {name}: {texts[0]!r} may have the day, the month or the year first: say ", *choices[1:])
    if forms[0] == "%H:%M":
        raise AskError(f"column {name}: {texts[0]!r} may be hours and minutes, or minutes and seconds: say ",
                       {"time_format": "%H:%M"}, " or ", {"time_format": STOPWATCH})  # fmt: skip
    above = re.search(r"[\[(](?:[A-Z]{2,4}T|MSK)[\])]", name)  # such as (JST) behind the name
    zone = above[0][1:-1] if above else forms[0].rpartition(" ")[2]
    if zone.isalpha() and zone.isupper() and zone not in ("Z", "UTC", "GMT"):
        raise AskError(f"column {name}: zone {zone} of {texts[0]!r} has several meanings or changes with the season: "
                       "write "
                       "an offset such as -06:00 instead, or use ", {"time_format": forms[0]},
                       ", which reads the times as UTC")  # fmt: skip
    return replace(_text(columns, forms[0], texts), sure=not re.match("%[dm][-/]%[dm]", forms[0]))


def _text(columns: tuple[str, ...], form: str, texts: list[str], *, dated: bool = True) -> Clock:
    """The clock of texts in a form."""
    said = "ms since 1970 or ISO text" if form == "iso" else f"a time such as {texts[0][:40] if texts else form}"
    kind = Kind(said, limit=math.inf, form=form, joined=columns if len(columns) > 1 else ())
    return Clock(columns, kind, iso_written(texts[0]) if form == "iso" and texts else "iso" if "%z" in form else form,
                 dated and not is_clock(form))  # fmt: skip


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
                return Clock(columns, _count(one, since_1970), one, since_1970 or one in STARTS)
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
    said = {"us": "microseconds", "ns": "nanoseconds"}.get(form, "a number")
    if form == "seconds":
        said, advice = "a number", ", which is too large for seconds: milliseconds must be divided by 1000"
        return Kind(said, limit=_YEAR_2286, advice=advice, form=form)
    if form == "ms" and since_1970:
        said = "ms since 1970 or ISO text"
    advice = "; all times must be in one unit"
    between = (YEAR_1980, _YEAR_2286 * per / 1e3) if since_1970 else (math.inf, math.inf)
    return Kind(said, limit=_YEAR_2286 * per, between=between, advice=advice, form=form)


def _numeric(name: str, values: Array, sure: bool) -> Clock:
    """The clock of numbers: by the end of the name, or by their size since 1970; or else seconds since a start."""
    size, stated = _size(values) if len(values) else "", _unit(name)
    if size == "seconds" and name_words(name)[0] == "gps":
        raise AskError(f"column {name}: expected seconds since 1970 or, with leap seconds, since 1980, received "
                       f"{values[0]:.15g}, which may be either: say ", {"time_format": "seconds"}, " or ",
                       {"time_format": "gps_seconds"})  # fmt: skip
    if size and (not stated or stated == size):
        return Clock((name,), _count(size, True), size, True)
    if stated:
        return Clock((name,), _count(stated, False), stated, False)
    middle = float(np.median(values)) if len(values) else 0.0
    likely = ("excel",) if 3e4 < middle < 6e4 else ("days",) if plain(name) == "day" else ("seconds", "ms", "us")
    asks = ({"time": name, "time_format": form} for form in likely)
    choices = [part for ask in asks for part in (" or ", ask)][1:]
    if packed := _packed(values):
        hours = (" or ", {"time": name, "time_format": "%H%M"}) if "S" in packed and values.max() < 2400 else ()
        raise AskError(f"column {name}: expected times, received {values[0]:.15g}, which looks like hours, minutes and "
                       "seconds in one number: say ", {"time": name, "time_format": packed}, *hours)  # fmt: skip
    if plain(name) in _DATED and not sure and len(values) > 1:
        raise AskError(f"column {name}: expected times since 1970, received {values.min():.15g} to "
                       f"{values.max():.15g}: "
                       "name another column, or say their unit: ", *choices)  # fmt: skip
    if (said := in_brackets(name)) and not {*name_words(said)} <= _NO_UNITS and not sure:
        raise AskError(f"column {name}: expected seconds or another unit of times, received ({said}): say ",
                       *choices, ", or such as ", {"time_format": "100fps"}, " where 100 are a second")  # fmt: skip
    if middle > _LATEST:
        raise AskError(f"column {name}: expected seconds since a start or since 1970, received {values[0]:.15g}, "
                       "which is "
                       "another unit, or no count but a date or a clock in one number: say ", *choices, " or ",
                       {"time_format": "%H%M%S"}, ", or name another column")  # fmt: skip
    return Clock((name,), _count("seconds", False), "seconds", False)


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
