"""Times as files write them: counts since some moment, ISO text, or text in a form of ``datetime.strptime``."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from datetime import datetime, timezone

import numpy as np
from numpy.typing import NDArray

_DAY, WEEK = 86_400.0, 604_800.0
UNITS = {"seconds": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9, "minutes": 1 / 60, "hours": 1 / 3600, "days": 1 / _DAY}
"""How many of a unit a second has: counts since a start, or since 1970."""
SINCE_1970 = ("seconds", "ms", "us", "ns")
"""Those that may count since 1970."""
STARTS = {
    "excel": (1 / _DAY, -25_569 * _DAY), "mjd": (1 / _DAY, -40_587 * _DAY), "jd": (1 / _DAY, -2_440_587.5 * _DAY),
    "matlab": (1 / _DAY, -719_529 * _DAY), "apple": (1.0, 978_307_200.0), "fit": (1.0, 631_065_600.0),
    "gps_seconds": (1.0, 315_964_800.0),
}  # fmt: skip
"""Other counts: units in a second, and where they begin, s since 1970; those of GPS count leap seconds too."""
WEEKS = {"gps": 1.0, "gps_ms": 1e3}
"""Weeks of GPS and what of the week has passed: units in a second."""
FORMS = (*UNITS, *STARTS, *WEEKS, "iso")
"""What a ``time_format`` may be besides a form of ``datetime.strptime``, or numbers of frames such as ``25fps``."""
CLOCK = "%H:%M:%S"
"""Times of the day without a date: seconds since midnight, and a day more after each midnight."""
_DATES = ("%d.%m.%Y", "%d/%m/%Y", "%m/%d/%Y", "%d-%m-%Y", "%m-%d-%Y", "%d-%b-%Y", "%d %b %Y", "%Y/%m/%d",
          "%Y.%m.%d")  # fmt: skip
_CLOCKS = (CLOCK, "%H:%M", "%I:%M:%S %p")
TEXTS = ("iso", *_CLOCKS[::2], *(f"{date} {clock}" for date in _DATES for clock in _CLOCKS), *_DATES)
"""How text is read without a ``time_format``, where it can be in one of these ways only."""
_LEAPS = np.array([
    "1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01", "1991-01-01", "1992-07-01",
    "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01", "1999-01-01", "2006-01-01", "2009-01-01", "2012-07-01",
    "2015-07-01", "2017-01-01",
], "datetime64[s]").astype(np.float64)  # fmt: skip
"""From when on UTC is one more second behind GPS, which began 1980 with UTC; up to 2025 there was no other.

Source: IERS, Bulletin C.
"""
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
_ISO = re.compile(
    r"[0-9]{4}-[0-9]{2}-[0-9]{2}(?:[T ][0-9]{2}:[0-9]{2}(?::[0-9]{2})?(?P<part>[.,][0-9]+)?"
    r"(?P<gap> ?)(?P<zone>Z|UTC|GMT|[+-][0-9]{2}(?::?[0-9]{2})?)?)?"
)
_MONTHS = ("january", "february", "march", "april", "may", "june", "july", "august", "september", "october", "november",
           "december")  # fmt: skip
WEEKDAYS = re.compile("(?:mon|tue|wed|thu|fri|sat|sun)[a-z]*", re.IGNORECASE)
_DIGITS = re.compile("(?:%[YymdjHMS])+(?: (?:%[YymdjHMS])+)*")
"""Forms of numbers whose digits are a date or a clock."""
_SIZES = {"Y": 4, "j": 3}


def per_second(form: str) -> float:
    """How many of its unit a second has, where times are counts in a unit or of frames; 0 of other forms."""
    frames = re.fullmatch(r"(?P<rate>[0-9]+(?:\.[0-9]+)?)fps", form)
    return float(frames["rate"]) if frames else UNITS.get(form, 0.0)


def count_of(form: str) -> tuple[float, float] | None:
    """Units in a second of a count, and where it begins, s since 1970 or its own start; None of text."""
    return STARTS.get(form) or ((per_second(form), 0.0) if per_second(form) else None)


def is_clock(form: str) -> bool:
    """Whether a form of ``strptime`` is of times of the day without a date."""
    return "%" in form and not re.search("%[djcxs]", form)


def forms_of(texts: Sequence[str]) -> list[str]:
    """How to read texts: ``"iso"`` or forms of ``strptime``, those of ``TEXTS`` that read all of them.

    There are several where the first of a date may be the day or the month, and none of other texts.
    """
    likely = [form for form in TEXTS if _reads(form, texts[:1])]
    return [form for form in likely if _reads(form, texts)]


def _reads(form: str, texts: Iterable[str]) -> bool:
    with suppress(ValueError):
        return all(seconds_of(text, form) is not None for text in dict.fromkeys(texts))
    return False


def seconds_of(text: str, form: str) -> float:
    """Seconds since 1970, UTC where no zone is named; of the day where there is no date.

    Args:
        text: the time; it may have parts of a second.
        form: ``"iso"``, one of ``WEEKS`` for two numbers, or one of ``strptime``.

    Raises:
        ValueError: it is not of this form, or there is no such moment.
    """
    text = text.strip()
    if form == "iso":
        return _since_1970(datetime.fromisoformat(_plain_iso(text)))
    if form in WEEKS:
        week, passed = map(float, text.split())
        if not 0 <= passed / WEEKS[form] <= WEEK:
            raise ValueError(f"expected a part of a week, received {passed:.15g} in {form}")
        return float(_from_gps(np.array([STARTS["gps_seconds"][1] + WEEK * week + passed / WEEKS[form]]))[0])
    if _DIGITS.fullmatch(form):
        return _of_digits(text, form)
    bare = re.sub("[+-][0-9]{2}:?[0-9]{2}(?= %Y$|$)", "%z", re.sub("(?<=%S)[.,]%f", "", form))
    parts = re.search("(?<=:[0-9]{2})[.,][0-9]+", text) if "%S" in bare else None
    if parts:
        text = text[: parts.start()] + text[parts.end() :]
    if re.search("%[aA]", bare):
        text, bare = WEEKDAYS.sub("", text, count=1).strip(), re.sub("%[aA]", "", bare).strip()
    if re.search("%[bB]", bare):  # as numbers: names in ``strptime`` are those of the locale
        word = "[A-Za-z]{3,9}" if "%B" in bare else "[A-Za-z]{3}(?![A-Za-z])"
        text, bare = re.sub(word, _number_of_month, text, count=1), re.sub("%[bB]", "%m", bare)
    moment = datetime.strptime(re.sub(" +", " ", text), bare)
    seconds = float(parts[0].replace(",", ".")) if parts else 0.0
    if is_clock(form):
        return seconds + (moment - moment.replace(hour=0, minute=0, second=0, microsecond=0)).total_seconds()
    return seconds + _since_1970(moment)


def _of_digits(text: str, form: str) -> float:
    """Seconds of numbers whose digits are a date or a clock, which may lack zeros in front."""
    words, forms, whole = text.split(), form.split(), list[str]()
    if len(words) != len(forms) or not all(re.fullmatch(r"[0-9]+(?:\.[0-9]*)?", word) for word in words):
        raise ValueError(f"expected digits of {form}, received {text!r}")
    for word, of in zip(words, forms, strict=True):
        digits = sum(_SIZES.get(letter, 2) for letter in of[1::2])
        whole.append(word.partition(".")[0].zfill(digits))
        if len(whole[-1]) > digits:
            raise ValueError(f"expected {digits} digits of {of}, received {word!r}")
    moment = datetime.strptime(" ".join(whole), form)
    part = float(f"0.{words[-1].partition('.')[2] or 0}")
    return part + (
        _since_1970(moment) if not is_clock(form) else moment.hour * 3600 + moment.minute * 60 + moment.second
    )


def _from_gps(gps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Seconds since 1970 of those that count leap seconds too."""
    return np.asarray(gps - np.searchsorted(_LEAPS + np.arange(1, len(_LEAPS) + 1), gps, side="right"))


def counted(values: NDArray[np.float64], form: str) -> NDArray[np.float64]:
    """Seconds of counts in a form that ``count_of`` knows."""
    unit, start = count_of(form) or (1.0, 0.0)
    seconds = values / unit + start
    return _from_gps(seconds) if form == "gps_seconds" else seconds


def _number_of_month(name: re.Match[str]) -> str:
    """The number of the month, of two digits, whose English name begins with a word; the word if there is none."""
    numbers = (number for number, month in enumerate(_MONTHS, 1) if month.startswith(name[0].lower()))
    return next((f"{number:02}" for number in numbers), name[0])


def _plain_iso(text: str) -> str:
    """ISO text as Python 3.10 reads it: six digits after the point, and zones such as +02:00."""
    found = _ISO.fullmatch(text)
    if found is None:
        raise ValueError(f"expected a time in ISO 8601, received {text!r}")
    part, zone = found["part"] or "", found["zone"] or ""
    if not (part or zone):
        return text
    zone = "+00:00" if zone in ("Z", "UTC", "GMT") else zone.replace(":", "")
    zone = f"{zone[:3]}:{zone[3:] or '00'}" if zone and zone[3:4] != ":" else zone
    return text[: found.start("part") if part else found.start("gap")] + (part and f".{part[1:7]:0<6}") + zone


def _since_1970(moment: datetime) -> float:
    return ((moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)) - _EPOCH).total_seconds()
