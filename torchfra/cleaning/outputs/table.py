"""The table of a cleaned track: rows that join to those of the input, positions as the input has them, and more."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from torchfra.cleaning import Cleaned
from torchfra.cleaning.outputs.course import course
from torchfra.cleaning.outputs.times import dates
from torchfra.geodesy import Origin, to_geodetic
from torchfra.readers.columns import Array

Table: TypeAlias = dict[str, NDArray[Any]]

UNITS = {
    "row": "of the input, from 0; empty between its fixes",
    "id": "of the target",
    "time": "UTC in ISO 8601, or seconds as the input counts them",
    "seconds": "s since the first fix",
    "latitude": "degrees", "longitude": "degrees", "altitude": "as the input has it",
    "x": "as the input has it; m east of the origin", "y": "as the input has it; m north of the origin",
    "z": "as the input has it; m up of the origin",
    "vx": "m/s", "vy": "m/s", "vz": "m/s", "speed": "m/s over ground", "course": "degrees clockwise from north, or +y",
    "climb": "m/s", "std_along": "m, along the course", "std_across": "m, to its right", "std_up": "m",
    "nis": "normalised innovation squared", "outlier": "probability that the fix is an outlier",
    "residual": "m from fix to cleaned position",
    "manoeuvre": "probability of a manoeuvre", "flag": "outlier, manoeuvre, unclear, or empty",
    "cov_": "covariance, m and m/s", "raw_": "as recorded",
}  # fmt: skip
"""Descriptions of the columns, by their names or by the beginning of these."""


def columns(cleaned: Cleaned) -> Table:
    """The columns of a table by name, ``(T,)`` each.

    Positions are in the units of the input, all else is in m and s; ``UNITS`` says what each column holds.  Where the
    input has latitudes, x, y and z are m east, north and up of the origin.
    """
    recording, stamps, axes = cleaned.recording, dates(cleaned), "xyz"[: cleaned.raw.shape[1]]
    table: Table = {
        "row": _row(cleaned),
        "id": np.full(len(cleaned.time), recording.name),
        "time": recording.time[0] + cleaned.time if stamps is None else np.array(stamps),
        "seconds": cleaned.time,
    }
    unit = recording.source.unit if recording.origin is None else 1.0
    for prefix, position in (("raw_", cleaned.raw), ("", cleaned.position)):
        table |= _geodetic(cleaned, prefix)
        table |= {prefix + axis: position[:, i] / unit for i, axis in enumerate(axes)}
    table |= {f"v{axis}": cleaned.velocity[:, i] for i, axis in enumerate(axes)} | _course(cleaned)
    own = ("nis", "outlier", "residual", "manoeuvre", "flag")
    table |= {name: getattr(cleaned, name) for name in own}
    return table | _covariance(cleaned, axes)


def united(tables: Sequence[Table]) -> Table:
    """The rows of all tables, with the columns of any; cells that a table does not have are NaN or empty."""
    names = dict.fromkeys(name for table in tables for name in table)
    return {name: np.concatenate([_column(table, name, tables) for table in tables]) for name in names}


def _column(table: Table, name: str, tables: Sequence[Table]) -> NDArray[Any]:
    if name in table:
        return table[name]
    other = next(of[name] for of in tables if name in of)
    return np.full(len(table["row"]), np.nan if other.dtype.kind == "f" else "")


def about(names: list[str]) -> dict[str, str]:
    """Descriptions of columns, by their names."""
    return {name: _about(name) for name in names}


def _about(name: str) -> str:
    if name.startswith("raw_"):
        return f"{UNITS['raw_']}, {_about(name.removeprefix('raw_'))}"
    return UNITS.get(name) or UNITS[f"{name.split('_')[0]}_"]


def _row(cleaned: Cleaned) -> NDArray[np.int64]:
    """The row of the input that each step is, -1 between fixes."""
    rows = cleaned.recording.row
    return cleaned.row if rows is None else np.where(cleaned.row < 0, -1, rows[cleaned.row])


def recorded(cleaned: Cleaned, origin: Origin) -> Array:
    """Latitude and longitude in degrees, and altitude in m, of the fixes ``(2 or 3, T)``; NaN where missing."""
    place, d = cleaned.raw.copy(), cleaned.raw.shape[1]
    unknown = np.isnan(place[:, 2:]).any(1) & (cleaned.row >= 0)
    # East and north of these are those at the altitude that the reader has filled in.
    place[unknown, 2:] = cleaned.recording.position[cleaned.row[unknown], 2:]
    found = np.stack(to_geodetic(place, origin)[:d])
    found[2:, unknown] = np.nan
    return found


def _geodetic(cleaned: Cleaned, prefix: str) -> Table:
    """Latitude, longitude and altitude in the input's unit, where the input has them."""
    origin, unit = cleaned.recording.origin, cleaned.recording.source.unit
    if origin is None:
        return {}
    latitude, longitude, *altitude = recorded(cleaned, origin) if prefix else to_geodetic(cleaned.position, origin)
    table: Table = {f"{prefix}latitude": latitude, f"{prefix}longitude": longitude}
    return table | ({f"{prefix}altitude": altitude[0] / unit} if cleaned.raw.shape[1] == 3 else {})


def _course(cleaned: Cleaned) -> Table:
    found = course(cleaned)
    named = {"std_along": found.along, "std_across": found.across, "std_up": found.up}
    table = {"speed": found.speed, "course": found.course, "climb": found.climb} | named
    return {name: values for name, values in table.items() if values is not None}


def _covariance(cleaned: Cleaned, axes: str) -> Table:
    """The upper triangle, row by row."""
    names = [*axes, *(f"v{axis}" for axis in axes)]
    return {
        f"cov_{one}_{other}": cleaned.covariance[:, i, i + j]
        for i, one in enumerate(names)
        for j, other in enumerate(names[i:])
    }
