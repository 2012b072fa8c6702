"""Files of VBOX, which loggers of racing cars write: minutes of degrees, positive in the north and in the west."""

from __future__ import annotations

import re
from typing import Any

from torchfra.readers.columns import number, short
from torchfra.readers.sheets import Sheet, points_sheet, whole_text

_TIME = re.compile(r"([0-9]{2})([0-9]{2})([0-9]{2}(?:\.[0-9]*)?)")
_MINUTES = 60.0


def is_vbo(start: bytes, suffix: str) -> bool:
    """Whether a file is one, by how it begins or its ending."""
    return suffix == ".vbo" or b"[column names]" in start.lower()


def vbo_sheet(file: Any, max_bytes: int, encoding: str) -> Sheet:
    """The rows of a file: times of the day, UTC, degrees, and heights in metres.

    Source: Racelogic, VBOX file format (support.vboxautomotive.co.uk).

    Raises:
        ValueError: it has no names of columns, or a row that does not fit them.
    """
    sections, section = dict[str, list[str]](), ""
    for line in map(str.strip, whole_text(file, max_bytes, "VBO", encoding).splitlines()):
        if line.startswith("[") and line.endswith("]"):
            section = line.strip("[]").lower()
        elif line:
            sections.setdefault(section, []).append(line)
    names = " ".join(sections.get("column names", [])).lower().split()
    if missing := [name for name in ("time", "lat", "long") if name not in names]:
        raise ValueError(f"expected VBOX with [column names] and [data], missing {', '.join(missing)}")
    columns: dict[str, list[Any]] = {name: [] for name in ("time", "latitude", "longitude", "altitude")}
    for row, line in enumerate(sections.get("data", [])):
        cells = dict(zip(names, line.split(), strict=False))
        clock = _TIME.fullmatch(cells.get("time", ""))
        try:
            latitude, west, height = (number(cells.get(name)) for name in ("lat", "long", "height"))
        except ValueError:
            clock = None
        if clock is None:
            raise ValueError(f"expected time, lat, long and height in data row {row + 1}, received {short(line)}")
        columns["time"].append(":".join(clock.groups()))
        for name, value in (("latitude", latitude / _MINUTES), ("longitude", -west / _MINUTES), ("altitude", height)):
            columns[name].append(value)
    return points_sheet(columns, ("VBOX: minutes of degrees, positive in the west; times of the day are UTC",))
