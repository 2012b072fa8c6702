"""Sentences of NMEA 0183 as receivers write them: RMC with date and position, GGA with altitude and HDOP."""

from __future__ import annotations

import math
import re
from array import array
from collections import Counter
from datetime import date
from typing import Any

import numpy as np

from torchfra.readers.columns import number
from torchfra.readers.sheets import Sheet
from torchfra.running.optional import optional

_NAMES = ("day", "second", "latitude", "longitude", "altitude", "hdop")
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
    first = b"\n".join(start[:9999].splitlines()[:_LINES])
    return bool(_START.search(first)) or suffix in (".nmea", ".nme", ".nma")


def nmea_sheet(text: str) -> Sheet:
    """The fixes of a file: RMC and GGA of the same moment are one; what stands before or behind a sentence is none.

    Raises:
        ValueError: no fixes.
        ImportError: pynmea2 is not installed.
    """
    fixes, lines = _Fixes(), Counter[str]()
    for line in map(str.strip, text.splitlines()):
        if (found := _SENTENCE.search(line)) is None:
            lines["AIS" if re.search("!..VD[MO],", line) else "other"] += 1
            continue
        try:
            fixes.add(_parsed(found[0]))
        except (ValueError, TypeError, AttributeError):
            lines["damaged"] += 1
    if fixes.several > _SEVERAL * len(fixes.values["second"]):
        raise ValueError(f"expected one position for each moment, received {fixes.several:,} others in sentences "
                         "of one kind, as of several receivers, or of times in whole seconds: write one receiver to "
                         "a file, or its positions as CSV")  # fmt: skip
    columns = fixes.columns()
    if not len(columns["time"]):
        ais = f"; {_AIS}" if lines["AIS"] else ""
        raise ValueError(f"expected NMEA 0183 with RMC or GGA, received {dict(lines) or 'no'} lines{ais}")
    more = f"; {lines['damaged']} damaged sentences left out" if lines["damaged"] else ""
    more += f"; {lines['AIS']} AIS messages left out" if lines["AIS"] else ""
    more += "" if columns["time"].dtype.kind == "M" else "; no date, as there is no RMC"
    full = {name: cells for name, cells in columns.items() if cells.dtype.kind == "M" or np.isfinite(cells).any()}
    return Sheet([*full], [(len(full["time"]), full.__getitem__)], (f"NMEA 0183: RMC and GGA{more}",))


def _parsed(sentence: str) -> Any:
    """A sentence of a receiver.

    Raises:
        ValueError: it is damaged.
        ImportError: pynmea2 is not installed.
    """
    return optional("pynmea2", "NMEA 0183", "formats").parse(sentence, check=True)


class _Fixes:
    """What sentences say of one moment after the other."""

    def __init__(self) -> None:
        self.values = {name: array("d") for name in _NAMES}
        self.day = math.nan
        self.kinds = dict[str, tuple[float, float]]()
        """Places of the last moment by the kind of sentence."""
        self.several = 0
        """Sentences whose moment has another place by one of their kind."""

    def add(self, sentence: Any) -> None:
        """Adds what a sentence says to the fix of its moment.

        Raises:
            ValueError: a sentence without a time, or with something else for a number.
        """
        time, values = sentence.timestamp, self.values
        second = time.hour * 3600 + time.minute * 60 + time.second + time.microsecond / 1e6
        place = (sentence.latitude, sentence.longitude) if sentence.lat and sentence.lon else (math.nan, math.nan)
        altitude = hdop = math.nan
        if sentence.sentence_type == "RMC":
            if isinstance(sentence.datestamp, date):
                self.day = float((sentence.datestamp - date(1970, 1, 1)).days)
            place = place if sentence.status == "A" else (math.nan, math.nan)
        elif sentence.gps_qual:
            hdop, altitude = number(sentence.data[7]), number(sentence.data[8])
        else:
            place = (math.nan, math.nan)
        before = values["second"][-1] if values["second"] else second
        if before - second > _DAY / 2 and sentence.sentence_type == "GGA":
            self.day += 1  # its RMC is still to come
        new = (self.day, second, *place, altitude, hdop)
        self.kinds = self.kinds if before == second else {}
        self.several += self.kinds.setdefault(sentence.sentence_type, place) != place
        if values["second"] and before == second:
            for column, value in zip(values.values(), new, strict=True):
                column[-1] = value if math.isnan(column[-1]) else column[-1]
        else:
            for column, value in zip(values.values(), new, strict=True):
                column.append(value)

    def columns(self) -> dict[str, Any]:
        """Columns by name; times with their date where a sentence has it."""
        columns = {name: np.array(values) for name, values in self.values.items()}
        day, second = columns.pop("day"), columns.pop("second")
        known = np.isfinite(day)
        if not known.any():
            wraps = np.cumsum(np.diff(second, prepend=second[:1]) < -_DAY / 2)
            return {"time": second + _DAY * wraps} | columns
        early = np.flatnonzero(known)[0]
        wraps = np.cumsum(np.diff(second[: early + 1], prepend=second[:1]) < -_DAY / 2)
        day[:early] = day[early] - wraps[-1] + wraps[:early]
        time = np.rint((day * _DAY + second) * 1e6).astype(np.int64).view("datetime64[us]")
        return {"time": time} | columns
