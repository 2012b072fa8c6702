"""Logs with rows of several kinds, of which those of fixes are read: of FitCSVTool, GnssLogger and ArduPilot."""

from __future__ import annotations

import csv
import io
import re
from typing import Any

from torchfra.readers.bounded import short_lines
from torchfra.readers.sheets import Sheet, points_sheet, whole_text

_FUSED = {"FLP", "FUSED"}
"""Providers of fixes that are made of those of others."""
_OF_THE_WEEK = {"GWk": "week", "GMS": "tow (ms)"}
"""What an autopilot calls weeks of GPS, and what of them has passed."""


def is_fit_csv(start: bytes) -> bool:
    """Whether a file that begins so is FIT as FitCSVTool writes it."""
    return start.startswith(b"Type,Local Number,Message,Field 1,")


def fit_sheet(file: Any, max_bytes: int, encoding: str) -> Sheet:
    """The messages ``record`` of FIT, whose cells are a name, a value and a unit for each field.

    Columns are called as in the other form that FitCSVTool has, such as ``record.position_lat[semicircles]``.

    Source: Garmin, FIT SDK, FitCSVTool.

    Raises:
        ValueError: there is none, or it is no CSV.
    """
    records = []
    try:
        rows = [*csv.reader(io.StringIO(whole_text(file, max_bytes, "FIT", encoding), newline=""))]
    except csv.Error as error:
        raise ValueError(f"expected FIT as FitCSVTool writes it, received other text ({error})") from error
    for row in rows:
        if row[:1] == ["Data"] and row[2:3] == ["record"]:
            fields = zip(row[3::3], row[4::3], row[5::3], strict=False)
            records.append({f"record.{name}[{unit}]": value for name, value, unit in fields if name})
    if not records:
        raise ValueError("expected FIT with messages called record, received none: no track was recorded")
    names = dict.fromkeys(name for record in records for name in record)
    columns = {name.removesuffix("[]"): [record.get(name) for record in records] for name in names}
    return points_sheet(columns, ("FIT as FitCSVTool writes it: messages called record",))


def is_log(start: bytes) -> bool:
    """Whether a file that begins so is of GnssLogger, or of an autopilot (ArduPilot)."""
    return b"# Fix,Provider," in start or re.match(b"FMT, ?[0-9]+,", start) is not None


def log_sheet(file: Any, max_bytes: int) -> Sheet:
    """The fixes of a phone, without those that it made of the others, or of the first receiver of an autopilot.

    Source: google/gps-measurement-tools; ArduPilot, DataFlash messages as text (Mission Planner, mavlogdump).

    Raises:
        ValueError: there are none, or too many lines.
    """
    names, rows, of = list[str](), list[list[str]](), "Fix"
    for line in short_lines(file, max_bytes):
        cells = [cell.strip() for cell in line.split(",")]
        if cells[0] == "# Fix":
            names = ["Fix", *cells[1:]]
        elif cells[0] == "FMT" and cells[3:4] == ["GPS"]:
            names, of = ["GPS", *(_OF_THE_WEEK.get(name, name) for name in cells[5:])], "GPS"
        elif cells[0] == of:
            rows.append(cells)
    if not rows:
        raise ValueError(
            f"expected rows that begin with {of}, received none: have GnssLogger log locations too, or compute "
            "positions from its raw measurements, such as with RTKLIB"
        )
    if of == "GPS":
        instance = names.index("I") if "I" in names else 0
        own = [row for row in rows if row[instance : instance + 1] == rows[0][instance : instance + 1]]
        said = "ArduPilot: messages GPS"
    else:
        own = [row for row in rows if row[1].upper() not in _FUSED] or rows
        fused = f"; {len(rows) - len(own):,} fused ones left out" if len(own) < len(rows) else ""
        said = f"GnssLogger: rows that begin with Fix{fused}"
    columns = {name: [row[i] if i < len(row) else "" for row in own] for i, name in enumerate(names)}
    return points_sheet(columns, (said,))
