"""Numbers whose digits are a date or a clock: they do not count time, and are refused with how to read them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from torchfra.readers.times import seconds_of

_DATES = {"%Y%m%d%H%M%S": 14, "%Y%m%d%H%M": 12, "%Y%m%d": 8, "%Y%j": 7}
"""Forms of dates that tell themselves apart from counts, and how many digits they have."""
_DATES_BESIDE = ("%Y%m%d", "%d%m%y", "%y%m%d", "%m%d%y", "%d%m%Y", "%Y%j")
"""Forms of dates beside a clock."""
_YEARS = (315_532_800.0, 2_556_144_000.0)
"""From 1980 to 2050, s since 1970."""
_MANY, _SOME, _OTHERS, _PIECES, _SURELY = 20, 3, 10, 2, 0.5
"""Moments, alone and beside a date; endings; minutes; and how much rarer uneven steps are, from which on numbers are
clocks."""
_TICKS = {
    "ticks of .NET (100 ns since the year 1): write (ticks - 621355968000000000) / 1e7": (6.2e17, 6.6e17),
    "100 ns since 1601, as Windows counts: write (number - 116444736000000000) / 1e7": (1.24e17, 1.45e17),
}


def packed(values: NDArray[np.float64], dates: Sequence[NDArray[np.float64]] = ()) -> str:
    """What numbers look like that are no count, and what to do; "" of others.

    Args:
        values: ``(rows,)`` of a column of times.
        dates: of columns that may hold the date, where these are numbers.
    """
    moments = np.unique(values[np.isfinite(values)])
    if not len(moments):
        return ""
    for said, (least, most) in _TICKS.items():
        if least < moments[0] and moments[-1] < most:
            return f"{said}, as seconds since 1970"
    for form, digits in _DATES.items():
        if moments[0] >= 10 ** (digits - 1) and moments[-1] < 10**digits and _is_date(moments, form):
            return f"a date in one number: --time-format {form}"
    forms = [form for days in dates for form in _DATES_BESIDE if len(days) and _is_date(np.unique(days), form)]
    clocks = [form for form, unit in (("%H%M%S", 1.0), ("%H%M", 0.01)) if _is_clock(moments, unit, bool(forms))]
    if clocks:
        every = [f"'{date} {clock}'" if date else clock for date in forms[:2] or [""] for clock in clocks]
        return f"hours and minutes in one number: --time-format {' or '.join(every)}"
    if any(_is_clock(moments, unit, bool(forms)) for unit in (100.0, 1000.0)):
        return "hours, minutes, seconds and parts of one in one number: write them as 08:15:00.25"
    return ""


def _is_date(days: NDArray[np.float64], form: str) -> bool:
    """Whether all are dates of this form."""
    try:
        moments = [seconds_of(f"{day:.0f}", form) for day in days.tolist() if day % 1 == 0]
    except ValueError:
        return False
    return len(moments) == len(days) and all(_YEARS[0] <= moment < _YEARS[1] for moment in moments)


def _is_clock(moments: NDArray[np.float64], unit: float, dated: bool) -> bool:
    """Whether numbers, sorted, are hours, minutes and seconds: counts of seconds would end in 60 to 99 too."""
    if moments[0] < 0 or moments[-1] >= 240_000 * unit:
        return False
    digits = moments / unit
    hours, minutes, seconds = digits // 10_000, digits // 100 % 100, digits % 100
    if (minutes >= 60).any() or (seconds >= 60).any():
        return False
    if len(moments) < (_SOME if dated else _MANY) or digits[0] // 100 == digits[-1] // 100:
        return False

    as_clock, as_count = np.diff(3600 * hours + 60 * minutes + seconds), np.diff(moments)
    uneven = [(np.abs(steps - np.median(steps)) > 0.01 * np.median(steps)).mean() for steps in (as_clock, as_count)]
    evener = uneven[0] < _SURELY * uneven[1]
    several = len(np.unique(digits // 100)) > _PIECES  # two pieces of counts may end below 60 by chance
    return bool(evener) or (unit >= 1 and several and len(np.unique(seconds // 1)) >= _OTHERS)
