"""Tables as comma-separated text."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchfra.cleaning import Cleaned
from torchfra.cleaning.outputs.table import columns, united

_DIGITS = {"latitude": 8, "longitude": 8, "outlier": 4, "manoeuvre": 4}
"""Decimal places, by the words of a column's name; other columns have three."""
_PLACES = {"x", "y", "z", "latitude", "longitude", "altitude", "residual", "vx", "vy", "vz", "speed", "climb"}
"""Words of columns that have more where the path is finer: a tenth of its standard deviation is written."""
_SPECIAL = re.compile('[,"\r\n]')
"""Signs for which a cell is quoted."""


def encode(results: Sequence[Cleaned]) -> bytes:
    """The rows of all targets under one header; an empty cell is a number that is not known."""
    table = united([columns(cleaned) for cleaned in results])
    header = ",".join(map(_quoted, table))
    more = max(map(_more_digits, results))
    formats, cells = zip(*(_cells(name, values, more) for name, values in table.items()), strict=True)
    row = ",".join(formats) + "\n"  # a whole row at once is faster than cell by cell
    text = "".join([header, "\n", *(row % values for values in zip(*filter(None, cells), strict=True))])
    return text.encode(errors="backslashreplace")


def _quoted(text: str) -> str:
    """A cell of any text, as ``csv.writer`` has it, which takes ten times as long, as it looks at numbers as well."""
    return '"' + text.replace('"', '""') + '"' if _SPECIAL.search(text) else text


def _more_digits(cleaned: Cleaned) -> int:
    """Decimal places beyond three of a metre, or of the unit of x and y, that positions have."""
    variance = np.diagonal(cleaned.covariance, axis1=1, axis2=2)[:, : cleaned.raw.shape[1]]
    known = variance[variance > 0]
    if not len(known):
        return 0
    unit = cleaned.recording.source.unit if cleaned.recording.origin is None else 1.0
    return min(max(math.ceil(-math.log10(math.sqrt(known.min()) / unit / 10)) - 3, 0), 6)


def _cells(name: str, values: NDArray[Any], more: int) -> tuple[str, list[Any]]:
    """The format of a column's cells, and their values; none where all are 0, as covariances of independent axes.

    Args:
        name: of the column.
        values: its cells.
        more: decimal places that positions have beyond the usual ones.
    """
    if values.dtype.kind in "iu":
        return "%s", ["" if name == "row" and v < 0 else v for v in values.tolist()]
    if values.dtype.kind != "f":
        # csv of Python 3.10 cannot read "\0".
        quoted = {v: _quoted(str(v).replace("\0", r"\x00")) for v in set(values.tolist())}
        return "%s", [quoted[v] for v in values.tolist()]
    if name == "time":
        return "%s", [f"{v:.9f}".rstrip("0").rstrip(".") for v in values.tolist()]
    if name.startswith(("cov_", "std_")):  # of any size: digits follow the value
        form, values = "%.6g" if name.startswith("cov_") else "%.4g", values + 0.0  # none is written as -0
    else:
        words = name.split("_")
        digits = max((_DIGITS.get(word, 3) for word in words), default=3) + more * bool(_PLACES & {*words})
        form, values = f"%.{digits}f", np.where(np.abs(values) < 0.5 / 10**digits, 0.0, values)
    if not values.any():
        return form % 0.0, []
    if np.isfinite(values).all():
        return form, values.tolist()
    return "%s", [form % v if math.isfinite(v) else "" for v in values.tolist()]
