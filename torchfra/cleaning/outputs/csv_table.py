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

_DIGITS = {"latitude": 8, "longitude": 8, "outlier": 4, "manoeuvre": 4, "regime": 4}
"""Decimal places, by the words of a column's name; other columns have three."""
_SPECIAL = re.compile('[,"\r\n]')
"""Signs for which a cell is quoted."""


def encode(results: Sequence[Cleaned]) -> bytes:
    """The rows of all targets under one header; an empty cell is a number that is not known."""
    table = united([columns(cleaned) for cleaned in results])
    header = ",".join(map(_quoted, table))
    formats, cells = zip(*(_cells(name, values) for name, values in table.items()), strict=True)
    row = ",".join(formats) + "\n"  # a whole row at once is faster than cell by cell
    text = "".join([header, "\n", *(row % values for values in zip(*filter(None, cells), strict=True))])
    return text.encode(errors="backslashreplace")


def _quoted(text: str) -> str:
    """A cell of any text, as ``csv.writer`` has it, which takes ten times as long, as it looks at numbers as well."""
    return '"' + text.replace('"', '""') + '"' if _SPECIAL.search(text) else text


def _cells(name: str, values: NDArray[Any]) -> tuple[str, list[Any]]:
    """The format of a column's cells, and their values; none where all are 0, as covariances of independent axes."""
    if values.dtype.kind in "iu":
        return "%s", ["" if name == "row" and v < 0 else v for v in values.tolist()]
    if values.dtype.kind != "f":
        # csv of Python 3.10 cannot read "\0".
        quoted = {v: _quoted(str(v).replace("\0", r"\x00")) for v in set(values.tolist())}
        return "%s", [quoted[v] for v in values.tolist()]
    if name.startswith(("cov_", "std_")):  # of any size: digits follow the value
        form, values = "%.6g" if name.startswith("cov_") else "%.4g", values + 0.0  # none is written as -0
    else:
        digits = max((_DIGITS.get(word, 3) for word in name.split("_")), default=3)
        form, values = f"%.{digits}f", np.where(np.abs(values) < 0.5 / 10**digits, 0.0, values)
    if not values.any():
        return form % 0.0, []
    if np.isfinite(values).all():
        return form, values.tolist()
    return "%s", [form % v if math.isfinite(v) else "" for v in values.tolist()]
