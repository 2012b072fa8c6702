"""Tables as comma-separated text."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchfra.cleaning import Cleaned
from torchfra.cleaning.outputs.table import columns, united

_DIGITS = {"latitude": 8, "longitude": 8, "outlier": 4, "manoeuvre": 4, "regime": 4}
"""Behind the point, by the words of a column's name; others have three."""
_SPECIAL = re.compile('[,"\r\n]')
"""Signs for which a cell is quoted."""


def encode(results: Sequence[Cleaned]) -> bytes:
    """The rows of all targets under one header; an empty cell is a number that is not known."""
    table = united([columns(cleaned) for cleaned in results])
    rows = zip(*([_quoted(name), *_cells(name, values)] for name, values in table.items()), strict=True)
    return "".join(",".join(row) + "\n" for row in rows).encode(errors="backslashreplace")


def _quoted(text: str) -> str:
    """A cell of any text, as ``csv.writer`` has it, which takes ten times as long, as it looks at numbers as well."""
    return '"' + text.replace('"', '""') + '"' if _SPECIAL.search(text) else text


def _cells(name: str, values: NDArray[Any]) -> list[str]:
    if values.dtype.kind in "iu":
        return ["" if name == "row" and v < 0 else str(v) for v in values.tolist()]
    if values.dtype.kind != "f":
        # csv of Python 3.10 cannot read "\0".
        return [_quoted(str(v).replace("\0", r"\x00")) for v in values.tolist()]
    if name.startswith("cov_"):
        cells = [f"{v + 0.0:.6g}" for v in values.tolist()]
    else:
        digits = max((_DIGITS.get(word, 3) for word in name.split("_")), default=3)
        shown = np.where(np.abs(values) < 0.5 / 10**digits, 0.0, values)  # none is written as -0.000
        cells = list(map(f"%.{digits}f".__mod__, shown.tolist()))
    for i in np.flatnonzero(~np.isfinite(values)):
        cells[i] = ""
    return cells
