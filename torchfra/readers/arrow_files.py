"""Parquet and Feather (Arrow) files, read batch by batch."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

from torchfra.readers.bounded import check_size
from torchfra.readers.columns import Cells
from torchfra.readers.sheets import Sheet
from torchfra.running.optional import optional

_ROWS = 2**16
"""Of a batch of Parquet."""
_MAGIC = 8
"""Bytes before the messages of a Feather file."""


def is_arrow(start: bytes) -> bool:
    """Whether a file begins as Parquet or Arrow does."""
    return start[:4] == b"PAR1" or start[:6] == b"ARROW1"


def arrow_sheet(data: bytes, max_bytes: int) -> Sheet:
    """The columns of numbers, moments and text of a file.

    Raises:
        ValueError: it is damaged or holds too much.
        ImportError: pyarrow is not installed.
    """
    pyarrow = optional("pyarrow", "Parquet and Feather", "formats")
    try:
        schema, batches = _batches(data)
    except (pyarrow.ArrowException, OSError) as error:
        raise damaged(error) from error
    return Sheet([field.name for field in schema if is_flat(field.type)], _parts(batches, max_bytes))


def table_sheet(table: Any) -> Sheet:
    """The columns of numbers, moments and text of an Arrow table."""
    parts = [(batch.num_rows, partial(_cells, batch)) for batch in table.combine_chunks().to_batches()]
    return Sheet([field.name for field in table.schema if is_flat(field.type)], parts)


def damaged(error: Exception) -> ValueError:
    """The error for what is no complete file."""
    return ValueError(f"expected a complete Parquet or Feather file, received none ({' '.join(str(error).split())})")


def is_flat(kind: Any) -> bool:
    """Whether a column has numbers, moments, marks or text; others may unfold to any size."""
    from pyarrow import types

    kind = kind.value_type if types.is_dictionary(kind) else kind
    tests = (types.is_integer, types.is_floating, types.is_timestamp, types.is_date, types.is_boolean, types.is_string,
             types.is_large_string)  # fmt: skip
    return any(test(kind) for test in tests)


def _batches(data: bytes) -> tuple[Any, Iterator[Any]]:
    """The schema and the batches of a file; of Feather as of the stream that it is."""
    from pyarrow import BufferReader, ipc, parquet, types

    if data[:4] != b"PAR1":
        stream = BufferReader(data)
        stream.seek(_MAGIC)
        reader = ipc.open_stream(stream)
        return reader.schema, reader
    facts = parquet.ParquetFile(BufferReader(data))
    schema = facts.schema_arrow
    flat = [field.name for field in schema if is_flat(field.type)]
    # as dictionaries, so that a long text that comes again and again takes no more memory than it has in the file
    texts = [field.name for field in schema if types.is_string(field.type) or types.is_large_string(field.type)]
    return schema, parquet.ParquetFile(BufferReader(data), read_dictionary=texts).iter_batches(_ROWS, columns=flat)


def _parts(batches: Iterator[Any], max_bytes: int) -> Iterator[tuple[int, Cells]]:
    import pyarrow

    size = 0
    try:
        for batch in batches:
            size += batch.nbytes
            check_size(size, max_bytes, " of columns")
            batch.validate(full=True)
            yield batch.num_rows, partial(_cells, batch)
    except (pyarrow.ArrowException, OSError) as error:
        raise damaged(error) from error


def _cells(batch: Any, name: str) -> Any:
    """A column: an array of numbers or moments; or a list of texts, in memory once each."""
    from pyarrow import types

    column = batch.column(batch.schema.get_field_index(name))
    if types.is_dictionary(column.type):
        known = [*column.dictionary.to_pylist(), None]
        return [known[-1 if i is None else i] for i in column.indices.to_pylist()]
    text = types.is_string(column.type) or types.is_large_string(column.type)
    return column.to_pylist() if text else column.to_numpy(zero_copy_only=False)
