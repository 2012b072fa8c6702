"""Latitudes and longitudes in text: with a letter for the side, or as degrees, minutes and seconds."""

from __future__ import annotations

import re

_NUMBER = r"[0-9]+(?:[.,][0-9]*)?(?:e[+-][0-9]+)?"
_DEGREES = re.compile(
    rf"(?P<front>[NSEWnsew]?)\s*(?P<sign>[+-]?)(?P<degrees>{_NUMBER})\s*(?:°|\u00ba|deg)?"
    rf"(?:(?:(?<=[°\u00ba:])|(?<=deg)|\s|:)\s*(?P<minutes>{_NUMBER})\s*['\u2032\u2019]?"
    rf"(?:(?:(?<=['\u2032\u2019])|\s|:)\s*"
    rf"(?P<seconds>{_NUMBER})\s*(?:[\"\u2033\u201d]|''|\u2032\u2032)?)?)?\s*(?P<back>[NSEWnsew]?)"
)
_COMPACT = 100
"""Degrees and minutes in one number are the former times this, and the latter."""


def degrees_of(text: str, sides: str) -> float:
    """Degrees from text such as ``47.5 N``, ``8°32'15.2"E`` or ``-8 32 15.2``.

    Args:
        text: a cell.
        sides: the letters for above and below 0: ``"NS"`` or ``"EW"``.

    Raises:
        ValueError: it is something else.
    """
    found = _DEGREES.fullmatch(text.strip())
    if found is None or (found["front"] and found["back"]):
        raise ValueError(f"expected degrees, received {text!r}")
    parts = [(part or "0").replace(",", ".") for part in found.group("degrees", "minutes", "seconds")]
    degrees, minutes, seconds = map(float, parts)
    whole = all("." not in part for part, finer in zip(parts, found.group("minutes", "seconds"), strict=False) if finer)
    side = (found["front"] or found["back"]).upper()
    if not whole or minutes >= 60 or seconds >= 60 or (side and (side not in sides or found["sign"])):
        raise ValueError(f"expected degrees, received {text!r}")
    below = found["sign"] == "-" or side == sides[1]
    return (-1 if below else 1) * (degrees + minutes / 60 + seconds / 3600)


def advice(values: list[float], others: list[float], limit: float) -> str:
    """What an error message says of degrees beyond a limit.

    Args:
        values: some of the column.
        others: of the other coordinate.
        limit: of the column: 90 of latitudes, 180 of longitudes.
    """
    if not values or max(map(abs, values)) <= limit:
        return ""
    if limit == 90 and others and max(map(abs, values)) <= 180 and max(map(abs, others)) <= 90:
        return ", which looks like a longitude: latitudes and longitudes seem to be swapped, --lat and --lon name them"
    if all(abs(value) % _COMPACT < 60 for value in values):
        return (
            ", which looks like degrees and minutes in one number, such as 4730.5 for 47 degrees and 30.5 minutes: "
            "write degrees + minutes / 60"
        )
    return ""
