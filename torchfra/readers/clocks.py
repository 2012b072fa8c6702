"""Which column tells the time, and how."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchfra.readers.columns import INSTANT, SECONDS, Head, Kind, joined, number
from torchfra.readers.spelling import SINCE_1970, found, plain, unit
from torchfra.readers.times import CLOCK, PER_SECOND, form_of, seconds_of, written
from torchfra.readers.told import Told

YEAR_1980 = 315_532_800.0
"""Seconds since 1970; nothing was recorded before."""
_YEAR_2286 = 1e10
_DAY = 86_400.0
_FEW = 0.1
"""Share of the times of a clock that may not have been set yet."""
_FINER = 2
"""How many times as many moments a column of times has to have, to be taken although another has the date."""
_SAID = {"seconds": "seconds", "ms": "ms", "us": "microseconds", "ns": "nanoseconds"}


@dataclass(frozen=True)
class Clock:
    """How a column tells the time."""

    columns: tuple[str, ...]
    """One; or those of a date and of a time of the day."""
    kind: Kind
    form: str
    """How it is written: ``Source.time``."""
    since_1970: bool
    """Whether it tells the date too."""

    @property
    def said(self) -> str:
        """A word or two for a person."""
        if self.form in PER_SECOND:
            return _SAID[self.form] + (" since 1970" if self.since_1970 else "")
        return "ISO text" if self.kind.form == "iso" else "times of the day" if self.form == CLOCK else self.form

    @property
    def column(self) -> str:
        """What the times are called in a table."""
        return " ".join(self.columns)

    def whole(self, time: NDArray[np.float64]) -> NDArray[np.float64]:
        """Times ``(rows,)`` that go on after midnight.

        Raises:
            ValueError: they are of years before 1980.
        """
        if self.form == CLOCK:
            rows = np.flatnonzero(np.isfinite(time))
            midnights = np.cumsum(np.diff(time[rows], prepend=time[rows[:1]]) < -_DAY / 2)
            time[rows] += _DAY * midnights
        elif self.since_1970 and len(known := time[np.isfinite(time)]) and np.median(known) < YEAR_1980:
            row = int(np.isfinite(time).argmax())
            (early,) = written(time[row : row + 1], "iso")
            raise ValueError(
                f"expected years from 1980 on in row {row + 1} of {self.column}, received {early}, which looks "
                "like times since a start: name another column by --time, or their unit by --time-format"
            )
        return time

    @property
    def doubt(self) -> tuple[bool, bool]:
        """What to sort by: whether it lacks the date, and whether it is no text."""
        return not self.since_1970, self.form in PER_SECOND


def clock_of(head: Head, told: Told) -> tuple[Clock, list[str]]:
    """The column of times, and those that are times too and are not used.

    Args:
        head: of the table.
        told: by the caller.

    Raises:
        LookupError: there is none.
        ValueError: its times are not understood.
    """
    if told.time is not None:
        return _dated(_clock(told.time, head, told), head), []
    candidates, clocks, refusals = found(head.names, "time"), list[Clock](), list[ValueError]()
    for name in candidates:
        try:
            clocks.append(_dated(_clock(name, head, told), head))
        except ValueError as error:
            refusals.append(error)
    if not clocks:
        raise refusals[0] if refusals else LookupError("time")
    best = min(clocks, key=lambda clock: clock.doubt)
    moments = {clock: len({str(cell) for name in clock.columns for cell in head.cells(name)}) for clock in clocks}
    finest = max(clocks, key=lambda clock: moments[clock])
    if moments[finest] > _FINER * moments[best]:
        best = finest  # such as ms since a start beside a date of whole seconds: fixes of one moment would be lost
    return best, [name for name in candidates if name not in best.columns]


def _clock(name: str, head: Head, told: Told) -> Clock:
    """How a column tells the time.

    Raises:
        ValueError: it cannot be told.
    """
    column = head.cells(name)
    if isinstance(column, np.ndarray) and column.dtype.kind == "M":
        return Clock((name,), INSTANT, "iso", True)
    some = [cell for cell in column if isinstance(cell, str | int | float | np.generic) and cell == cell]
    some = [cell for cell in some if not isinstance(cell, str) or cell.strip()]
    if told.time_format is not None:
        return _told_clock(name, told.time_format, head)
    values = _values(some)
    if len(values) < len(some) and (clock := _text_clock((name,), some, _is_danish(head))) is not None:
        return clock
    if len(some) and not len(values) and plain(name) in SINCE_1970:
        return Clock((name,), INSTANT, "iso", True)  # which names the cell that is no time, as a number does
    return _numeric(name, values, told)


def _text_clock(columns: tuple[str, ...], some: Sequence[Any], day_first: bool) -> Clock | None:
    """How texts tell the time; None where they do not.

    Raises:
        ValueError: the day may be the month.
    """
    try:
        form = form_of([cell for cell in some if isinstance(cell, str)], day_first=day_first)
    except ValueError as error:
        raise ValueError(f"column {columns[-1]}: {error}") from None
    if form is None:
        return None
    read, write = form
    if read == "iso":
        return Clock(columns, replace(INSTANT, joined=columns[:-1] and columns), write, True)
    kind = replace(_text_kind(read, str(some[0])), joined=columns[:-1] and columns)
    return Clock(columns, kind, write, read != CLOCK)


def _text_kind(form: str, example: str) -> Kind:
    return Kind(f"a time such as {example.strip()[:40]}", limit=math.inf, per_unit=1e3, form=form)


def _told_clock(name: str, form: str, head: Head) -> Clock:
    """A column in a form that is told; with the one of the date before it, where only both are of this form."""
    if form in PER_SECOND:
        return Clock((name,), _unit_kind(form, False), form, False)
    kind = INSTANT if form == "iso" else _text_kind(form, form)
    for columns in ((name,), *((date, name) for date in found(head.names, "date") if date != name)):
        with suppress(ValueError, StopIteration):
            seconds_of(next(filter(None, joined(head.cells, columns))), form)
            return Clock(columns, replace(kind, joined=columns[:-1] and columns), form, form != CLOCK)
    return Clock((name,), kind, form, form != CLOCK)


def _numeric(name: str, values: NDArray[np.float64], told: Told) -> Clock:
    """The unit of numbers: by the end of the name if it can be, or by their size since 1970; or seconds since a start.

    Raises:
        ValueError: the name means times since 1970, and these are not.
    """
    fitting, early = {}, np.abs(values) < YEAR_1980
    for form, per_second in PER_SECOND.items():
        fits = (values >= YEAR_1980 * per_second) & (values < _YEAR_2286 * per_second)
        fitting[form] = (fits.sum(), fits[:1].any())
    ending = unit(name)
    if ending in PER_SECOND and len(values) and np.abs(values).max() < _YEAR_2286 * PER_SECOND[ending]:
        fitting = {ending: fitting[ending]}  # 1.2e9 us are 1200 s, although as seconds they are of 2008
    form = max(fitting, key=lambda form: fitting[form])
    if fitting[form][1] or (fitting[form][0] and early.mean() < _FEW):
        return Clock((name,), _unit_kind(form, True), form, True)
    if ending in PER_SECOND:
        return Clock((name,), _unit_kind(ending, False), ending, False)
    if told.time is None and plain(name) in SINCE_1970 and len(values) > 1:
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


def _unit_kind(form: str, since_1970: bool) -> Kind:
    """The kind of numbers in a unit."""
    per_second = PER_SECOND[form]
    if form == "seconds":
        return SECONDS
    if not since_1970:
        return Kind(f"{_SAID[form]}", limit=_YEAR_2286 * per_second, per_unit=per_second)
    if form == "ms":
        return INSTANT
    smaller = (YEAR_1980, _YEAR_2286 * per_second / 1e3)  # of any smaller unit
    return Kind(f"{_SAID[form]} since 1970", limit=_YEAR_2286 * per_second, per_unit=per_second, between=smaller)


def _dated(clock: Clock, head: Head) -> Clock:
    """A clock of the day together with the column of its date, if there is one."""
    if clock.form != CLOCK:
        return clock
    for date in found(head.names, "date"):
        columns = (date, *clock.columns)
        together = [*filter(None, joined(head.cells, columns))]
        if date not in clock.columns and (dated := _text_clock(columns, together, _is_danish(head))):
            return dated
    return clock


def _is_danish(head: Head) -> bool:
    """Whether it is a log of ships as the Danish Maritime Authority gives them out, with the day before the month."""
    return "typeofmobile" in map(plain, head.names)


def _values(cells: Sequence[Any]) -> NDArray[np.float64]:
    """Those of the cells that are numbers."""
    values = []
    for cell in cells:
        with suppress(TypeError, ValueError, OverflowError):
            values.append(number(cell) if isinstance(cell, str) else float(cell))
    return np.array(values)
