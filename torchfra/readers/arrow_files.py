"""Parquet and Feather (Arrow) files, read batch by batch and only the columns that are wanted."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from torchfra.readers.bounded import BYTES_OF_A_ROW, too_large
from torchfra.readers.columns import Cells
from torchfra.readers.sheets import Sheet, needs

_ROWS = 2**16
"""Of a batch."""


def is_arrow(start: bytes) -> bool:
    """Whether a file begins so."""
    return start[:4] in (b"PAR1", b"FEA1") or start[:6] == b"ARROW1"


def arrow_sheet(path: Path, start: bytes, max_bytes: int) -> Sheet:
    """The columns of a file.

    Raises:
        ValueError: it is damaged or holds too much.
        ImportError: pyarrow is not installed.
    """
    try:
        import pyarrow
    except ImportError as error:
        raise needs("pyarrow", "Parquet and Feather") from error
    try:
        names, batches = (_parquet if start[:4] == b"PAR1" else _feather)(path, max_bytes)
    except (pyarrow.ArrowException, OSError) as error:
        raise _damaged(error) from error
    return Sheet(names, _parts(batches, max_bytes))


def _damaged(error: Exception) -> ValueError:
    return ValueError(f"expected a complete Parquet or Feather file, received none ({error})")


def _parquet(path: Path, max_bytes: int) -> tuple[list[str], Iterator[Any]]:
    from pyarrow import parquet

    file = parquet.ParquetFile(path)
    facts = file.metadata
    groups = [facts.row_group(i) for i in range(facts.num_row_groups)]
    unpacked = sum(group.column(i).total_uncompressed_size for group in groups for i in range(facts.num_columns))
    if max(facts.num_rows * BYTES_OF_A_ROW, unpacked) > max_bytes:
        raise too_large(max_bytes, f"of columns, of which a row counts for {BYTES_OF_A_ROW} or more")
    names = [str(name) for name in file.schema_arrow.names]
    texts = [field.name for field in file.schema_arrow if str(field.type) in ("string", "large_string")]
    # as dictionaries, so that a long text that comes again and again takes no more memory than it has in the file
    file = parquet.ParquetFile(path, read_dictionary=texts)
    return names, file.iter_batches(_ROWS)


def _feather(path: Path, max_bytes: int) -> tuple[list[str], Iterator[Any]]:
    from pyarrow import ipc, memory_map

    reader = ipc.open_file(memory_map(str(path)))
    return [str(name) for name in reader.schema.names], map(reader.get_batch, range(reader.num_record_batches))


def _parts(batches: Iterator[Any], max_bytes: int) -> Iterator[tuple[int, Cells]]:
    import pyarrow

    rows = taken = 0
    try:
        for batch in batches:
            rows, taken = rows + batch.num_rows, taken + batch.nbytes
            if max(rows * BYTES_OF_A_ROW, taken) > max_bytes:
                raise too_large(max_bytes, f"of columns, of which a row counts for {BYTES_OF_A_ROW} or more")
            yield batch.num_rows, partial(_cells, batch)
    except (pyarrow.ArrowException, OSError) as error:
        raise _damaged(error) from error


def _cells(batch: Any, name: str) -> Any:
    """A column: an array of numbers or moments, where they are some; otherwise a list."""
    import pyarrow
    from pyarrow import types

    column = batch.column(name)
    kind = column.type
    if types.is_timestamp(kind):
        return column.cast(pyarrow.timestamp("ns")).to_numpy(zero_copy_only=False)
    if types.is_integer(kind) and column.null_count:
        return column.cast(pyarrow.float64()).to_numpy(zero_copy_only=False)
    if types.is_integer(kind) or types.is_floating(kind):
        return column.to_numpy(zero_copy_only=False)
    return column.to_pylist()
