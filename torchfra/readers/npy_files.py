"""Arrays of numpy in ``.npy``: columns by their numbers from 1 on, or by the names of their fields."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from torchfra.readers.bounded import BYTES_OF_A_ROW, too_large
from torchfra.readers.columns import Head
from torchfra.readers.guesses import looks_like
from torchfra.readers.options import ReadOptions
from torchfra.readers.sheets import Sheet

_KINDS = "fiuMUS"
"""Of columns that are read: numbers, moments and text, of characters or bytes."""
_OTHERWISE = "hand it to torchfra.clean as (time, position), or write CSV by np.savetxt"


def is_npy(start: bytes) -> bool:
    """Whether a file begins as one of numpy."""
    return start.startswith(b"\x93NUMPY")


def npy_sheet(file: Any, options: ReadOptions | None, headers: str, max_bytes: int) -> Sheet:
    """The columns of a file.

    Raises:
        ValueError: it is damaged, too large, no table, or columns by numbers are not named by ``options``.
    """
    columns = dict[str, Any]()
    try:
        array = np.load(io.BytesIO(file.read()), allow_pickle=False)
    except (ValueError, EOFError, MemoryError, OSError) as error:
        raise ValueError(f"expected a complete array of numbers, received none ({error}): {_OTHERWISE}") from error
    if array.ndim and not len(array):
        raise ValueError("expected a track, received an array without rows")
    if array.ndim and len(array) * BYTES_OF_A_ROW > max_bytes:
        raise too_large(max_bytes, f"of an array, of which a row counts for {BYTES_OF_A_ROW} or more")
    if array.dtype.names is not None and array.ndim == 1:
        columns = {name: array[name] for name in array.dtype.names if array.dtype[name].kind in _KINDS}
    elif array.ndim == 2 and array.dtype.kind in _KINDS:
        columns = {str(i + 1): array[:, i] for i in range(array.shape[1])}
        if options is not None and not options.named(columns) & {*columns}:
            like = looks_like(Head([*columns], lambda name: columns[name][:100]))
            raise ValueError(f"{headers}; an array has columns 1 to {len(columns)}{like}")
    else:
        shape = f"one of shape {array.shape} and {array.dtype}"
        raise ValueError(f"expected an array of rows and columns, or of named fields, received {shape}: {_OTHERWISE}")
    cells = {name: _texts(column) if column.dtype.kind in "US" else column for name, column in columns.items()}
    return Sheet([*cells], [(len(array), cells.__getitem__)], ("an array of numpy",))


def _texts(column: Any) -> list[str]:
    """The cells of a column of text, whose bytes are UTF-8."""
    return [cell.decode("utf-8", "replace") if isinstance(cell, bytes) else cell for cell in column.tolist()]
