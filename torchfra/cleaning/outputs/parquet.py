"""Tables as Apache Parquet."""

from __future__ import annotations

import json
from collections.abc import Sequence
from io import BytesIO
from typing import IO, Any

from torchfra.cleaning import Cleaned
from torchfra.cleaning.outputs.table import Table, about, columns, united

_PACKED = "zstd"


def encode(results: Sequence[Cleaned]) -> bytes:
    """The rows of all targets; an unknown number is null, and descriptions of the columns are in the metadata.

    Raises:
        ImportError: pyarrow is missing.
    """
    from pyarrow import parquet

    table = united([columns(cleaned) for cleaned in results])
    file = BytesIO()
    parquet.write_table(_arrow(table), file, compression=_PACKED)
    return file.getvalue()


class Growing:
    """A file that grows by some targets at a time; files of the same data set have the same columns.

    Args:
        file: open for writing.
        like: any target of the data set, of as many dimensions as any.
    """

    def __init__(self, file: IO[bytes], like: Cleaned) -> None:
        from pyarrow import parquet

        self._empty = {name: values[:0] for name, values in columns(like).items()}
        self._schema = self._arrow([]).schema
        self._writer = parquet.ParquetWriter(file, self._schema, compression=_PACKED)

    def add(self, results: Sequence[Cleaned]) -> None:
        """Adds the rows of some targets."""
        self._writer.write_table(self._arrow(results))

    def close(self) -> None:
        """Ends the file."""
        self._writer.close()

    def _arrow(self, results: Sequence[Cleaned]) -> Any:
        return _arrow(united([self._empty, *(columns(cleaned) for cleaned in results)]))


def _arrow(table: Table) -> Any:
    """A table of Arrow."""
    import pyarrow

    arrays = {
        name: pyarrow.array(values, from_pandas=True, mask=values < 0 if name == "row" else None)
        for name, values in table.items()
    }
    return pyarrow.table(arrays, metadata={"torchfra": json.dumps(about(list(table)))})
