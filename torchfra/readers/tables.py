"""From a file to a table: the columns that are wanted, as numbers and as text."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from torchfra.readers.arrow_files import arrow_sheet, is_arrow
from torchfra.readers.binary_files import fit_sheet, is_workbook, workbook_text
from torchfra.readers.bounded import MAX_BYTES, PARSED, check_size, contents
from torchfra.readers.columns import HEAD, Array, Cells, Head, Kind, joined, numbers, text
from torchfra.readers.csv_files import csv_sheet
from torchfra.readers.igc_files import igc_sheet, is_igc
from torchfra.readers.json_files import json_sheet
from torchfra.readers.nmea_files import is_nmea, nmea_sheet
from torchfra.readers.options import ReadOptions, named
from torchfra.readers.sheets import WINDOWS, Sheet
from torchfra.readers.xml_files import xml_sheet

Wanted: TypeAlias = dict[str, Kind | None]
"""The columns to read by their names, and the kind of their numbers; None for text."""
_NO_TEXT = bytes(range(7))
"""Signs that only machines read."""
_OTHER_FILE = (
    "expected text in UTF-8 or a format that is read, received another file: unpack it, export its table as CSV, or "
    "hand its arrays to torchfra.clean as (time, position)"
)


class Table(NamedTuple):
    """What is read of a file."""

    names: list[str]
    """Of all columns."""
    rows: int
    numbers: dict[str, Array]
    """``(rows,)`` each, NaN where empty."""
    texts: dict[str, list[str]]
    """As many, "" where empty."""
    repairs: Counter[str] = Counter()  # noqa: RUF012
    """What was done to rows before."""

    def column(self, name: str) -> Array:
        """Numbers ``(rows,)``, read-only NaN where the column is absent."""
        return self.numbers.get(name, np.broadcast_to(np.float64(np.nan), self.rows))


def read_table(
    path: Path,
    choose: Callable[[Head], Wanted],
    *,
    max_bytes: int = MAX_BYTES,
    options: ReadOptions | None = None,
) -> Table:
    """Columns of a file.

    Args:
        path: the file.
        choose: which columns to read; it may raise a ``ValueError``.
        max_bytes: that the file may hold, unpacked; a byte of JSON and XML counts for 24.
        options: how cells are written.

    Raises:
        ValueError: the file is empty, broken, too large or of no known format.
        ImportError: what reads it is not installed.
    """
    suffix, data = Path(path.name.removesuffix(".gz")).suffix.lower(), contents(path, max_bytes)
    start = data[:9999].removeprefix(b"\xef\xbb\xbf").lstrip()

    def whole(errors: str = "strict") -> str:
        check_size(PARSED * len(data), max_bytes, f", of which one of JSON and XML counts for {PARSED}")
        return data.decode("utf-8-sig", errors)

    if is_igc(start, suffix):
        sheet = igc_sheet(whole(WINDOWS))
    elif suffix in (".json", ".geojson") or start[:1] == b"{" or (suffix != ".csv" and start[:1] == b"["):
        sheet = json_sheet(whole())
    elif is_arrow(start):
        sheet = arrow_sheet(data, max_bytes)
    elif start[8:12] == b".FIT":
        sheet = fit_sheet(io.BytesIO(data))
    elif is_workbook(start, suffix):
        sheet = csv_sheet(workbook_text(io.BytesIO(data), max_bytes), options)
    elif start[:1] == b"<":
        sheet = xml_sheet(whole())
    elif is_nmea(start, suffix):
        sheet = nmea_sheet(data.decode("ascii", "replace"))
    elif {*start[:16]} & {*_NO_TEXT} and start[:1] not in b"\xff\xfe":
        raise ValueError(_OTHER_FILE)
    else:
        wide = data[:2] in (b"\xff\xfe", b"\xfe\xff")  # as spreadsheets write it
        sheet = csv_sheet(data.decode("utf-16" if wide else "utf-8-sig", WINDOWS), options)
    return table_of(sheet, choose, options)


def table_of(sheet: Sheet, choose: Callable[[Head], Wanted], options: ReadOptions | None = None) -> Table:
    """The columns that are chosen of a sheet; those of a target that are several are one.

    Raises:
        ValueError: a cell is of another kind.
    """
    ids = options.among(sheet.names).get("id", ()) if options and options.id and sheet.names else ()
    together = {" ".join(ids): ids} if len(ids) > 1 else {}
    parts, wanted = iter(sheet.parts), dict[str, Kind | None]()
    first = next(parts, None)
    if sheet.names and first is not None:
        wanted = choose(head_of(sheet, first[1]))
    kinds = {name: kind for name, kind in wanted.items() if kind is not None}
    grown: dict[str, list[Array]] = {name: [np.empty(0)] for name in kinds}
    texts: dict[str, list[str]] = {name: [] for name in wanted if name not in kinds}
    rows, known = 0, dict[Any, str]()
    for count, cells in chain([first] if first else [], parts):
        if not count:
            continue
        for name in texts:
            several = [text(cells(one), one, known, rows) for one in together.get(name, (name,))]
            texts[name] += (
                several[0] if len(several) == 1 else [" ".join(filter(None, row)) for row in zip(*several, strict=True)]
            )
        for name, kind in kinds.items():
            grown[name].append(numbers(joined(cells, kind.joined) if kind.joined else cells(name), kind, name, rows))
        rows += count
    # Column by column, so that no more than one is in memory twice.
    whole = {name: np.concatenate(grown.pop(name)) for name in kinds}
    return Table(sheet.names, rows, whole, texts, sheet.longer or Counter())


def head_of(sheet: Sheet, cells: Cells) -> Head:
    """How a sheet begins, by the cells of its first rows."""
    begin = cache(lambda name: cells(name)[:HEAD])
    return Head(sheet.names, begin, *sheet[2:7])


@contextmanager
def naming(path: Path | str) -> Iterator[None]:
    """Puts the name of a file in front of the message of a ``ValueError``."""
    try:
        yield
    except ValueError as error:
        raise named(path, error) from error
