"""Sentences of NMEA 0183 as receivers write them: RMC with date and position, GGA with altitude and HDOP."""

from __future__ import annotations

import math
import re
from collections import Counter
from datetime import date
from typing import Any

import numpy as np

from torchfra.readers.columns import number
from torchfra.readers.sheets import Sheet
from torchfra.running.optional import optional

_NAMES = ("latitude", "longitude", "altitude", "hdop")
_DAY = 86_400.0
_AIS = "AIS must be decoded before, such as by pyais (pip install pyais), to CSV with the columns time, mmsi, lat, lon"
_START = re.compile(rb"(?m)^[^\n$!]{0,80}(?:\$[GBP][A-Z]{2,4},|!(?:AI|AB|BS|SA)VD[MO],)")
"""A sentence of a receiver, or one of AIS; a label, a time or a tag block may be in front."""
_SENTENCE = re.compile(r"\$..(?:RMC|GGA),[^*\"]*(?:\*[0-9A-Fa-f]{2})?")
_SEVERAL = 0.1
"""Share of moments with several positions from which on a file is refused."""
_LINES = 20
"""Of a file that are looked at."""


def is_nmea(start: bytes, suffix: str) -> bool:
    """Whether a file is one, by one of its first lines or its ending."""
    first = b"\n".join(start.splitlines()[:_LINES])
    return bool(_START.search(first)) or suffix in (".nmea", ".nme", ".nma")


def nmea_sheet(text: str) -> Sheet:
    """The fixes of a file: RMC and GGA of the same moment are one; what stands before or behind a sentence is none.

    Raises:
        ValueError: no fixes.
        ImportError: pynmea2 is not installed.
    """
    parse, lines = optional("pynmea2", "NMEA 0183", "formats").parse, Counter[str]()
    fixes, kinds, several = list[list[float]](), dict[str, list[float]](), 0
    for line in text.splitlines():
        if (found := _SENTENCE.search(line)) is None:
            lines["AIS" if re.search("!..VD[MO],", line) else "other"] += 1
            continue
        try:
            kind, fix = _fix(parse(found[0], check=True))
        except (ValueError, TypeError, AttributeError):
            lines["damaged"] += 1
            continue
        if fixes and fixes[-1][0] == fix[0]:
            fixes[-1] = [new if math.isnan(old) else old for old, new in zip(fixes[-1], fix, strict=True)]
        else:
            fixes.append(fix)
            kinds = {}
        several += kinds.setdefault(kind, fix[2:4]) != fix[2:4] and not math.isnan(fix[2])
    if several > _SEVERAL * len(fixes):
        raise ValueError(f"expected one position for each moment, received {several:,} others in sentences of one "
                         "kind, as of several receivers, or of times in whole seconds: write one receiver to a file, "
                         "or its positions as CSV")  # fmt: skip
    if not fixes:
        ais = f"; {_AIS}" if lines["AIS"] else ""
        raise ValueError(f"expected NMEA 0183 with RMC or GGA, received {dict(lines) or 'no'} lines{ais}")
    second, day, *cells = np.array(fixes).T
    known = np.flatnonzero(np.isfinite(day))
    nights = np.cumsum(np.diff(second, prepend=second[:1]) < -_DAY / 2)
    time: Any = second + _DAY * nights
    if len(known):
        before = known[(np.searchsorted(known, np.arange(len(day)), "right") - 1).clip(0)]
        time = np.rint((time + _DAY * (day - nights)[before]) * 1e6).astype(np.int64).view("datetime64[us]")
    more = f"; {lines['damaged']} damaged sentences left out" if lines["damaged"] else ""
    more += f"; {lines['AIS']} AIS messages left out" if lines["AIS"] else ""
    more += "" if len(known) else "; no date, as there is no RMC"
    full = {"time": time} | {name: of for name, of in zip(_NAMES, cells, strict=True) if np.isfinite(of).any()}
    return Sheet([*full], [(len(fixes), full.__getitem__)], (f"NMEA 0183: RMC and GGA{more}",), degrees=True)


def _fix(sentence: Any) -> tuple[str, list[float]]:
    """The kind of a sentence, and its second of the day, day since 1970, latitude, longitude, altitude and HDOP.

    Raises:
        ValueError: a sentence without a time, or with something else for a number; or another error.
    """
    clock, kind = sentence.timestamp, sentence.sentence_type
    second = clock.hour * 3600 + clock.minute * 60 + clock.second + clock.microsecond / 1e6
    day = altitude = hdop = math.nan
    if kind == "RMC":
        good = sentence.status == "A"
        if isinstance(sentence.datestamp, date):
            day = float((sentence.datestamp - date(1970, 1, 1)).days)
    elif good := bool(sentence.gps_qual):
        hdop, altitude = number(sentence.data[7]), number(sentence.data[8])
    there = good and sentence.lat and sentence.lon
    place = [sentence.latitude, sentence.longitude] if there else [math.nan, math.nan]
    return kind, [second, day, *place, altitude, hdop]
