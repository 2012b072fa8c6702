"""Tracks of Parquet files that do not fit into memory: some of the targets at a time, with all their rows."""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchfra.readers.arrow_files import damaged, is_flat, table_sheet
from torchfra.readers.columns import grouped, text
from torchfra.readers.options import listed
from torchfra.readers.reading import SheetReader
from torchfra.readers.recording import Recording
from torchfra.readers.repairs import TooFewError, dropped
from torchfra.readers.tables import head_of, naming
from torchfra.running.optional import optional

_ROWS = 2**18
"""Of a file that are in memory at a time."""
_HEAD = 1000
"""Rows that show what columns hold."""


class File(NamedTuple):
    """A file of a data set."""

    path: Path
    name: str
    """Its path below the folder of the data set."""
    rows: int
    bytes: int
    footer: int
    """A checksum of what the file says of its columns, their least and greatest values included."""


class Wrong(NamedTuple):
    """What is wrong with targets that have no recording."""

    failed: dict[str, str]
    """By their names why they cannot be read."""
    repairs: Counter[str]
    """How many have too few fixes."""


@dataclass(frozen=True)
class DataSet:
    """The files of a data set, and what their columns hold."""

    files: tuple[File, ...]
    """The files, in the order of their names."""
    reader: SheetReader
    """Reads some of the rows."""
    schema: Any
    """The columns that are read, with types into which the types of all files fit."""
    id: str
    """The column that says which target a row is of."""

    @property
    def rows(self) -> int:
        """Of all files."""
        return sum(file.rows for file in self.files)

    def recordings(self, part: int, parts: int, together: int) -> Iterator[tuple[int, list[Recording], Wrong]]:
        """Reads a part of the targets: those whose hash is ``part``, modulo ``parts``, wherever their rows are.

        Args:
            part: from 0.
            parts: how many there are.
            together: rows that are given back at a time, about.

        Yields:
            How many rows; their recordings, whose ``row`` counts through all files; and what is wrong with other
            targets.  Rows without an id belong to no part.

        Raises:
            ValueError: a file is damaged.
        """
        table, rows = self._chosen(part, parts)
        codes, which = _codes(table.column(self.id).combine_chunks())
        group = (codes // parts % max(1, round(len(rows) / together)))[which] if len(rows) else which
        order = np.argsort(group, kind="stable")
        for chosen in np.split(order, np.flatnonzero(np.diff(group[order])) + 1):
            if len(chosen):
                wrong = Wrong({}, Counter())
                yield len(chosen), self._read(table.take(chosen), rows[chosen], wrong), wrong

    def _chosen(self, part: int, parts: int) -> tuple[Any, NDArray[np.int64]]:
        """The rows of a part, and their numbers."""
        import pyarrow
        from pyarrow import parquet

        pieces, rows, first = [self.schema.empty_table()], list[NDArray[np.int64]](), 0
        for path, *_ in self.files:
            try:
                for batch in parquet.ParquetFile(path).iter_batches(
                    _ROWS, columns=self.schema.names, use_threads=False
                ):
                    codes, which = _codes(batch.column(self.id))
                    chosen = np.flatnonzero(((codes >= 0) & (codes % parts == part))[which])
                    batch = batch.take(pyarrow.array(chosen))
                    batch.validate(full=True)
                    pieces.append(pyarrow.Table.from_batches([batch]).select(self.schema.names).cast(self.schema))
                    rows.append(first + chosen)
                    first += len(which)
            except (pyarrow.ArrowException, OSError) as error:
                raise ValueError(f"{path}: {damaged(error)}") from error
        return pyarrow.concat_tables(pieces).combine_chunks(), np.concatenate(rows)

    def _read(self, table: Any, rows: NDArray[np.int64], wrong: Wrong) -> list[Recording]:
        """All targets of a table; each for itself, whose rows are then counted, where one of them cannot be read."""
        try:
            return [replace(one, row=rows[one.row]) for one in self.reader.read(table_sheet(table))]
        except ValueError as error:
            labels = text(table.column(self.id).to_pylist(), self.id, {})
            targets = grouped(labels)
            if isinstance(error, TooFewError):
                wrong.repairs[dropped(self.reader.layout)] += len(targets)
                return []
            if len(targets) == 1:
                wrong.failed[labels[0]] = str(error)
                return []
        found = [one for chosen in targets.values() for one in self._read(table.take(chosen), rows[chosen], wrong)]
        return sorted(found, key=lambda recording: recording.name)


def open_data(path: str | Path, **words: str | None) -> DataSet:
    """Looks at a Parquet file, or at all of a folder and of those below it but hidden ones, without reading their rows.

    Args:
        path: of the file or the folder.
        words: what the files do not say: see ``ReadOptions``.

    Raises:
        ValueError: there are no rows, a file is damaged or has other columns than the first one, or no column says
            which target a row is of; or a column is of numbers in one file and of text in another.
        ImportError: pyarrow is not installed.
    """
    if words.get("id") and "," in str(words["id"]):
        raise ValueError(
            f"id: expected one column, by which a data set is parted, received {words['id']}: write one column of both"
        )
    pyarrow, parquet = (optional(name, "Parquet", "formats") for name in ("pyarrow", "pyarrow.parquet"))
    path = Path(path)
    files, schemas = [], []
    for file in _paths(path):
        try:
            facts = parquet.ParquetFile(file)
        except (pyarrow.ArrowException, OSError) as error:
            raise ValueError(f"{file}: {damaged(error)}") from error
        name = file.name if file == path else file.relative_to(path).as_posix()
        files.append(File(file, name, facts.metadata.num_rows, file.stat().st_size, _footer(file)))
        schemas.append(pyarrow.schema([field for field in facts.schema_arrow if is_flat(field.type)]))
    with naming(path):
        begin = next((i for i, file in enumerate(files) if file.rows), None)
        if begin is None:
            raise ValueError("expected rows in Parquet files, received none")
        names = schemas[begin].names
        head = next(parquet.ParquetFile(files[begin].path).iter_batches(_HEAD, columns=names))
        sheet = table_sheet(pyarrow.Table.from_batches([head]))
        reader = SheetReader(path.name, words)
        reader(head_of(sheet, next(iter(sheet.parts))[1]))
        if "id" not in reader.layout.columns:
            raise ValueError(f"id: expected a column that says which target a row is of, received {listed(names)}")
    wanted = _plain(schemas[begin], reader.columns).names
    for other, of in zip(files, schemas, strict=True):
        if missing := [name for name in wanted if name not in of.names]:
            raise ValueError(f"{other.path}: expected the columns of {files[begin].name}, missing {listed(missing)}")
    try:
        schema = pyarrow.unify_schemas([_plain(of, wanted) for of in schemas], promote_options="permissive")
    except pyarrow.ArrowException as error:
        said = " ".join(str(error).split())
        raise ValueError(f"{path}: expected columns of one type in all files, received others ({said})") from error
    return DataSet(tuple(files), reader, schema, reader.layout.columns["id"])


def _footer(path: Path) -> int:
    """The checksum of the end of a Parquet file."""
    with path.open("rb") as file:
        file.seek(-8, 2)
        length = int.from_bytes(file.read(4), "little")
        file.seek(-8 - length, 2)
        return zlib.crc32(file.read(length))


def _paths(path: Path) -> list[Path]:
    """The files of a data set, in the order of their names."""
    if not path.is_dir():
        return [path]
    every = (file.relative_to(path) for file in path.rglob("*.parquet"))
    files = sorted(file for file in every if not any(part.startswith((".", "_")) for part in file.parts))
    if not files:
        raise ValueError(f"{path}: expected files that end in .parquet, received none")
    return [path / file for file in files]


def _plain(schema: Any, columns: list[str]) -> Any:
    """The schema of some columns, or of all where one of them is made of others, without dictionaries."""
    import pyarrow
    from pyarrow import types

    chosen = columns if set(columns) <= set(schema.names) else schema.names
    fields = [schema.field(name) for name in chosen]
    plain = {f.name: f.type.value_type if types.is_dictionary(f.type) else f.type for f in fields}
    return pyarrow.schema(list(plain.items()))


def _codes(column: Any) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """A hash of each target of a column, the same in all files and processes, and which of them each row is of.

    Rows that say nothing are of a target with the hash -1.
    """
    from pyarrow import types

    if not types.is_dictionary(column.type):
        column = column.dictionary_encode("encode")
    names = text(column.dictionary.to_pylist(), "", {})
    codes = np.fromiter((zlib.crc32(name.encode()) if name else -1 for name in (*names, "")), np.int64, len(names) + 1)
    return codes, np.asarray(column.indices.cast("int64").fill_null(len(names)).to_numpy(), dtype=np.int64)
