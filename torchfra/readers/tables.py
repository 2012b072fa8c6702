"""From a file to a table: the columns that are wanted, as numbers and as text."""

from __future__ import annotations

import gzip
import io
import re
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from torchfra.readers.arrow_files import arrow_sheet, is_arrow
from torchfra.readers.bounded import BYTES_OF_A_TEXT, MAX_BYTES, check_bound, open_bounded, too_large
from torchfra.readers.columns import HEAD, Array, Cells, Head, Kind, joined, numbers, text
from torchfra.readers.csv_files import UTF_8, csv_sheet
from torchfra.readers.geometries import Together, parted, together_in
from torchfra.readers.igc_files import igc_sheet, is_igc
from torchfra.readers.json_files import is_json, json_sheet
from torchfra.readers.mixed_files import fit_sheet, is_fit_csv, is_log, log_sheet
from torchfra.readers.nmea_files import is_nmea, nmea_sheet
from torchfra.readers.npy_files import is_npy, npy_sheet
from torchfra.readers.options import ReadOptions
from torchfra.readers.plt_files import is_plt, plt_sheet
from torchfra.readers.sheets import Sheet, listed
from torchfra.readers.spelling import is_known
from torchfra.readers.vbo_files import is_vbo, vbo_sheet
from torchfra.readers.xml_files import xml_sheet

Wanted: TypeAlias = dict[str, Kind | None]
"""The columns to read by their names, and the kind of their numbers; None for text."""
HEADERS = (
    "expected a header with a time and x,y[,z] or lat,lon[,alt], or the names of such columns by --time, --x, --y, "
    "--lat, --lon"
)
"""The beginning of an error message."""
_ENCODINGS = "cp1252", "cp1250", "cp1251"
"""Text that programs for Windows write in western and central Europe and in Cyrillic, if it is no UTF-8."""
_NO_TEXT = re.compile(rb"[\x00-\x08\x0e-\x1f]")
_NO_TEXTS = (
    (
        b"PK\x03\x04",
        0,
        "a zip archive, as .xlsx, .kmz and .npz are: save the sheet as CSV, unpack it, or write a table of "
        "its arrays by np.savetxt or as .npy",
    ),
    (
        b"\x80",
        0,
        "a pickle of Python, which may run anything: write CSV by to_csv or np.savetxt, or hand what is in it "
        "to torchfra.clean",
    ),
    (b".FIT", 8, "FIT of a watch: export GPX, TCX or CSV"),
    (b"#ROSBAG", 0, "a bag of ROS: export its topic as CSV, such as by rostopic echo -p"),
    (b"SQLite format 3", 0, "a data base of SQLite: export its table as CSV"),
    (b"MATLAB", 0, "a file of Matlab: write a table as CSV"),
    (b"\xb5b", 0, "UBX of a receiver: convert it to NMEA or CSV"),
)
"""How other files begin, after so many bytes, and what to do with them."""
_BEGINNING = 4096
"""Bytes of a file by which the encoding of its text is told."""


class Table(NamedTuple):
    """What is read of a file."""

    names: list[str]
    """Of all columns."""
    rows: int
    numbers: dict[str, Array]
    """``(rows,)`` each, NaN where empty."""
    texts: dict[str, list[str]]
    """As many, "" where empty."""

    def column(self, name: str) -> Array:
        """Numbers ``(rows,)``, read-only NaN where the column is absent."""
        return self.numbers.get(name, np.broadcast_to(np.float64(np.nan), self.rows))


def read_table(
    path: Path,
    choose: Callable[[Head], Wanted],
    *,
    headers: str = HEADERS,
    repairs: Counter[str] | None = None,
    max_bytes: int = MAX_BYTES,
    options: ReadOptions | None = None,
) -> Table:
    """Columns of a file.

    Args:
        path: the file.
        choose: which columns to read; it may raise a ``ValueError``.
        headers: beginning of the error message where there is no header.
        repairs: where to count rows of CSV with more or fewer fields than the header, whose cells become empty; None
            refuses them, and tables without rows.
        max_bytes: of text; a row counts for 64 bytes or more, a name for 4096, a byte of JSON for 24 and of XML for 32.
        options: how cells are written.

    Raises:
        ValueError: the file is empty, broken, too large or of no known format.
        ImportError: what reads it is not installed.
    """
    check_bound(max_bytes)
    suffix = Path(path.name.removesuffix(".gz")).suffix.lower()

    def sheet_of(file: io.BufferedReader, encoding: str) -> Sheet:
        """The rows of a file by its ending, or else by how it begins."""
        start = file.peek(1).removeprefix(b"\xef\xbb\xbf").lstrip()
        if is_vbo(start, suffix):
            return vbo_sheet(file, max_bytes, encoding)
        if is_plt(start, suffix):
            return plt_sheet(file, max_bytes, encoding)
        if is_igc(start, suffix):
            return igc_sheet(file, max_bytes, encoding)
        if suffix in (".json", ".geojson") or start[:1] == b"{" or (suffix != ".csv" and is_json(start)):
            return json_sheet(file, max_bytes)
        if is_arrow(start):
            return arrow_sheet(path, start, max_bytes)
        if is_npy(start):
            return npy_sheet(file, options, headers, max_bytes)
        if start[:1] == b"<":
            return xml_sheet(file, max_bytes)
        if is_nmea(start, suffix):
            return nmea_sheet(file, max_bytes)
        if is_fit_csv(start):
            return fit_sheet(file, max_bytes, encoding)
        if is_log(start):
            return log_sheet(file, max_bytes)
        return csv_sheet(file, options, headers, repairs, max_bytes, encoding)

    def read(encoding: str) -> Table:
        with open_bounded(path, max_bytes) as file:
            sheet = sheet_of(file, encoding)
            said = (*([] if encoding == UTF_8 else [f"text is no UTF-8: read as {encoding}"]), *sheet.said)
            return table_of(with_joined(sheet._replace(said=said), options or ReadOptions()), choose, max_bytes)

    try:
        table = read(UTF_8)
    except (EOFError, gzip.BadGzipFile, zlib.error, UnicodeDecodeError) as error:
        refused = f"expected UTF-8 text or a complete gzip file of it, received neither ({error})"
        if not isinstance(error, UnicodeDecodeError):
            raise ValueError(refused) from error
        if not _is_text(path, max_bytes):
            raise ValueError(_known_otherwise(path, max_bytes) or refused) from error
        encoding = _encoding(path, max_bytes)
        try:
            table = read(encoding)
        except UnicodeDecodeError:
            raise ValueError(refused) from error
        except ValueError as other:
            raise ValueError(f"{other} (the text is no UTF-8, and was read as {encoding})") from other
    if repairs is None and not table.rows:
        raise ValueError(f"expected rows, received none under the columns {listed(table.names)}")
    return table


def _is_text(path: Path, max_bytes: int) -> bool:
    """Whether a file begins as one of text: without signs that only machines read."""
    with open_bounded(path, max_bytes) as file:
        return not _NO_TEXT.search(file.peek(1))


def _encoding(path: Path, max_bytes: int) -> str:
    """The first encoding of those in which most words of a file's beginning are names of columns."""
    with open_bounded(path, max_bytes) as file:
        start = file.peek(1)[:_BEGINNING]

    def known(encoding: str) -> int:
        return sum(is_known(name) for name in re.split(r"[,;|\t\r\n]", start.decode(encoding, "replace")))

    return max(_ENCODINGS, key=known)


def _known_otherwise(path: Path, max_bytes: int) -> str:
    """What a file is that is no text, and how to make one of it; "" of unknown ones."""
    with open_bounded(path, max_bytes) as file:
        start = file.peek(1)
    known = (said for sign, at, said in _NO_TEXTS if start[at:].startswith(sign))
    return next((f"expected text, received {said}" for said in known), "")


def with_joined(sheet: Sheet, options: ReadOptions) -> Sheet:
    """A sheet with one more column for each option that names several, of the target or of the time, together."""
    places = {name for role, name in options.columns().items() if role in ("x", "latitude", "longitude")}
    sheet = sheet._replace(placed=bool(places & {*sheet.names}))
    asked = {name: name.split(",") for name in (options.id, options.time) if name and name not in sheet.names}
    several = {name: parts for name, parts in asked.items() if len(parts) > 1 and {*parts} <= {*sheet.names}}
    if not several:
        return sheet

    def together(cells: Cells) -> Cells:
        def of(column: str) -> Any:
            if column not in several:
                return cells(column)
            labels = zip(*(text(cells(one), one, {}) for one in several[column]), strict=True)
            return [" ".join(filter(None, parts)) for parts in labels]

        return of

    parts = ((rows, together(cells)) for rows, cells in sheet.parts)
    return sheet._replace(names=[*sheet.names, *several], parts=parts)


def table_of(sheet: Sheet, choose: Callable[[Head], Wanted], max_bytes: int) -> Table:
    """The columns that are chosen of a sheet.

    Raises:
        ValueError: a cell is of another kind, or there are too many.
    """
    parts, wanted, together = iter(sheet.parts), dict[str, Kind | None](), None
    first = next(parts, None)
    if sheet.names and first is not None:
        head, together = head_of(sheet, first[1])
        wanted = choose(head)
    kinds = {name: kind for name, kind in wanted.items() if kind is not None}
    grown: dict[str, list[Array]] = {name: [np.empty(0)] for name in kinds}
    texts: dict[str, list[str]] = {name: [] for name in wanted if name not in kinds}
    rows, known = 0, dict[Any, str]()
    for count, cells in chain([first] if first else [], parts):
        cells = cells if together is None else parted(cells, together)
        for name in texts:
            texts[name] += text(cells(name), name, known, rows)
        for name, kind in kinds.items():
            column = joined(cells, kind.joined) if kind.joined else cells(name)
            grown[name].append(numbers(column, kind, name, rows))
        rows += count
        if len(known) * BYTES_OF_A_TEXT > max_bytes:
            raise too_large(max_bytes, f"of text, of which each name counts for {BYTES_OF_A_TEXT} or more")
    # Column by column, so that no more than one is in memory twice.
    return Table(sheet.names, rows, {name: np.concatenate(grown.pop(name)) for name in kinds}, texts)


def head_of(sheet: Sheet, cells: Cells) -> tuple[Head, Together | None]:
    """How a sheet begins, by the cells of its first rows, and which column holds positions as a whole."""
    begin = cache(lambda name: cells(name)[:HEAD])
    head = Head(sheet.names, begin, sheet.said, sheet.commas, sheet.json, sheet.word, cells)
    together = None if sheet.placed else together_in(head)
    if together is not None:
        names = [*(name for name in sheet.names if name != together.column), *together.axes]
        said = (
            *sheet.said,
            f"{listed(together.axes)}: {'both' if len(together.axes) == 2 else 'all'} in {together.column}",
        )
        head = head._replace(
            names=names, cells=parted(head.cells, together), said=said, further=parted(cells, together)
        )
    return head, together


@contextmanager
def naming(path: Path | str) -> Iterator[None]:
    """Puts the name of a file in front of the message of a ``ValueError``."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
