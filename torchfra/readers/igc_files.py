"""Flights of gliders as IGC, which flight recorders write."""

from __future__ import annotations

import re
from datetime import datetime, timezone
from itertools import accumulate, pairwise
from typing import Any

from torchfra.readers.sheets import Sheet, points_sheet

_FIX = re.compile(
    r"B([01][0-9]|2[0-3])([0-5][0-9])([0-5][0-9])([0-9]{2})([0-9]{5})([NS])([0-9]{3})([0-9]{5})([EW])([AV])"
    r"([0-9-][0-9]{4})([0-9-][0-9]{4})"
)
"""Time of the day, latitude and longitude in degrees and thousandths of minutes, altitudes by pressure and by GNSS."""
_DATE = re.compile(r"HFDTE(?:DATE:)? *([0-9]{6})")
_DAY, _HALF = 86_400, 43_200


def is_igc(start: bytes, suffix: str) -> bool:
    """Whether a file is one, by how it begins or its ending."""
    return suffix == ".igc" or (start[:1] == b"A" and b"\nHFDTE" in start)


def igc_sheet(text: str) -> Sheet:
    """The fixes of a flight: ms since 1970, degrees, and metres by GNSS, or by pressure where no fix has others.

    Without satellites (V) a recorder may hold the position before, which is none.

    Source: FAI, Technical Specification for IGC-Approved Flight Recorders, A4.1.

    Raises:
        ValueError: no date or several, or no fixes.
    """
    fixes = [fix.groups() for line in text.splitlines() if (fix := _FIX.match(line))]
    dates = {*_DATE.findall(text)}
    if not dates or not fixes:
        raise ValueError("expected IGC with a date (HFDTE) and fixes (B), received none")
    if len(dates) > 1:
        raise ValueError(f"expected IGC with one date (HFDTE), received {', '.join(sorted(dates))}: split the file")
    start = _midnight(dates.pop())
    clock = [3600 * int(hours) + 60 * int(minutes) + int(seconds) for hours, minutes, seconds, *_ in fixes]
    midnights = accumulate(pairwise(clock), _nights, initial=0)
    times = [start + seconds + _DAY * nights for seconds, nights in zip(clock, midnights, strict=True)]
    held = [False, *(now[9] == "V" and now[3:9] == before[3:9] for before, now in pairwise(fixes))]
    columns: dict[str, list[Any]] = {
        "timestamp": [round(1000 * seconds) for seconds in times],
        "latitude": [None if stays else _degrees(*fix[3:6]) for fix, stays in zip(fixes, held, strict=True)],
        "longitude": [None if stays else _degrees(*fix[6:9]) for fix, stays in zip(fixes, held, strict=True)],
    }
    by_gnss = [int(fix[11]) if fix[9] == "A" else None for fix in fixes]
    columns["altitude"] = by_gnss if any(by_gnss) else [int(fix[10]) for fix in fixes]
    said = f"IGC: altitudes by {'GNSS' if any(by_gnss) else 'pressure'}"
    sheet = points_sheet(columns, (said + f"; {sum(held):,} held positions (V) left out" * any(held),))
    return sheet._replace(word="glider", degrees=True)


def _midnight(date: str) -> float:
    """Seconds since 1970 at the beginning of a date, day, month and year of two digits each."""
    try:
        return datetime.strptime(date, "%d%m%y").replace(tzinfo=timezone.utc).timestamp()
    except ValueError:
        raise ValueError(f"expected a date (HFDTE) such as 310124, received {date}") from None


def _nights(nights: int, clocks: tuple[int, int]) -> int:
    """How many midnights have passed by the second of two fixes, which may stand before the first one's."""
    before, now = clocks
    return max(nights + (now < before - _HALF) - (now > before + _HALF), 0)


def _degrees(degrees: str, minutes: str, side: str) -> float:
    """Degrees, below 0 in the south and the west."""
    return (-1 if side in "SW" else 1) * (int(degrees) + int(minutes) / 60_000)
