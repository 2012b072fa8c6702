"""What a person is told where names do not say which columns hold a track: the columns, and options to copy."""

from __future__ import annotations

import re
from collections.abc import Mapping

from torchfra.readers.columns import Head, texts_of, values_of
from torchfra.readers.names import LENGTHS, found, name_words, unit
from torchfra.readers.options import AskError

_COLUMNS, _CELLS, _LONGEST = 20, 3, 24
"""Columns and cells of each that are listed, and signs of a cell."""
_OTHER = re.compile(
    r"\b(?:sd[a-z]*|sv|sat|satellite|beacon|anchor|tag|home|ref|vel|velocity|speed|acc|accel|gyro|mag|std|sigma|err|error|cov|"
    r"orientation|rotation|quaternion|angular|linear|score|likelihood|confidence|size|width|height|direction|heading|"
    r"range|rssi|snr|counter|index|idx|seq|ecef|[agmvw][xyz]|q[xyzw])\b"
)
"""In the words of a name, what is no position of the target."""
_TIMES = {"time", "timestamp", "ts", "date", "datetime", "stamp", "clock", "frame", "frames"}
_PAIRS = (("lat", "lon", "latitude", "longitude"), ("lat", "lon", "lat", "lng"), ("lat", "lon", "lat", "lon"),
          ("x", "y", "x", "y"), ("x", "y", "east", "north"))  # fmt: skip
"""Two options, and the words of names that tell their columns apart."""


def unclear(head: Head, lacking: str, known: Mapping[str, str]) -> AskError:
    """The error for columns that are not understood.

    Args:
        head: of the table.
        lacking: what is.
        known: columns by the option that names them, as far as they are understood.
    """
    options = {**_likely(head, known), **known}
    pair = next((pair for pair in (("lat", "lon"), ("x", "y")) if options.keys() & {*pair}), ("x", "y"))
    degrees = () if options.keys() & {*pair} else (" (or ", {"lat": "LAT", "lon": "LON"}, ")")
    options = {name: options.get(name, name.upper()) for name in ("time", *pair)}
    cells = {name: texts_of(head.cells(name))[:_CELLS] for name in head.names[:_COLUMNS] if name}
    listed = [f"{name} ({', '.join(text[:_LONGEST] for text in texts) or 'empty'})" for name, texts in cells.items()]
    more = f" and {len(head.names) - _COLUMNS} more" if len(head.names) > _COLUMNS else ""
    return AskError(f"expected {lacking}, which no name of a column says: name columns, or number them from 1 on, such "
                    "as ", options, *degrees, f"; columns: {', '.join(listed)}{more}")  # fmt: skip


def _likely(head: Head, known: Mapping[str, str]) -> dict[str, str]:
    """Options for the columns whose names say it."""
    names = [name for name in head.names if name and name not in known.values()]
    times = [one for one in names if {*name_words(one)} & _TIMES or found([one], "time")]
    options = {"time": times[0]} if times else {}
    keys = {" ".join(name_words(name)): name for name in names if name not in times}
    for one, other, first, second in _PAIRS:
        for key, name in keys.items():
            for at in (match.start() for match in re.finditer(first, key) if not _OTHER.search(key)):
                partner = keys.get(key[:at] + second + key[at + len(first) :], "")
                whole = len(values_of(texts := texts_of(head.cells(name)[:200]))) == len(texts) > 0
                if partner and whole and not (one == "lat" and unit(name) in LENGTHS):
                    return options | {one: name, other: partner}
    return options
