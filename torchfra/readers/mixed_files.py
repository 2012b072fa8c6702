"""Logs with rows of several kinds, of which those of fixes are read: of FitCSVTool, and of GnssLogger on a phone."""

from __future__ import annotations

import csv
import io
from typing import Any

from torchfra.readers.bounded import short_lines
from torchfra.readers.sheets import Sheet, points_sheet, whole_text

_FUSED = {"FLP", "FUSED"}
"""Providers of fixes that are made of those of others."""


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


def is_gnss_log(start: bytes) -> bool:
    """Whether a file that begins so is of GnssLogger."""
    return b"# Fix,Provider," in start


def gnss_sheet(file: Any, max_bytes: int) -> Sheet:
    """The fixes of a phone, without those that it made of the others.

    Source: google/gps-measurement-tools.

    Raises:
        ValueError: there are none, or too many lines.
    """
    names, rows = list[str](), list[list[str]]()
    for line in short_lines(file, max_bytes):
        if line.startswith("# Fix,"):
            names = line.removeprefix("# ").split(",")
        elif line.startswith("Fix,"):
            rows.append(line.split(","))
    if not rows:
        raise ValueError(
            "expected rows that begin with Fix, received none: have GnssLogger log locations too, or compute positions "
            "from its raw measurements, such as with RTKLIB"
        )
    own = [row for row in rows if row[1].upper() not in _FUSED] or rows
    fused = f"; {len(rows) - len(own):,} fused ones left out" if len(own) < len(rows) else ""
    columns = {name: [row[i] if i < len(row) else "" for row in own] for i, name in enumerate(names)}
    return points_sheet(columns, (f"GnssLogger: rows that begin with Fix{fused}",))
