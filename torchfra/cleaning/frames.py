"""Cleaned tracks as tables of pandas, and flights of traffic, cleaned."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
import pandas as pd

from torchfra.cleaning import Cleaned
from torchfra.cleaning.clean import PREFIX, clean
from torchfra.cleaning.outputs.table import columns, united

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
