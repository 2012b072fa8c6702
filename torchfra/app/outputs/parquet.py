"""Tables as Apache Parquet."""

from __future__ import annotations

import json
from collections.abc import Sequence
from io import BytesIO

from torchfra.app.outputs.table import about, columns, united
from torchfra.cleaning import Cleaned


def encode(results: Sequence[Cleaned]) -> bytes:
    """The rows of all targets; a number that is not known is null, and what the columns hold is in the metadata.

    Raises:
        ImportError: pyarrow is missing.
    """
    import pyarrow
    from pyarrow import parquet

    table = united([columns(cleaned) for cleaned in results])
    arrays = {
        name: pyarrow.array(values, from_pandas=True, mask=values < 0 if name == "row" else None)
        for name, values in table.items()
    }
    said = {"torchfra": json.dumps(about(list(table)))}
    file = BytesIO()
    parquet.write_table(pyarrow.table(arrays, metadata=said), file, compression="zstd")
    return file.getvalue()
