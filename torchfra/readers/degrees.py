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
