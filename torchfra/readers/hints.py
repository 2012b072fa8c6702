"""What a person is told where names do not say which columns hold a track: the columns, and options to copy."""

from __future__ import annotations

import re
from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from torchfra.readers.columns import Array, Head, texts_of, values_of
from torchfra.readers.names import LENGTHS, found, name_words, plain, unit
from torchfra.readers.options import AskError
from torchfra.readers.times import forms_of

_COLUMNS, _CELLS, _LONGEST = 20, 3, 24
"""Columns and cells of each that are listed, and signs of a cell."""
_OTHER = re.compile(
    r"\b(?:sd[a-z]*|sv|sat|satellite|beacon|anchor|tag|home|ref|vel|velocity|speed|acc|accel|gyro|mag|std|sigma|err|error|cov|"
    r"orientation|rotation|quaternion|angular|linear|score|likelihood|confidence|size|width|height|direction|heading|"
    r"range|rssi|snr|counter|index|idx|seq|[agmvw][xyz]|q[xyzw])\b"
)
"""In the words of a name, what is no position of the target."""
_TIMES = {"time", "timestamp", "ts", "date", "datetime", "stamp", "clock"}
_FINE = re.compile(r"[+-]?[0-9]{1,3}\.[0-9]{4,}")
"""A latitude or longitude to 10 m or better."""


def unclear(head: Head, lacking: str, known: Mapping[str, str]) -> AskError:
    """The error for columns that are not understood.

    Args:
        head: of the table.
        lacking: what is.
        known: columns by the option that names them, as far as they are understood.
    """
    options = {**likely(head, known), **known}
    pair = next((pair for pair in (("lat", "lon"), ("x", "y")) if options.keys() & {*pair}), ("x", "y"))
    options = {name: options.get(name, name.upper()) for name in ("time", *pair)} | {
        name: options[name] for name in ("time_format", "units") if name in options}  # fmt: skip
    cells = {name: texts_of(head.cells(name))[:_CELLS] for name in head.names[:_COLUMNS] if name}
    listed = [f"{name} ({', '.join(text[:_LONGEST] for text in texts) or 'empty'})" for name, texts in cells.items()]
    more = f" and {len(head.names) - _COLUMNS} more" if len(head.names) > _COLUMNS else ""
    return AskError(f"expected {lacking}, which no name of a column says: name columns, or number them from 1 on, such "
                    "as ",
                    options, f"; columns: {', '.join(listed)}{more}")  # fmt: skip


def likely(head: Head, known: Mapping[str, str]) -> dict[str, str]:
    """Options for the columns that are most likely meant, as far as something says so."""
    names = [name for name in head.names if name and name not in known.values()]
    texts = {name: texts_of(head.cells(name)[:200]) for name in names}
    values = {name: values_of(texts[name]) for name in names}
    values = {name: column for name, column in values.items() if len(column) and len(column) == len(texts[name])}
    places = _by_names(values) or _of_degrees(values, texts)
    rest = [name for name in names if name not in places.values()]
    said = [
        one for one in rest if {*name_words(one)} & _TIMES or found([one], "time") or plain(one).startswith("frame")
    ]
    growing = [name for name, column in values.items() if len(column) > 1 and (np.diff(column) > 0).all()]
    written = [one for one in rest if one not in values and texts[one] and forms_of(texts[one][:20])]
    first = [name for name in growing if name == head.names[0] and name in rest]
    times = [*(name for name in said if name in (*growing, *written)), *written, *said, *first]
    times = [known["time"]] if "time" in known else times
    options = {"time": times[0]} if times else {}
    if plain(times[0] if times else "").startswith("frame"):
        options["time_format"] = "25fps"
    return options | (places or _that_vary({name: values[name] for name in values if name not in times[:1]}))


def _by_names(values: Mapping[str, Array]) -> dict[str, str]:
    """The first columns whose names differ in latitude and longitude, or in x and y, alone."""
    keys = {" ".join(name_words(name)): name for name in values}
    pairs = (("lat", "lon", "latitude", "longitude"), ("lat", "lon", "lat", "lng"), ("lat", "lon", "lat", "lon"),
             ("x", "y", "x", "y"), ("x", "y", "east", "north"))  # fmt: skip
    for one, other, first, second in pairs:
        for key, name in keys.items():
            ends = [m.start() for m in re.finditer(first, key)] if not _OTHER.search(key) else []
            for at in ends:
                partner = keys.get(key[:at] + second + key[at + len(first) :])
                metres = one == "lat" and unit(name) in LENGTHS
                if partner is not None and "ecef" not in key and not metres:
                    return {one: name, other: partner} | ({"units": "mm"} if unit(name) in ("px", "pixel") else {})
    return {}


def _of_degrees(values: Mapping[str, Array], texts: Mapping[str, list[str]]) -> dict[str, str]:
    """Two columns side by side that look like degrees."""
    fine = {
        name: column
        for name, column in values.items()
        if sum(map(bool, map(_FINE.fullmatch, texts[name]))) > len(column) / 2 and np.abs(column).max() <= 180
    }
    for one, other in pairwise(fine):
        if np.abs(fine[one]).max() <= 90 and min(np.abs(np.median(fine[name])) for name in (one, other)) > 1:
            return {"lat": one, "lon": other}
    return {}


def _that_vary(values: Mapping[str, Array]) -> dict[str, str]:
    """The first two columns that vary as positions do, where columns have no names but numbers."""
    vary = [name for name, column in values.items() if len(np.unique(column)) > len(column) / 2]
    return {"x": vary[0], "y": vary[1]} if len(vary) > 1 and vary[0].isdigit() else {}
