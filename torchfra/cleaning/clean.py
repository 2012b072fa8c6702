"""``torchfra.clean`` and ``torchfra.track``: tracks from files, tables and arrays, cleaned by one call."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from torchfra.cleaning import DEFAULT, Cleaned, clean_tracks
from torchfra.cleaning.outputs.summary import report
from torchfra.cleaning.outputs.table import columns
from torchfra.numbers import unmasked
from torchfra.readers import MAX_BYTES, Recording, read
from torchfra.readers.options import read_options
from torchfra.readers.reading import read_sheet
from torchfra.readers.sheets import Sheet
from torchfra.running.optional import optional

if TYPE_CHECKING:
    from torchfra.motion.bank import Bank

PREFIX = "clean_"
"""In front of the names of columns that are added to a table."""
_PLACES = {"x", "y", "z", "lat", "lon"}
"""Arguments that name the columns of positions."""
_LATITUDE, _LONGITUDE = "latitude", "longitude"
_TIMES = ("datetime64", "timedelta64")
"""Types of an index with times."""
_LEFT_OUT = ("row", "id", "time", "seconds")
"""Columns of an output that the table of the caller has already."""


def clean(
    data: Any,
    *,
    filter: str = DEFAULT,
    bank: str | Bank | None = None,
    sigma: float | None = None,
    q: float | None = None,
    smooth: bool = True,
    dt: float | None = None,
    repair: bool = True,
    jobs: int = 1,
    max_bytes: int = MAX_BYTES,
    **words: Any,
) -> Any:
    """Cleans tracks: estimates of positions with their covariances, outliers and manoeuvres.

    Args:
        data: the path of a file; a ``DataFrame`` of pandas or polars, or a ``GeoDataFrame`` of points in any coordinate
            reference system; ``(time (k,), position (k, d))``, seconds or moments that increase, and metres in 2 or 3
            dimensions, where missing NaN; or recordings of ``torchfra.readers.read``.
        filter: its name, one of ``catalogue.track_filters()``.
        bank: kind of targets: ``"aircraft"``, ``"ship"``, ``"vehicle"``, ``"person"``, ``"marine"`` (what swims),
            ``"animal"`` or ``"bird"``, or a ``Bank`` of motions; None takes what the
            file says, or bounds the motion by nothing but its own speed.
        sigma: standard deviation of a fix per axis, m; where fixes have their own, a factor on those.  None finds it.
        q: density of the process noise per second, m^2/s^3.  None finds it.
        smooth: whether estimates are smoothed, and not only filtered.
        dt: seconds; also estimates at every time that is a multiple of it, such as whole hours; not of a ``DataFrame``.
        repair: whether fixes with wrong time stamps are first moved along the path, where tracks show such errors: see
            ``cleaning.clean_tracks``.
        jobs: the most processes that share the work of the default filter, where there are 20,000 fixes or more for
            each; with more than 1 a script needs ``if __name__ == "__main__":``.
        max_bytes: that a file may hold, unpacked.
        words: columns by name, such as ``time="when", lat="breite"``, and their formats: see
            ``readers.ReadOptions``.

    Returns:
        For a ``DataFrame`` a copy with its index and columns, and new columns ``clean_latitude`` or ``clean_x``, ...,
        ``clean_speed``, ``clean_outlier``, ``clean_flag`` and others: positions in the units of the input, all else in
        m and s.  Rows that hold no fix, or one at the time of another, have NaN there.  Its ``attrs["torchfra"]`` says
        in lines what was read as what, and what became of it (not of polars).  A ``GeoDataFrame`` stays one
        and gets ``clean_geometry`` too, points in its own coordinate reference system.  For arrays a ``Cleaned``, and
        for a path or recordings a list of them, one for each target.

    Raises:
        ValueError: the data cannot be understood, or a value is out of its range.
        ImportError: what reads a file is not installed.
        ChildProcessError: a process was killed, for example when memory ran out.
    """
    settings: dict[str, Any] = {"filter": filter, "bank": bank, "sigma": sigma, "q": q, "smooth": smooth, "dt": dt,
                                "repair": repair, "jobs": jobs}  # fmt: skip
    if _is_frame(data, "polars"):
        for needed in ("pandas", "pyarrow"):
            optional(needed, "a DataFrame of polars", "frames")
        return sys.modules["polars"].from_pandas(clean(data.to_pandas(), max_bytes=max_bytes, **settings, **words))
    if isinstance(data, str | Path):
        return clean_tracks(read(data, max_bytes=max_bytes, **words), **settings)
    if _is_frame(data):
        if dt is not None:
            raise ValueError(f"dt: expected None for a DataFrame, whose rows are kept, received {dt}")
        points = None if words.keys() & _PLACES else _points(data)
        table = data if points is None else data.drop(columns=points.name).assign(**_coordinates(points))
        reading = words if points is None else {"lat": _LATITUDE, "lon": _LONGITUDE, **words}
        recordings = read_sheet(_sheet_of_frame(table), "DataFrame", **reading)
        results = clean_tracks(recordings, **settings)
        joined = _joined(data, results)
        joined = joined if points is None else _with_points(joined, points)
        joined.attrs["torchfra"] = "\n".join([*recordings[0].source.notes, *report(results, verbose=True)])
        return joined
    if isinstance(data, Sequence) and data and all(isinstance(one, Recording) for one in data):
        return clean_tracks(data, **settings)
    (cleaned,) = clean_tracks([_recording_of_arrays(data, words)], **settings)
    return cleaned


def track(data: object, **settings: Any) -> Any:
    """As ``clean``, on line: every estimate depends on the fixes up to its step only."""
    return clean(data, **{"smooth": False, **settings})


# ---------------------------------------------------------------- tables


def _is_frame(data: object, library: str = "pandas") -> bool:
    """Whether data is a ``DataFrame`` of pandas, or of another library; does not import it."""
    module = sys.modules.get(library)
    return module is not None and isinstance(data, module.DataFrame)


def _points(frame: object) -> Any:
    """The points of a ``GeoDataFrame``; None for other tables, without an import of geopandas.

    Raises:
        ValueError: other geometries than points, or no coordinate reference system.
    """
    geopandas = sys.modules.get("geopandas")
    if geopandas is None or not isinstance(frame, geopandas.GeoDataFrame) or frame.active_geometry_name is None:
        return None
    points = frame.geometry
    others = sorted(set(points.geom_type.dropna()) - {"Point"})
    if others:
        raise ValueError(f"data: expected points as geometry, received {', '.join(others)}")
    if points.crs is None:
        raise ValueError("data: expected points with a coordinate reference system (set_crs), received none")
    return points


def _coordinates(points: Any) -> dict[str, Any]:
    """Degrees, and metres of altitude where there are any, as columns; NaN where a point is missing."""
    degrees = points.to_crs(4326)
    columns = {_LATITUDE: degrees.y, _LONGITUDE: degrees.x}
    return columns | {"altitude": degrees.z} if points.has_z.any() else columns


def _with_points(frame: Any, points: Any) -> Any:
    """A cleaned table with the cleaned points, in the coordinate reference system of the recorded ones."""
    series = sys.modules["geopandas"].GeoSeries
    where = [frame[PREFIX + name] for name in (_LONGITUDE, _LATITUDE)]
    height = frame[f"{PREFIX}altitude"] if points.has_z.any() else None
    cleaned = series.from_xy(*where, height, crs=4326).where(where[0].notna()).to_crs(points.crs)
    return frame.assign(**{f"{PREFIX}geometry": cleaned})


def _sheet_of_frame(frame: Any) -> Sheet:
    """The columns of a table; its index too if it has times or levels, and no column has its name."""
    table = {str(name): frame.iloc[:, i] for i, name in enumerate(frame.columns)}
    if len(table) < frame.shape[1]:
        raise ValueError("data: expected every column once, received several of the same name")
    if taken := [name for name in table if name.startswith(PREFIX)]:
        raise ValueError(f"data: expected columns that are not cleaned yet, received {taken[0]}")
    index = frame.index
    levels = dict[str, Any]()
    for i, name in enumerate(index.names):
        level = index.get_level_values(i)
        other = "time" if level.inferred_type in _TIMES else f"level_{i}"  # as pandas calls what has no name
        levels[str(other if name is None else name)] = level
    if index.nlevels > 1 or index.inferred_type in _TIMES:
        table |= {name: level.to_series() for name, level in levels.items() if name not in table}
    return Sheet([*table], [(len(frame), lambda name: _cells(table[name]))])


def _cells(column: Any) -> Any:
    """A column of a table as an array; text as objects."""
    kind = sys.modules["pandas"].api.types
    if kind.is_datetime64_any_dtype(column.dtype):
        return column.to_numpy(dtype="datetime64[ns]")
    if kind.is_timedelta64_dtype(column.dtype):
        return column.dt.total_seconds().to_numpy()
    if isinstance(column.dtype, sys.modules["pandas"].PeriodDtype):
        return _cells(column.dt.to_timestamp())
    if kind.is_numeric_dtype(column.dtype) and not kind.is_bool_dtype(column.dtype):
        return column.to_numpy(dtype=np.float64, na_value=np.nan)
    cells = [None if missing else cell for cell, missing in zip(column.tolist(), column.isna().tolist(), strict=True)]
    return _moments(cells)


def _moments(cells: list[Any]) -> Any:
    """Cells that are all a ``datetime`` or None as an array, UTC where they name no zone; others as they are."""
    if not any(cells) or not all(cell is None or isinstance(cell, datetime) for cell in cells):
        return cells
    plain = [cell.astimezone(timezone.utc).replace(tzinfo=None) if cell and cell.tzinfo else cell for cell in cells]
    return np.array(plain, "datetime64[us]")


def _joined(frame: Any, several: Sequence[Cleaned]) -> Any:
    """A copy of a table with new columns."""
    new: dict[str, NDArray[Any]] = {}
    for cleaned in several:
        table = columns(cleaned)
        for name, values in table.items():
            if name not in _LEFT_OUT and not name.startswith(("raw_", "cov_")):
                empty = np.full(len(frame), np.nan) if values.dtype.kind == "f" else np.full(len(frame), "", object)
                new.setdefault(PREFIX + name, empty)[table["row"]] = values
    pandas = sys.modules["pandas"]
    return pandas.concat([frame, pandas.DataFrame(new, index=frame.index)], axis=1)


# ---------------------------------------------------------------- arrays


def _recording_of_arrays(data: object, words: dict[str, Any]) -> Recording:
    """The track of times and positions; where a position is NaN it has a step too, without a fix.

    Raises:
        ValueError: it is no pair of times and positions, or these cannot be read.
    """
    if not isinstance(data, tuple | list) or len(data) != 2:
        poses = ": take torchfra.adapters.poses.clean" if type(data).__module__.startswith("xarray.") else ""
        expected = "a path, a DataFrame, recordings or (time, position)"
        raise ValueError(f"data: expected {expected}, received {type(data).__name__}{poses}")
    time, position = np.asarray(unmasked(data[0])), np.array(unmasked(data[1]), dtype=np.float64)
    if time.dtype == object:
        time = np.asarray(_moments(time.tolist()))
    if time.ndim != 1 or position.ndim != 2 or position.shape[0] != len(time) or position.shape[1] not in (2, 3):
        raise ValueError(
            f"data: expected time (k,) and position (k, 2) or (k, 3), received {time.shape}, {position.shape}"
        )
    missing = np.isnan(position) | np.isin(position, read_options(words).absent)
    known = np.where(missing.any(1), -1, np.arange(len(time)))
    last = np.maximum.accumulate(known)  # of each row, that of the last whole position; else of the first
    if (known >= 0).any():
        position = np.where(missing, position[np.where(last < 0, (known >= 0).argmax(), last)], position)
    table = {"t": time, **{axis: position[:, i] for i, axis in enumerate("xyz"[: position.shape[1]])}}
    sheet = Sheet([*table], [(len(time), table.__getitem__)])
    (recording,) = read_sheet(sheet, "data", **words)
    assert recording.row is not None
    if not np.array_equal(recording.row, np.arange(len(time))):
        received = ", ".join(f"{count} {what}" for what, count in recording.repairs.items())
        raise ValueError(
            f"data: expected times that increase, so that there is a step for each, received {received}: put them in "
            "order, or hand over a DataFrame, whose rows are kept"
        )
    gone = missing[recording.row][:, : recording.position.shape[1]]
    return replace(recording, position=np.where(gone, np.nan, recording.position))
