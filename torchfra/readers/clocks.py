"""Which column tells the time, and how."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchfra.readers.columns import INSTANT, SECONDS, Head, Kind, is_missing, joined, number, short
from torchfra.readers.options import ReadOptions
from torchfra.readers.packed import packed
from torchfra.readers.sheets import listed
from torchfra.readers.spelling import APPLE, OTHER_ZONES, PARTS, found, name_words, plain, unit
from torchfra.readers.spelling import SINCE_1970 as DATED
from torchfra.readers.times import (
    CLOCK,
    DAY_OF_1970,
    GPS,
    NEARER,
    OF_THE_YEAR,
    PER_SECOND,
    SINCE_1970,
    SINCE_OTHERS,
    SPLIT,
    form_of,
    is_clock,
    per_second,
    seconds_of,
    states_zone,
    written,
)

YEAR_1980 = 315_532_800.0
"""Seconds since 1970; nothing was recorded before."""
_YEAR_2001, _YEAR_2286 = 978_307_200.0, 1e10
_YEAR_2037 = 1.5e9
"""Seconds of FIT; since 1970 they are of 2017."""
_OF_FIT = ["record", "timestamp"]
"""Words of the name that times of FIT have as CSV."""
_DAY = 86_400.0
_COUNTER, _LATE = 2.0**32, 3.0
"""Units that 32 bits count, and how many usual steps the first time after that may be late."""
_AWAY = 3600.0
"""Seconds for which rows may lack about midnight."""
_FEW = 0.1
"""Share of the times of a clock that may not have been set yet."""
_FINER = 2
"""How many times as many moments a column of times has to have, to be taken although another has the date."""
_SAID = {"us": "microseconds", "ns": "nanoseconds"}
_DAYS_SAID = {"excel": "days of Excel", "mjd": "modified Julian days", "matlab": "days of Matlab",
              "jd": "Julian days"}  # fmt: skip
_SECONDS_SAID = {"apple": "seconds since 2001, as Apple counts", "fit": "seconds since 1989-12-31, as FIT counts",
                 "gps_seconds": "seconds of GPS since 1980"}  # fmt: skip
_OF_A_PHONE = {"horizontalaccuracy", "verticalaccuracy"}
"""Plain names of columns in what Apple's phones say of where they are."""
_OF_THE_DAY = {"sod", "secondsofday", "secondofday", "secofday", "secsofday"}
_DAYS_OF_YEARS = {"doy", "dayofyear", "yday", "jday", "julianday", "yearday"}
_YEARS = {"year", "yyyy", "yr"}
_MINUTE = re.compile(r"[0-9]{1,2}:[0-9]{2}(?: ?[AaPp][Mm])?")
"""Hours and minutes."""
_OF_A_SECOND = re.compile(r"(?:hundred|thousand|ten)ths?|1/10+|centi-?sec|milli-?sec|millis|^ms$|^cs$", re.IGNORECASE)
"""In the name of what of a second has passed."""
_HALF_DAY = 43_200.0
_OF_THE_WEEK = {"tow", "itow", "timeofweek", "sow", "secondsofweek"}
"""Names of what of the week of GPS has passed."""
_OFFSETS = {"utcoffset", "utcofst", "gmtoffset", "timezoneoffset", "tzoffset"}
"""Names of how far local times are ahead of UTC."""
_OFFSET = re.compile("[+-][0-9]{2}(?::?[0-9]{2})?")
_UTC = re.compile("utc|gmt|zulu", re.IGNORECASE)
"""In the name of a column of times."""
_SECONDS = {"s", "sec", "secs", "second", "seconds"}
_PARTS_OF_SECONDS = {
    "ms": "ms", "msec": "ms", "msecs": "ms", "millisec": "ms",
    "us": "us", "usec": "us", "usecs": "us", "microsec": "us",
    "ns": "ns", "nsec": "ns", "nsecs": "ns", "nanosec": "ns", "nanosecs": "ns", "nanoseconds": "ns",
}  # fmt: skip
"""Last words of names of columns with whole seconds, and with parts of one."""
_OF_PX4 = "timestampsample"
"""Plain name of a column beside which timestamps are microseconds since the start of an autopilot."""
FRAMES = {"frame", "frameid", "frames", "framenumber", "frameidx", "frameindex", "frameno", "coords", "timestep"}
"""Names of numbers of frames, which tell the time by how many a second has; the last is DeepLabCut's."""


@dataclass(frozen=True)
class Clock:
    """How a column tells the time."""

    columns: tuple[str, ...]
    """One column, or two: the date and the time of the day; three with the year of a day of the year, or an offset."""
    kind: Kind
    form: str
    """How it is written: ``Source.time``."""
    since_1970: bool
    """Whether it tells the date too."""
    stated: bool = False
    """Whether the caller says how it is written."""

    @property
    def said(self) -> str:
        """A word or two for a person."""
        if per_second(self.form):
            return _unit_said(self.form) + (" since 1970" if self.since_1970 else "")
        if self.form in GPS:
            return f"week of GPS and {'ms' if self.form == 'gps_ms' else 'seconds'} of it"
        if self.form in DAY_OF_1970:
            return _DAYS_SAID[self.form]
        if self.form in SINCE_OTHERS:
            return _SECONDS_SAID[self.form]
        if self.form in OF_THE_YEAR:
            return f"{'year, ' if self.since_1970 else ''}day of the year and second of the day"
        if self.form in SPLIT:
            return f"seconds{' since 1970' if self.since_1970 else ''} and {_unit_said(self.form.split()[1])}"
        form = "ISO text" if self.kind.form == "iso" else "times of the day" if is_clock(self.form) else self.form
        return form + (", taken as UTC" if {*name_words(self.columns[-1])[-1:]} & OTHER_ZONES else "")

    @property
    def is_local(self) -> bool:
        """Whether it may be put forward and back with the seasons: text that names no zone."""
        utc = any(_UTC.search(column) for column in self.columns) or states_zone(self.form)
        return "%" in self.form and not utc

    @property
    def roles(self) -> dict[str, str]:
        """The columns by what they hold."""
        offset = plain(self.columns[-1]) in _OFFSETS
        roles = ("year", "date", "time", "offset") if offset else ("year", "date", "time")
        return dict(zip(roles[-len(self.columns) :], self.columns, strict=True))

    @property
    def column(self) -> str:
        """What the times are called in a table."""
        return " ".join(self.columns)

    def whole(self, time: NDArray[np.float64]) -> NDArray[np.float64]:
        """Times ``(rows,)``; those of a clock go on after midnight.

        Raises:
            ValueError: they are of years before 1980, or of a clock of 12 hours that does not say which half.
        """
        if is_clock(self.form):
            rows = np.flatnonzero(np.isfinite(time))
            steps = np.diff(time[rows], prepend=time[rows[:1]])
            self._check_halves(time[rows], steps)
            midnights = np.cumsum(steps < -_DAY / 2)
            time[rows] += _DAY * midnights
        elif self.since_1970 and len(known := time[np.isfinite(time)]) and np.median(known) < YEAR_1980:
            row = int(np.isfinite(time).argmax())
            (early,) = written(time[row : row + 1], "iso")
            raise ValueError(
                f"expected years from 1980 on in row {row + 1} of {self.column}, received {early}, which looks "
                "like times since a start: name another column by --time, or their unit by --time-format"
            )
        return time

    def check_order(self, time: NDArray[np.float64]) -> None:
        """Refuses times ``(rows,)`` of which some have the day first and others the month, as spreadsheets leave them.

        Those of days after the 12th tell which is first. Where the others stand near them with day and month
        exchanged alone, and times as they are go to and fro, they are in the other order. Behind a year there is one.
        """
        rows = np.flatnonzero(np.isfinite(time))
        if self.stated or not re.search("(?<!%[Yy][-/. ])%[dm][-/. ]%[dm]", self.form):
            return
        days = np.unique(time[rows] // _DAY)
        if self.form.startswith("%d/%m/%y") and np.isin(np.diff(days), (365, 366)).any():
            raise ValueError(
                f"column {self.column}: expected days that go on, received one and the same a year later: the year may "
                f"be first: use --time-format '{self.form.replace('%d/%m/%y', '%y/%m/%d')}'"
            )
        steps = np.diff(time[rows])
        if (steps >= 0).all() or (steps <= 0).all():
            return
        dates = time[rows].astype("datetime64[s]").astype("datetime64[D]")
        months = dates.astype("datetime64[M]")
        day, month = (dates - months).astype(np.int64), months.astype(np.int64) % 12  # from 0 on
        either, sure = (day < 12) & (day != month), day >= 12
        if not sure.any():
            return
        exchanged = (months.astype("datetime64[Y]").astype("datetime64[M]") + day).astype("datetime64[D]") + month
        other = np.where(either, (exchanged - dates).astype(np.int64) * _DAY, 0.0) + time[rows]
        if np.abs(np.diff(other)).sum() < NEARER * np.abs(steps).sum():
            one, last = (written(time[rows[mask]][:1], self.form)[0] for mask in (either, sure))
            raise ValueError(
                f"column {self.column}: expected days and months in one order, received {one} and {last}, which are "
                "near each other in different orders, as spreadsheets leave them: write all such as 2024-05-06 10:31, "
                f"or take them as they are by --time-format '{self.form}'"
            )

    def going_on(self, time: NDArray[np.float64]) -> NDArray[np.float64]:
        """Times ``(rows,)`` of a target; counts go on after midnight, after a week, and past 32 bits.

        Rows near midnight may be out of order, or lack for a while.  If all leaps go on in time, they are pauses.
        """
        steps = np.diff(time, prepend=time[:1])
        if self.since_1970 or not per_second(self.form) or not ((steps < 0).any() and (steps > 0).any()):
            return time
        usual, ahead = np.median(np.abs(steps[steps != 0])), np.zeros(len(time))
        for whole, late in ((_DAY, _AWAY), (7 * _DAY, _AWAY), (_COUNTER / per_second(self.form), 0.0)):
            if time.max() <= whole:  # or else a count from a start, whose rows may be out of order
                begun = (np.abs(steps) > whole / 2) & (
                    np.abs(np.abs(steps) - whole + usual) <= max(late, _LATE * usual)
                )
                leaps = np.sign(steps[begun])
                if (leaps * np.median(steps[steps != 0]) < 0).any():
                    ahead[begun] = -leaps * whole
        return np.asarray(time + np.cumsum(ahead))

    def _check_halves(self, time: NDArray[np.float64], steps: NDArray[np.float64]) -> None:
        """Refuses times of the day that go from 12:59 to 01:00."""
        hours, back = time // 3600, steps <= -_HALF_DAY + 3600
        if self.form == CLOCK and back.any() and hours.min() == 1 and hours.max() == 12:
            at = int(back.argmax())
            before, after = written(time[at - 1 : at + 1], CLOCK)
            raise ValueError(
                f"column {self.column}: expected times of 24 hours, received {after} behind {before}, as a clock of 12 "
                "hours has it: add AM or PM, or a date"
            )

    @property
    def doubt(self) -> tuple[bool, bool]:
        """What to sort by: whether it lacks the date, and whether it is no text."""
        return not self.since_1970, per_second(self.form) > 0


def clock_of(head: Head, options: ReadOptions) -> tuple[Clock, list[str]]:
    """The column of times, and other columns of times, which are not used.

    Args:
        head: of the table.
        options: of the caller.

    Raises:
        LookupError: no column of times.
        ValueError: times that are not understood.
    """
    _check_parts(head, options)
    if options.time is not None:
        return _dated(_clock(options.time, head, options), head, options), []
    candidates, clocks, refusals = found(head.names, "time"), list[Clock](), list[ValueError]()
    for name in candidates:
        try:
            clocks.append(_dated(_clock(name, head, options), head, options))
        except ValueError as error:
            refusals.append(error)
    if not clocks:
        raise refusals[0] if refusals else LookupError("time")
    best = min(clocks, key=lambda clock: (*clock.doubt, bool({*name_words(clock.columns[-1])} & OTHER_ZONES)))
    _check_rest(best, head)
    column = best.columns[0]
    no_seconds = column in found(head.names, "date") or not len(_values(head.cells(column)))
    if refusals and best.form == "seconds" and no_seconds:
        raise refusals[0]
    moments = {clock: len({str(cell) for name in clock.columns for cell in head.cells(name)}) for clock in clocks}
    finest = max(clocks, key=lambda clock: moments[clock])
    if moments[finest] > _FINER * moments[best]:
        best = finest  # such as ms since a start beside a date of whole seconds: fixes of one moment would be lost
    return best, [name for name in candidates if name not in best.columns]


def _check_parts(head: Head, options: ReadOptions) -> None:
    """Refuses times in several columns: years, months and others, or hours, minutes and seconds."""
    parts = [name for name in head.names if "".join(plain(name).split("utc")) in PARTS]
    smaller = {plain(name).removeprefix("utc").rstrip("s") for name in parts} & {"minute", "min", "hour"}
    others = [name for name in found(head.names, "time") if name not in parts and name not in found(head.names, "date")]
    if options.time is None and len(parts) > 1 and smaller and not others:
        raise ValueError(
            f"expected whole times in one column, received parts in {listed(parts)}: join them, such as to "
            "2024-05-06 10:31:00 or to 10:31:00"
        )


def _check_rest(clock: Clock, head: Head) -> None:
    """Refuses times in whole seconds beside a column with hundredths of one, say."""
    times = [*filter(None, joined(head.cells, clock.columns))]
    for name in head.names if clock.since_1970 and len({*times}) < len(times) else []:
        rest = _values(head.cells(name)) if _OF_A_SECOND.search(name) and name not in clock.columns else np.empty(0)
        if len(rest) and (rest % 1 == 0).all() and 0 <= rest.min() < rest.max() < 1000:
            raise ValueError(
                f"expected whole times in one column, received parts of a second in {name} beside {clock.column}: join "
                f"them, such as to 2024-05-06 10:31:00.25; or --time {clock.columns[-1]} takes whole seconds"
            )


def _clock(name: str, head: Head, options: ReadOptions) -> Clock:
    """How a column tells the time."""
    column = head.cells(name)
    if isinstance(column, np.ndarray) and column.dtype.kind == "M":
        return Clock((name,), INSTANT, "iso", True)
    some = [cell for cell in column if isinstance(cell, str | int | float | np.generic) and cell == cell]
    some = [cell for cell in some if not isinstance(cell, str) or not is_missing(cell)]
    if options.time_format is not None:
        return replace(_clock_of_form(name, options.time_format, head), stated=True)
    if options.time is None and plain(name) in _OF_THE_WEEK and (weeks := found(head.names, "week")):
        return _gps_clock(weeks[0], name, "gps_ms" if unit(name) == "ms" else "gps")
    if plain(name) in _OF_THE_DAY and (days := [day for day in head.names if plain(day) in _DAYS_OF_YEARS]):
        columns = (*[year for year in head.names if plain(year) in _YEARS][:1], days[0], name)
        form = OF_THE_YEAR[3 - len(columns)]
        return Clock(columns, replace(_text_kind(form, "2024 60 3600"), joined=columns), form, len(columns) > 2)
    if _OF_PX4 in map(plain, head.names) and plain(name) == "timestamp" and options.time is None:
        return Clock((name,), _unit_kind("us", False), "us", False)
    if plain(name) in FRAMES:
        raise ValueError(
            f"column {name}: expected times, received numbers of frames: say how many a second has, such as "
            "--time-format 25fps"
        )
    if (split := _split_clock(name, head)) is not None:
        return split
    values = _values(some)
    if other := _counted_since_another(values, name, head):
        return _clock_of_form(name, other, head)
    if len(values) < len(some) and (clock := _text_clock((name,), some, head)) is not None:
        return clock
    minutes = len(some) and all(isinstance(cell, str) and _MINUTE.fullmatch(cell.strip()) for cell in some)
    for date in _dates(name, head) if minutes else []:
        together = [*filter(None, joined(head.cells, (date, name)))]
        if date == name or (clock := _text_clock((date, name), together, head)) is None:
            continue
        if len({*map(str, head.cells(date))}) == 1 and not clock.form.endswith("%p"):
            raise ValueError(
                f"column {name}: {some[0]!r} may be hours and minutes, or minutes and seconds: --time-format "
                f"'{clock.form}' reads the former; or write 10:31:00"
            )
        return clock
    if len(some) and not len(values) and plain(name) in DATED:
        return Clock((name,), INSTANT, "iso", True)  # which names the cell that is no time, as a number does
    if len(some) and not len(values):
        row = list(column).index(some[0]) + 1
        raise ValueError(
            f"expected times in data row {row}, column {name}, received {short(some[0])}: say how they are written by "
            "--time-format, such as '%d.%m.%Y %H:%M:%S', or name another column by --time"
        )
    dates = [_values(head.cells(date)) for date in found(head.names, "date") if date != name]
    if said := packed(values, dates):
        raise ValueError(f"column {name}: expected times, received {values[0]:.15g}, which looks like {said}")
    return _numeric(name, values, options)


def _text_clock(columns: tuple[str, ...], some: Sequence[Any], head: Head) -> Clock | None:
    """How texts tell the time; None where they do not.  Where they leave open which is the day, further rows tell."""
    texts = [cell for cell in some if isinstance(cell, str)]

    def form_of_these(lines: Iterable[str]) -> tuple[str, str] | None:
        return form_of([*texts, *lines], day_first=_is_danish(head))

    try:
        form = form_of_these(())
    except ValueError:
        days = {line.partition(" ")[0]: line for line in joined(head.further or head.cells, columns) if line}
        try:
            form = form_of_these(days.values())
        except ValueError as error:
            raise ValueError(f"column {columns[-1]}: {error}") from None
    if form is None:
        return None
    read, write = form
    if read == "iso":
        return Clock(columns, replace(INSTANT, joined=columns[:-1] and columns), write, True)
    kind = replace(_text_kind(read, str(some[0])), joined=columns[:-1] and columns)
    return Clock(columns, kind, write, not is_clock(read))


def _text_kind(form: str, example: str) -> Kind:
    return Kind(f"a time such as {example.strip()[:40]}", limit=math.inf, per_unit=1e3, form=form)


def _clock_of_form(name: str, form: str, head: Head) -> Clock:
    """A column in a form that is named; with the one of the date before it, where only both are of this form."""
    if per_second(form):
        return Clock((name,), _unit_kind(form, False), form, False)
    if form in DAY_OF_1970:
        said = _DAYS_SAID[form]
        return Clock((name,), Kind(said, limit=1e7, unit=_DAY, zero=DAY_OF_1970[form]), form, True)
    if form in SINCE_OTHERS:
        return Clock((name,), _text_kind(form, "800000000.0"), form, True)
    if form in GPS:
        if not (weeks := found(head.names, "week")):
            raise ValueError(
                f"time_format: expected a column of weeks, such as gps_week, beside {name} for {form}, received "
                f"{listed(head.names)}: without weeks {'ms' if form == 'gps_ms' else 'seconds'} reads it"
            )
        return _gps_clock(weeks[0], name, form)
    kind = INSTANT if form == "iso" else _text_kind(form, form)
    for columns in ((name,), *((date, name) for date in _dates(name, head) if date != name)):
        with suppress(ValueError, StopIteration):
            seconds_of(next(filter(None, joined(head.cells, columns))), form)
            return Clock(columns, replace(kind, joined=columns[:-1] and columns), form, not is_clock(form))
    return Clock((name,), kind, form, not is_clock(form))


def _gps_clock(week: str, name: str, form: str) -> Clock:
    """A column of weeks of GPS, and one of what of a week has passed."""
    return Clock((week, name), replace(_text_kind(form, "2300 345600.0"), joined=(week, name)), form, True)


def _split_clock(name: str, head: Head) -> Clock | None:
    """A column of whole seconds and one of what of a second has passed, as robots write them; None of other columns."""
    *first, last = name_words(name) or [""]
    if last not in _SECONDS:
        return None
    for other in head.names:
        *front, part = name_words(other) or [""]
        unit = _PARTS_OF_SECONDS.get(part)
        if front != first or unit is None:
            continue
        whole, rest = (_values(head.cells(column)) for column in (name, other))
        if len(rest) == len(whole) and (whole % 1 == 0).all() and ((rest >= 0) & (rest < SINCE_1970[unit])).all():
            form, since_1970 = f"s {unit}", bool(len(whole) and whole[0] >= YEAR_1980)
            kind = replace(_text_kind(form, "1717402500 100000000"), joined=(name, other))
            return Clock((name, other), kind, form, since_1970)
    return None


def _counted_since_another(values: NDArray[np.float64], name: str, head: Head) -> str:
    """One of ``SINCE_OTHERS`` where numbers are such seconds, by their name or by what stands beside them; or ""."""
    middle = np.sort(values)[len(values) // 2] if len(values) else math.nan
    if name_words(name)[:2] == _OF_FIT and YEAR_1980 / 2 < middle < _YEAR_2037:
        return "fit"
    apple = plain(name) in APPLE or {*map(plain, head.names)} >= _OF_A_PHONE
    if not apple and not (name_words(name)[:1] == ["gps"] and {*name_words(name)[1:]} <= _SECONDS):
        return ""
    if not YEAR_1980 / 2 < middle < (_YEAR_2001 if apple else _YEAR_2286):
        return ""
    return "apple" if apple else "gps_seconds"


def _numeric(name: str, values: NDArray[np.float64], options: ReadOptions) -> Clock:
    """The unit of numbers: by the end of the name, or by their size since 1970; or else seconds since a start."""
    fitting, early = {}, np.abs(values) < YEAR_1980
    for form, count in SINCE_1970.items():
        fits = (values >= YEAR_1980 * count) & (values < _YEAR_2286 * count)
        fitting[form] = (fits.sum(), fits[:1].any())
    ending = unit(name, asked=options.time == name)
    if ending in SINCE_1970 and len(values) and np.abs(values).max() < _YEAR_2286 * PER_SECOND[ending]:
        fitting = {ending: fitting[ending]}  # 1.2e9 us are 1200 s, although as seconds they are of 2008
    form = max(fitting, key=lambda form: fitting[form])
    if fitting[form][1] or (fitting[form][0] and early.mean() < _FEW):
        return Clock((name,), _unit_kind(form, True), form, True)
    if ending in PER_SECOND:
        return Clock((name,), _unit_kind(ending, False), ending, False)
    if options.time is None and plain(name) in DATED and len(values) > 1:
        least, most = values.min(), values.max()
        raise ValueError(
            f"column {name}: expected times since 1970, received {least:.15g} to {most:.15g}, which looks like "
            f"{_guess(values)}: use --time with another column, or --time {name} if it is right"
        )
    return Clock((name,), SECONDS, "seconds", False)


def _guess(values: NDArray[np.float64]) -> str:
    """What numbers look like that are not times since 1970."""
    if np.abs(values).max() <= 86_400:
        return "seconds of the day or since a start"
    if np.abs(values).max() <= 86_400_000:
        return "ms of the day or since a start (--time-format ms)"
    return "times since a start (--time-format seconds, ms, us or ns)"


def days_of(values: NDArray[np.float64], name: str) -> str:
    """The ``time_format`` of numbers of days, all of dates from 1980 to 2050; "" of other numbers.

    Those of two decimals or fewer are no days, which have some of a second, but seconds of the day.
    """
    for form, zero in DAY_OF_1970.items():
        named = form == "mjd" or "mjd" not in name.lower()
        if named and len(values) and values.min() > zero + 3652 and values.max() < zero + 29_220:
            coarse = np.isclose(100 * values, np.rint(100 * values), rtol=0, atol=1e-6).all()
            return "" if coarse else form
    return ""


def _unit_said(form: str) -> str:
    """The unit of numbers in words."""
    return _SAID.get(form, form) if form in PER_SECOND else f"frames, {per_second(form):g} a second"


def _unit_kind(form: str, since_1970: bool) -> Kind:
    """The kind of numbers in a unit."""
    count = per_second(form)
    if form == "seconds":
        return SECONDS
    if not since_1970:
        return Kind(_unit_said(form), limit=_YEAR_2286 * count, per_unit=count)
    if form == "ms":
        return INSTANT
    smaller = (YEAR_1980, _YEAR_2286 * count / 1e3)  # of any smaller unit
    return Kind(f"{_unit_said(form)} since 1970", limit=_YEAR_2286 * count, per_unit=count, between=smaller)


def _dated(clock: Clock, head: Head, options: ReadOptions) -> Clock:
    """A clock of the day together with the column of its date, if there is one."""
    if not is_clock(clock.form):
        return _ahead(clock, head)
    for date in _dates(clock.columns[0], head):
        columns = (date, *clock.columns)
        together = [*filter(None, joined(head.cells, columns))]
        if date not in clock.columns and (dated := _text_clock(columns, together, head)):
            return _ahead(dated, head)
    unread = [date for date in _dates(clock.columns[0], head) if "dat" in plain(date) and date not in clock.columns]
    text = next((cell for date in unread for cell in head.cells(date) if isinstance(cell, str) and cell.strip()), "")
    if text and options.time is None:
        raise ValueError(
            f"column {unread[0]}: expected dates such as 2024-05-06, received {text[:40]!r} beside times of the day in "
            f"{clock.column}: --time {clock.column} takes these alone, which must be less than a day apart"
        )
    return clock


def _dates(name: str, head: Head) -> list[str]:
    """The columns that may hold the date of a time of the day: first the one that is called alike."""
    words = name_words(name)
    alike = [date for date in head.names if words == ["time" if word == "date" else word for word in name_words(date)]]
    return [*dict.fromkeys([*(date for date in alike if date != name), *found(head.names, "date")])]


def _ahead(clock: Clock, head: Head) -> Clock:
    """A clock of local times together with the column of how far they are ahead of UTC, if there is one."""
    offsets = [name for name in head.names if plain(name) in _OFFSETS]
    local = any({"lcl", "local"} & {*name_words(column)} for column in clock.columns)
    for offset in offsets if local and not clock.stated else []:
        columns = (*clock.columns, offset)
        pairs = zip(joined(head.cells, clock.columns), joined(head.cells, (offset,)), strict=True)
        if all(_OFFSET.fullmatch(ahead) for time, ahead in pairs if time or ahead):
            return _text_clock(columns, [*filter(None, joined(head.cells, columns))], head) or clock
    return clock


def _is_danish(head: Head) -> bool:
    """Whether it is a log of ships as the Danish Maritime Authority gives them out, with the day before the month."""
    return "typeofmobile" in map(plain, head.names)


def _values(cells: Sequence[Any] | NDArray[Any]) -> NDArray[np.float64]:
    """The cells that hold numbers, as numbers."""
    values = []
    for cell in cells:
        with suppress(TypeError, ValueError, OverflowError):
            values.append(number(cell) if isinstance(cell, str) else float(cell))
    return np.array([value for value in values if value == value])
