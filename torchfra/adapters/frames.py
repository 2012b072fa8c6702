"""Tables of pandas and flights of traffic, in and out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from torchfra.cleaning import Cleaned
from torchfra.cleaning.clean import PREFIX, clean
from torchfra.cleaning.outputs.table import columns, united
from torchfra.motion.base import Motion
from torchfra.types import Estimate

KNOT, FOOT_A_MINUTE = 1852 / 3600, 0.3048 / 60
"""m/s."""
_BACK = {
    "latitude": ("latitude", 1.0), "longitude": ("longitude", 1.0), "altitude": ("altitude", 1.0),
    "speed": ("groundspeed", KNOT), "course": ("track", 1.0), "climb": ("vertical_rate", FOOT_A_MINUTE),
}  # fmt: skip
"""Columns of a cleaned track, those of a flight, and the unit of the latter."""
_READ = ("timestamp", "icao24", "callsign", "latitude", "longitude", "altitude")
"""Columns of a flight that are read."""
Flight = TypeVar("Flight")


def table(cleaned: Cleaned | Sequence[Cleaned]) -> pd.DataFrame:
    """Cleaned tracks as a table: a row for each estimate, the columns of ``torchfra track --out``."""
    several = [cleaned] if isinstance(cleaned, Cleaned) else list(cleaned)
    return pd.DataFrame(united([columns(one) for one in several]))


def estimates(estimate: Estimate, motion: Motion, time: Any = None) -> pd.DataFrame:
    """An estimate of one track as a table: means by the names of the components, ``std_*`` beside them, and ``nis``.

    Args:
        estimate: ``mean (T, n)``.
        motion: whose components they are.
        time: ``(T,)`` of the rows, which becomes the index; None for none.

    Raises:
        ValueError: a batch of tracks.
    """
    if estimate.mean.dim() != 2:
        raise ValueError(f"estimate: expected one track (T, n), received {tuple(estimate.mean.shape)}")
    std = estimate.scale_tril.square().sum(-1).sqrt()
    columns = {name: estimate.mean[:, i] for i, name in enumerate(motion.components)}
    columns |= {f"std_{name}": std[:, i] for i, name in enumerate(motion.components)} | {"nis": estimate.nis}
    index = None if time is None else pd.Index(time, name="time")
    return pd.DataFrame({name: x.detach().numpy() for name, x in columns.items()}, index=index)


def measurements(frame: Any, names: Sequence[str], *, time: str, by: str | None = None) -> tuple[Tensor, Tensor]:
    """Columns of a table as measurements, rows in order of time.

    Args:
        frame: a row for each measurement; of pandas or polars.
        names: of the columns that are measured.
        time: of the column that tells when, in seconds or moments.
        by: of the column that tells whose they are; None for one track.

    Returns:
        ``z (T, m)`` and ``dt (T - 1,)`` seconds from each to the next; with ``by`` ``(B, T, m)`` and ``(B, T - 1)``,
        shorter tracks filled up with NaN, and with steps of 1 s.

    Raises:
        ValueError: a column that is not there.
    """
    frame = frame if isinstance(frame, pd.DataFrame) else frame.to_pandas()
    for name in (*names, time, *([] if by is None else [by])):
        if name not in frame:
            raise ValueError(f"names: expected some of {', '.join(map(str, frame.columns))}, received {name}")
    groups = [frame] if by is None else [group for _, group in frame.groupby(by, sort=False)]
    tracks = [_track(group.sort_values(time, kind="stable"), names, time) for group in groups]
    if by is None:
        return tracks[0]
    most = max(len(z) for z, _ in tracks)
    pad = torch.nn.functional.pad
    z = torch.stack([pad(z, (0, 0, 0, most - len(z)), value=torch.nan) for z, _ in tracks])
    return z, torch.stack([pad(dt, (0, most - 1 - len(dt)), value=1.0) for _, dt in tracks])


def clean_flight(flight: Flight, **settings: Any) -> Flight:
    """A flight of traffic, cleaned: its positions, altitudes, speeds and courses are the estimates.

    Rows without an estimate keep what they have, and column ``outlier`` is the probability that a row's fix is wrong.

    Args:
        flight: a ``traffic.core.Flight``, or what else has a table ``data`` with its columns and is made of one.
        settings: of ``torchfra.clean``.

    Raises:
        ValueError: its table cannot be understood.
    """
    data: pd.DataFrame = flight.data  # type: ignore[attr-defined]
    read = data[[name for name in _READ if name in data]]
    found, result = clean(read.reset_index(drop=True), **settings), data.copy()
    for name, (column, unit) in _BACK.items():
        if column in result and PREFIX + name in found:
            new = found[PREFIX + name].to_numpy() / unit
            result[column] = np.where(np.isnan(new), data[column].to_numpy(dtype=float, na_value=np.nan), new)
    result["outlier"] = found[f"{PREFIX}outlier"].to_numpy()
    cleaned: Flight = type(flight)(result)  # type: ignore[call-arg]
    return cleaned


def _track(frame: pd.DataFrame, names: Sequence[str], time: str) -> tuple[Tensor, Tensor]:
    when = frame[time]
    seconds = (when - when.iloc[0]).dt.total_seconds() if pd.api.types.is_datetime64_any_dtype(when.dtype) else when
    z = torch.from_numpy(frame[list(names)].to_numpy(dtype=float, na_value=np.nan).copy())
    return z, torch.from_numpy(np.diff(seconds.to_numpy(dtype=float)))
