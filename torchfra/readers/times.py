"""Times as files write them: numbers in some unit, ISO text, or text in a form of ``datetime.strptime``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import datetime, timedelta, timezone
from typing import Any

import numpy as np
from numpy.typing import NDArray

SINCE_1970 = {"seconds": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
"""Units in a second of numbers that may count since 1970, by what a ``time_format`` calls them."""
PER_SECOND = {**SINCE_1970, "minutes": 1 / 60, "hours": 1 / 3600, "days": 1 / 86_400}
"""Those and the units of numbers that count since some start only."""
DAY_OF_1970 = {"excel": 25_569.0, "mjd": 40_587.0, "matlab": 719_529.0, "jd": 2_440_587.5}
"""Which day the first of 1970 is, where numbers are days of Excel, modified or full Julian days, or those of Matlab."""
SPLIT = {"s ms": 1e3, "s us": 1e6, "s ns": 1e9}
"""Whole seconds, and parts of a second in a column of their own: how many of these a second has."""
GPS = {"gps": 1.0, "gps_ms": 1e3}
"""Weeks of GPS and what of the week has passed, in seconds or ms: units in a second."""
SINCE_OTHERS = {"apple": 978_307_200.0, "fit": 631_065_600.0, "gps_seconds": 315_964_800.0}
"""When numbers of seconds begin that do not count since 1970, s: with 2001; with the last day of 1989; in 1980, with
leap seconds counted too."""
OF_THE_YEAR = ("year day second", "day second")
"""Years, days of the year and seconds of the day, each in a column of its own."""
FORMS = (*PER_SECOND, *DAY_OF_1970, *GPS, *SINCE_OTHERS, "iso")
"""What a ``time_format`` may be besides a form of ``datetime.strptime``, or numbers of frames such as ``25fps``."""
_FRAMES = re.compile(r"(?P<rate>[0-9]+(?:\.[0-9]+)?)fps")
"""Numbers of frames, so many of them a second."""
_WEEK = 604_800.0
_LEAPS = np.array([
    "1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01", "1991-01-01", "1992-07-01",
    "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01", "1999-01-01", "2006-01-01", "2009-01-01", "2012-07-01",
    "2015-07-01", "2017-01-01",
], "datetime64[s]").astype(np.float64)  # fmt: skip
"""From when on UTC is one more second behind GPS, which began 1980 with UTC; up to 2025 there was no other.

Source: IERS, Bulletin C.
"""
CLOCK = "%H:%M:%S"
"""Times of the day without a date: seconds since midnight, and a day more after each midnight."""
HALF_CLOCK = "%I:%M:%S"
"""Times of the day on a clock of 12 hours; AM or PM follows."""
_PACKED = re.compile("(?:%[YymdjHMS]){2,}(?: (?:%[YymdjHMS]){2,})*")
"""Forms of numbers whose digits are a date or a clock."""
_DIGITS, _SIZES = re.compile(r"[0-9]+(?:\.[0-9]*)?"), {"Y": 4, "j": 3}
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
_ISO = re.compile(
    r"[0-9]{4}-[0-9]{2}-[0-9]{2}(?P<between>[T ])[0-9]{2}:[0-9]{2}(?P<second>:[0-9]{2})?(?P<part>[.,][0-9]+)?"
    r"(?P<gap> ?)(?P<zone>Z|UTC|GMT|(?:UTC|GMT)?[+-][0-9]{2}(?::?[0-9]{2})?)?"
)
_COMPACT = re.compile(r"[0-9]{8}(?P<between>[T_ -])[0-9]{6}(?P<zone>Z?)")
_CLOCK_FIRST = re.compile(r"(?P<clock>[0-9]{1,2}:[0-9]{2}:[0-9]{2}(?:[.,][0-9]{1,6})?) (?P<date>[^ :]*[-/. ][^:]*)")
"""A date of digits alone beside a clock of them, and a clock before its date."""
_OTHER = re.compile(
    r"(?P<a>[0-9]{1,4})(?P<sign>[-/.])(?P<b>[0-9]{1,2})(?P=sign)(?P<c>[0-9]{4}|[0-9]{1,2})(?P<between>[T ])"
    r"[0-9]{1,2}:[0-9]{2}(?P<second>:[0-9]{2})?(?:[.,][0-9]{1,6})?(?P<half> ?[AaPp][Mm])?"
)
_NAMED = re.compile(
    r"[0-9]{1,2}(?P<sign>[-/ ]?)(?P<month>[A-Za-z]{3,9})(?P=sign)(?P<year>[0-9]{4}|[0-9]{2})(?P<between>[T ])"
    r"[0-9]{1,2}:[0-9]{2}(?P<second>:[0-9]{2})?(?:[.,][0-9]{1,6})?"
)
"""A date with the English name of its month."""
_DAYS = ("Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun")
_WEEKDAY = re.compile(f"(?:{'|'.join(_DAYS)}) ")
_JAVA = re.compile(
    _WEEKDAY.pattern
    + "[A-Z][a-z]{2}  ?[0-9]{1,2} [0-9]{2}:[0-9]{2}:[0-9]{2} (?:(?P<zone>[A-Z]{1,5}(?:[+-][0-9]{2}:[0-9]{2})?) )?"
    "[0-9]{4}"
)
"""As Java and C write a date by default, with the zone before the year."""
_OFFSET = re.compile(r"([+-])([0-9]{2}):?([0-9]{2})?(?: %Y)?$")
"""The zone of a form."""
_MONTHS = ("January", "February", "March", "April", "May", "June", "July", "August", "September", "October", "November",
           "December")  # fmt: skip
_MONTH, _MONTH_OF_FORM = re.compile("[A-Za-z]{3,9}"), re.compile("%[bB]")
_UTC = r"(?: ?Z| ?UTC| ?GMT|\+00:00)?"
_USUAL = re.compile(
    rf"(?:(?:[0-9]{{4}}-[0-9]{{2}}-[0-9]{{2}}[T ][0-9]{{2}}:[0-9]{{2}}:[0-9]{{2}}(?:\.[0-9]{{1,6}})?{_UTC})?\n)*"
)
"""Lines of ISO text in UTC, or empty."""
_CLOCK = re.compile(r"[0-9]{1,2}:[0-9]{2}:[0-9]{2}(?:[.,][0-9]{1,6})?(?P<half> ?[AaPp][Mm])?")
_DAY_AND_CLOCK = {"%Y-%m-%dT%H:%M:": "T", "%Y-%m-%d %H:%M:": " "}
"""Forms, up to seconds, that numpy writes ten times as fast as ``strftime``; and what is between day and clock."""
_DAY, _MOST_OF_A_YEAR = 86_400.0, 300 * 86_400.0
_PARTS_OF_DATES = {"d": "day", "m": "month", "y": "year"}
NEARER = 0.2
"""How much shorter the ways of time are in the order that days, months and years have than in others."""
_FOUR_DIGITS = 3 * 10**16
"""Microseconds to 1970 of years that have four digits."""
_COMMA, _PART = re.compile("(?<=:[0-9]{2}),(?=[0-9])"), re.compile("(?<=%S)[.,]%f")
"""Before parts of a second, of a time and of its form."""
_ZONED = re.compile(r"(?P<bare>.*[0-9](?: ?[AaPp][Mm])?)(?P<gap> ?)(?P<zone>[A-Z]{1,5}|[A-Z][a-z]+/[A-Za-z_/]+)")
"""A time with the name of a zone behind."""


def per_second(form: str) -> float:
    """How many of its unit a second has, where times are numbers in a unit or of frames; 0 of other forms."""
    frames = _FRAMES.fullmatch(form)
    return float(frames["rate"]) if frames else PER_SECOND.get(form, 0.0)


def form_of(cells: Sequence[Any], *, day_first: bool = False) -> tuple[str, str] | None:
    """How to read texts, ``"iso"`` or a form of ``strptime``, and how to write them; None of other texts.

    Args:
        cells: some of a column, none of them empty.
        day_first: whether it is known that the day comes before the month.

    Raises:
        ValueError: the day may be the month, or the name of a zone has several meanings.
    """
    texts = [str(cell).strip() for cell in cells]
    if not texts:
        return None
    bare = [_WEEKDAY.sub("", text, count=1) for text in texts]
    if bare != texts and all(map(_CLOCK.fullmatch, bare)) and (found := form_of(bare)):
        return f"%a {found[0]}", found[1]
    clocks = [_CLOCK.fullmatch(text) for text in texts]
    if all(clocks):
        halves = {"" if of is None or of["half"] is None else of["half"][:-2] + "%p" for of in clocks}
        if len(halves) > 1:
            return None
        clock = HALF_CLOCK + halves.pop() if halves != {""} else CLOCK
        return clock, clock
    if all(swapped := [_CLOCK_FIRST.fullmatch(text) for text in texts]) and (
        found := form_of([f"{of['date']} {of['clock']}" for of in swapped if of], day_first=day_first)
    ):
        form = " ".join(reversed(found[1].rsplit(" ", 1)))
        return form, form
    if all(compact := [_COMPACT.fullmatch(text) for text in texts]) and compact[0]:
        form = f"%Y%m%d{compact[0]['between']}%H%M%S{compact[0]['zone']}"
        return form, form
    first = _ISO.fullmatch(texts[0])
    if all(java := [_JAVA.fullmatch(text) for text in texts]):
        zones = [of["zone"] or "" for of in java if of]
        form = f"%a %b %d %H:%M:%S {zones[0]} %Y".replace("  ", " ")
        _check_zones(zones, texts[0], form)
        return form, form
    if not _is_plain(texts[0]) and (zoned := _ZONED.fullmatch(texts[0])) and _is_plain(zoned["bare"]):
        return _form_with_zone(texts, zoned, day_first)
    if first is None:
        dates = _form_of_dates(texts, day_first)
        return None if dates is None else (dates, dates)
    clock = f"%H:%M{':%S' if first['second'] else ''}{first['gap']}{first['zone'] or ''}"
    form = f"%Y-%m-%d{first['between']}{clock}"
    return "iso", "iso" if form in ("%Y-%m-%dT%H:%M:%SZ", "%Y-%m-%dT%H:%M:%S+00:00") else form


def _is_plain(text: str) -> bool:
    """Whether it is a time without a zone."""
    return any(form.fullmatch(text) for form in (_ISO, _OTHER, _NAMED, _CLOCK))


def _form_with_zone(texts: list[str], first: re.Match[str], day_first: bool) -> tuple[str, str] | None:
    """The form of times with the name of a zone behind."""
    zone, zoned = f"{first['gap']}{first['zone']}", [_ZONED.fullmatch(text) for text in texts]
    found = form_of([text if of is None else of["bare"] for text, of in zip(texts, zoned, strict=True)],
                    day_first=day_first)  # fmt: skip
    if found is None:
        return None
    form = f"{found[1]}{zone}"
    _check_zones([of["zone"] for of in zoned if of], texts[0], form)
    return form, form


def _check_zones(zones: list[str], text: str, form: str) -> None:
    """Refuses several zones, and those whose offset from UTC is not known."""
    if len({*zones}) > 1:
        raise ValueError(
            f"expected one zone, received {' and '.join(dict.fromkeys(zones))}: write an offset such as -06:00 instead"
        )
    if zones[0] in ("", "UTC", "GMT", "Z") or _OFFSET.search(zones[0]):
        return
    raise ValueError(
        f"zone {zones[0]} of {text!r} has several meanings or changes with the season: write an offset such "
        f"as -06:00 instead, or use --time-format '{form}', which reads the times as UTC"
    )


def states_zone(form: str) -> bool:
    """Whether a form of ``strptime`` ends in a zone, but for the year that may follow."""
    return form.removesuffix(" %Y").endswith(("Z", "UTC", "GMT")) or _OFFSET.search(form) is not None


def is_clock(form: str) -> bool:
    """Whether a form of ``strptime`` is of times of the day without a date."""
    return "%" in form and not re.search("%[djcxs]", form)


def _form_of_dates(texts: list[str], day_first: bool) -> str | None:
    """The form of dates with their parts in another order, or with the names of months."""
    named = [match for text in texts if (match := _NAMED.fullmatch(text))]
    if 2 * len(named) > len(texts):
        month = "%B" if max(len(one["month"]) for one in named) > 3 else "%b"
        sign, year = named[0]["sign"], "%Y" if len(named[0]["year"]) == 4 else "%y"
        return f"%d{sign}{month}{sign}{year}{named[0]['between']}%H:%M{':%S' if named[0]['second'] else ''}"
    found = [match for text in texts if (match := _OTHER.fullmatch(text))]
    if 2 * len(found) < len(texts):
        return None
    first, sign = found[0], found[0]["sign"]
    half = {"": "", " ": " %p"}.get((first["half"] or "")[:1], "%p")
    clock = f"{first['between']}{'%I' if half else '%H'}:%M{':%S' if first['second'] else ''}{half}"
    if len(first["a"]) == 4:
        return f"%Y{sign}%m{sign}%d{clock}"
    year = "%Y" if len(first["c"]) == 4 else "%y"
    a, b, c = (max(int(one[part]) for one in found) for part in "abc")
    days = {f"%d{sign}%m{sign}{year}{clock}": b <= 12, f"%m{sign}%d{sign}{year}{clock}": a <= 12}
    years = {f"%y{sign}%m{sign}%d{clock}": b <= 12 and c <= 31} if year == "%y" else {}
    if sign == "/" and a > 12 and len({one["a"] + one["c"] for one in found}) == 1:
        years = {}  # of one day only, as people write it
    forms = [] if day_first or sign == "." else [form for form, fits in (days | years).items() if fits]
    return _nearest([one[0] for one in found], forms) if len(forms) > 1 else (forms or [*days])[0]


def _nearest(texts: list[str], forms: list[str]) -> str:
    """The form by which times go on from text to text, where by others they leap.

    Raises:
        ValueError: by several they do.
    """

    def steps(form: str) -> NDArray[np.float64]:
        try:
            times = np.array([seconds_of(text, form) for text in texts])
            return np.asarray(np.abs(np.diff(times, prepend=times[:1])))
        except ValueError:  # no such day
            return np.full(len(texts), np.inf)

    every = {form: steps(form) for form in forms}
    best, other = sorted(forms, key=lambda form: every[form].sum())[:2]
    # A row a day in one order may be a row a month in the other.
    sure = np.median(every[best]) < _DAY or np.median(every[other]) > _MOST_OF_A_YEAR
    if sure and every[best].sum() < NEARER * every[other].sum():
        return best
    firsts = " or ".join(f"the {_PARTS_OF_DATES[form[1]]}" for form in forms)
    raise ValueError(f"{texts[0]!r} may have {firsts} first: use --time-format {' or '.join(map(repr, forms))}")


def seconds_of(text: str, form: str) -> float:
    """Seconds since 1970, UTC where no zone is named; of the day where there is no date.

    Args:
        text: the time; it may have parts of a second.
        form: ``"iso"``, or one of ``strptime``.

    Raises:
        ValueError: it is not of this form, or there is no such moment.
    """
    text = text.strip()
    if form == "iso":
        return _since_1970(datetime.fromisoformat(_plain_iso(text)))
    if form in GPS:
        week, passed = map(float, text.split())
        return _from_gps(_WEEK * week + passed / GPS[form])
    if form in SINCE_OTHERS:
        return _from_gps(float(text)) if form == "gps_seconds" else SINCE_OTHERS[form] + float(text)
    if form in OF_THE_YEAR:
        *year, day, second = map(float, text.split())
        start = _since_1970(datetime(int(year[0]), 1, 1)) if year else 0.0
        return start + 86_400 * (day - 1) + second
    if form in SPLIT:
        whole, part = map(float, text.split())
        return whole + part / SPLIT[form]
    if _PACKED.fullmatch(form):
        text, part = _unpacked(text, form)
        return seconds_of(text, " ".join(re.sub("(?<=.)%", "-%", word) for word in form.split())) + part
    bare, text = _PART.sub("", form), _COMMA.sub(".", text)
    pointed = "%f" not in bare and re.search(r":[0-9]{2}\.[0-9]", text) is not None
    if bare.startswith("%a "):
        text, bare = _WEEKDAY.sub("", text, count=1), bare[3:]
    if _MONTH_OF_FORM.search(bare):  # as numbers: names in ``strptime`` are those of the locale
        text, bare = _MONTH.sub(_number_of_month, text), _MONTH_OF_FORM.sub("%m", bare)
    moment = datetime.strptime(text, bare.replace("%S", "%S.%f") if pointed else bare)
    if is_clock(form):
        return (moment - moment.replace(hour=0, minute=0, second=0, microsecond=0)).total_seconds()
    return _since_1970(moment - _ahead(form))


def _from_gps(passed: float) -> float:
    """Seconds since 1970 of those of GPS."""
    gps = SINCE_OTHERS["gps_seconds"] + passed
    return gps - float(np.searchsorted(_LEAPS + np.arange(1, len(_LEAPS) + 1), gps, side="right"))


def _unpacked(text: str, form: str) -> tuple[str, float]:
    """Numbers whose digits are a date or a clock, parted by hyphens, and what of a second is behind the point.

    They may lack zeros in front, which ``strptime`` alone would take from the next part.
    """
    words, forms = text.split(), form.split()
    if len(words) != len(forms) or not all(map(_DIGITS.fullmatch, words)):
        raise ValueError(f"expected digits of {form}, received {text!r}")
    parted = []
    for word, of in zip(words, forms, strict=True):
        sizes = [_SIZES.get(letter, 2) for letter in of[1::2]]
        digits = word.partition(".")[0].zfill(sum(sizes))
        if len(digits) > sum(sizes):
            raise ValueError(f"expected {sum(sizes)} digits of {of}, received {word!r}")
        ends = np.cumsum(sizes).tolist()
        parted.append("-".join(digits[end - size : end] for end, size in zip(ends, sizes, strict=True)))
    return " ".join(parted), float(f"0.{words[-1].partition('.')[2] or 0}")


def _number_of_month(name: re.Match[str]) -> str:
    """The number of the month, of two digits, whose English name begins with a word; the word if there is none."""
    numbers = (number for number, month in enumerate(_MONTHS, 1) if month.lower().startswith(name[0].lower()))
    return next((f"{number:02}" for number in numbers), name[0])


def usual_iso_seconds(cells: Sequence[Any]) -> NDArray[np.float64] | None:
    """Seconds since 1970 of ISO text in UTC, NaN where empty, fast; None if a cell is something else."""
    try:
        lines = "".join([cell + "\n" for cell in cells])  # of no cells, as behind the last whole line, none
        if not _USUAL.fullmatch(lines):
            return None
        moments = np.array(re.sub(_UTC + "\n", "\n", lines).split("\n")[:-1], "datetime64[us]")
    except (TypeError, ValueError):
        return None
    return np.where(np.isnat(moments), np.nan, moments.astype(np.int64) / 1e6)


def _plain_iso(text: str) -> str:
    """ISO text as Python 3.10 reads it: six digits after the point, and zones such as +02:00."""
    found = _ISO.fullmatch(text)
    if found is None:
        raise ValueError(f"expected a time in ISO 8601, received {text!r}")
    part, zone = found["part"] or "", found["zone"] or ""
    if not (part or zone):
        return text
    zone = "+00:00" if zone in ("Z", "UTC", "GMT") else zone.lstrip("UTCGM").replace(":", "")
    zone = f"{zone[:3]}:{zone[3:] or '00'}" if zone and zone[3:4] != ":" else zone
    return text[: found.start("part") if part else found.start("gap")] + (part and f".{part[1:7]:0<6}") + zone


def _since_1970(moment: datetime) -> float:
    whole = (moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)) - _EPOCH
    return whole.total_seconds()


def written(time: NDArray[np.float64], form: str) -> list[str]:
    """Times as a file has them.

    Args:
        time: ``(k,)`` seconds, as ``Recording.time``.
        form: as ``Source.time``; parts of a second are added to all where a time has them.
    """
    if (count := per_second(form)) > 0:
        return _numbers(time * count, 6 if np.abs(time).max(initial=0.0) > 1e6 else 9, count)
    if form in DAY_OF_1970:
        return _numbers(time / 86_400 + DAY_OF_1970[form], 6, 1 / 86_400)
    since: NDArray[np.float64] = time - SINCE_OTHERS.get(form, SINCE_OTHERS["gps_seconds"])
    if form not in ("apple", "fit"):
        since += np.searchsorted(_LEAPS, time, side="right")
    if form in SINCE_OTHERS:
        return _numbers(since, 6, 1.0)
    if form in OF_THE_YEAR:
        days, seconds = np.divmod(np.rint(time * 1e6) / 1e6, 86_400)
        years = days.astype("datetime64[D]").astype("datetime64[Y]")
        before = years.astype("datetime64[D]").astype(float) if form == OF_THE_YEAR[0] else np.zeros(len(days))
        parts = zip(years.astype(str), days - before + 1, _numbers(seconds, 6, 1.0), strict=True)
        texts = [f"{year} {day:.0f} {second}" for year, day, second in parts]
        return texts if form == OF_THE_YEAR[0] else [text.partition(" ")[2] for text in texts]
    if form in GPS:
        of_week = _numbers(since % _WEEK * GPS[form], 6, GPS[form])
        return [f"{week:.0f} {passed}" for week, passed in zip(since // _WEEK, of_week, strict=True)]
    if form in SPLIT:
        halves = zip(*np.divmod(np.rint(time * 1e6), 1e6), strict=True)
        return [f"{seconds:.0f} {passed * SPLIT[form] / 1e6:.0f}" for seconds, passed in halves]
    micro = np.rint(time * 1e6).astype(np.int64)
    digits = 0 if not (micro % 1_000_000).any() else 3 if not (micro % 1000).any() else 6
    form = "%Y-%m-%dT%H:%M:%SZ" if form == "iso" else _PART.sub("", form)
    (head, second, tail), ahead = form.partition("%S"), _ahead(form)
    if head in _DAY_AND_CLOCK and "%" not in tail and np.abs(micro).max(initial=0) < _FOUR_DIGITS:
        unit = {0: "s", 3: "ms", 6: "us"}[digits]
        moments = (micro + ahead // timedelta(microseconds=1)).astype("datetime64[us]").astype(f"datetime64[{unit}]")
        parts = moments.astype(str).tolist()
        return [part.replace("T", _DAY_AND_CLOCK[head]) + tail for part in parts]
    texts = []
    for value in micro.tolist():
        moment = _EPOCH + timedelta(microseconds=value) + ahead
        part = f".{moment.microsecond:06}"[: 1 + digits] if second and digits else ""
        month = _MONTHS[moment.month - 1]
        first, last = (
            moment.strftime(half.replace("%B", month).replace("%b", month[:3]).replace("%a", _DAYS[moment.weekday()]))
            if "%" in half
            else half
            for half in (head + second, tail)
        )
        texts.append(first + part + last)
    return texts


def _numbers(values: NDArray[np.float64], digits: int, per_second: float) -> list[str]:
    """Numbers with as many digits of a second as times have that are exact to a double."""
    digits = max(0, digits - round(np.log10(per_second)))
    texts = [f"{value:.{digits}f}" for value in values.tolist()]
    return [text.rstrip("0").rstrip(".") for text in texts] if digits else texts


def _ahead(form: str) -> timedelta:
    """By how much the times of a form are ahead of UTC, if it ends in a zone."""
    found = _OFFSET.search(form)
    if found is None:
        return timedelta(0)
    ahead = timedelta(hours=int(found[2]), minutes=int(found[3] or 0))
    return ahead if found[1] == "+" else -ahead
