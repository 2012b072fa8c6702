"""Messages of AIS, in which ships tell where they are, as receivers log them with times."""

from __future__ import annotations

import math
import re
from array import array
from collections import Counter
from functools import reduce
from operator import xor

import numpy as np
from numpy.typing import NDArray

from torchfra.readers.columns import in_seconds
from torchfra.readers.sheets import Sheet

_LINE = re.compile(
    r"(?:\\(?P<tags>[^\\]*)\\)?!(?P<said>[A-Z]{2}VD[MO],[1-9],(?P<part>[1-9]),[0-9]?,[AB12]?,(?P<payload>[0-W`-w]+),[0-5])"
    r"\*(?P<check>[0-9A-Fa-f]{2})(?:,(?:.*,)?(?P<behind>[0-9]{10,13}(?:\.[0-9]*)?))?\s*"
)
"""A message, the time in a tag block in front of it or behind it, s or ms since 1970."""
_TIME = re.compile(r"(?:^|,)c:([0-9]+)")
_PLACES = {1: 61, 2: 61, 3: 61, 18: 57, 19: 57}
"""The bit at which the longitude begins, by the types of messages with positions."""
_DEGREE = 600_000
"""Units of coordinates in a degree."""
_MINUTE, _LATE = 60.0, 10.0
"""Seconds: in a minute, and by which nearly all messages are received after their fix, but for an offset of clocks."""
_MOST = 0.9
"""Share of the messages of which that has to be so, or the seconds in them are not used."""


class Ships:
    """The positions of ships, message by message.

    Source: Recommendation ITU-R M.1371-5, annex 8; NMEA 0183 for the armour and for tag blocks.
    """

    def __init__(self) -> None:
        self.time, self.second, self.mmsi = array("d"), array("b"), array("q")
        self.latitude, self.longitude = array("d"), array("d")

    def add(self, line: str) -> str:
        """Adds what a line says; returns what it is: ``"AIS"``, ``"damaged AIS"`` or ``"other"``."""
        found = _LINE.fullmatch(line)
        if found is None or reduce(xor, found["said"].encode()) != int(found["check"], 16):
            return "damaged AIS" if re.search("!..VD[MO],", line) else "other"
        values = [code - (56 if code > 87 else 48) for code in found["payload"].encode()]
        bits = "".join(f"{value:06b}" for value in values)
        at = _PLACES.get(values[0], 0)
        if at and found["part"] == "1" and len(bits) >= at + 55:
            time = _TIME.search(found["tags"] or "")
            self.time.append(float(time[1] if time else found["behind"] or math.nan))
            self.second.append(int(bits[at + 76 : at + 82], 2) if len(bits) >= at + 82 else 63)
            self.mmsi.append(int(bits[8:38], 2))
            self.longitude.append(_signed(bits[at : at + 28]) / _DEGREE)
            self.latitude.append(_signed(bits[at + 28 : at + 55]) / _DEGREE)
        return "AIS"

    def sheet(self, lines: Counter[str]) -> Sheet | None:
        """The positions; None where no time is known.

        Args:
            lines: how many there were of what ``add`` calls them.
        """
        received, second = in_seconds(np.array(self.time)), np.array(self.second)
        if not np.isfinite(received).any():
            return None
        time, own = _of_the_fixes(received, second)
        columns = {
            "time": time, "mmsi": np.array(self.mmsi), "latitude": np.array(self.latitude),
            "longitude": np.array(self.longitude),
        }  # fmt: skip
        said = f"AIS: {len(time):,} positions (types 1, 2, 3, 18, 19) in {lines['AIS']:,} messages"
        said += "; times are the UTC seconds in them, not those of their reception" if own else ""
        said += f"; {lines['damaged AIS']:,} damaged ones left out" if lines["damaged AIS"] else ""
        return Sheet([*columns], [(len(self.time), columns.__getitem__)], (said,))


def _of_the_fixes(received: NDArray[np.float64], second: NDArray[np.int8]) -> tuple[NDArray[np.float64], bool]:
    """Times of the fixes, by the UTC second that messages hold, and whether these are used.

    A message without it was received as long after its fix as others.

    Args:
        received: ``(k,)`` times of reception, s since 1970.
        second: ``(k,)`` of the fix, 0 to 59; more where it is not known.
    """
    known = (second < _MINUTE) & np.isfinite(received)
    late = (received - second) % _MINUTE
    turn = 2 * math.pi / _MINUTE
    usual = math.atan2(np.sin(turn * late[known]).sum(), np.cos(turn * late[known]).sum()) / turn
    late = (late - usual + _MINUTE / 2) % _MINUTE - _MINUTE / 2 + usual
    fits = known & (np.abs(late - usual) < _LATE)
    if fits.sum() < _MOST * len(received):
        return received, False
    return np.where(known, np.round(received - late), received - usual), True


def _signed(bits: str) -> int:
    """A number in two's complement."""
    return int(bits, 2) - (int(bits[0]) << len(bits))
