"""Tables as Apache Parquet."""

from __future__ import annotations

import json
from collections.abc import Sequence
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchfra.cleaning import Cleaned
from torchfra.cleaning.outputs.table import about, columns, united
from torchfra.readers.times import per_second


def encode(results: Sequence[Cleaned]) -> bytes:
    """The rows of all targets; a number that is not known is null, and what the columns hold is in the metadata.

    Raises:
        ImportError: pyarrow is missing.
    """
    import pyarrow
    from pyarrow import parquet

    table = united([columns(cleaned) for cleaned in results])
    if all(per_second(cleaned.recording.source.time) for cleaned in results):
        table["time"] = _numbers(table["time"])
    arrays = {
        name: pyarrow.array(values, from_pandas=True, mask=values < 0 if name == "row" else None)
        for name, values in table.items()
    }
    said = {"torchfra": json.dumps(about(list(table)))}
    file = BytesIO()
    parquet.write_table(pyarrow.table(arrays, metadata=said), file, compression="zstd")
    return file.getvalue()


def _numbers(texts: NDArray[np.str_]) -> NDArray[Any]:
    whole = not any("." in text for text in texts.tolist())
    return texts.astype(np.int64 if whole else np.float64)
