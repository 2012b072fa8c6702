"""The text of a file, gzipped or not, and its rows, as much of them as is allowed."""

from __future__ import annotations

import csv
import gzip
import io
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from itertools import chain
from pathlib import Path
from typing import IO, TYPE_CHECKING, TextIO

from torchfra.numbers import is_integer

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

MAX_BYTES = 2**30
"""Bytes of text that a file may hold, unless another bound is set."""
BYTES_OF_A_ROW = 64
"""What a row counts for at least: about what it takes up in memory."""
BYTES_OF_A_TEXT = 2**12
"""What each name of a target or an anchor counts for at least: about what it takes to repair and filter a target."""
LONGEST_ROW = 2**20
"""Characters of a row of CSV: all such rows are read, and none of twice the length; about as many are in memory."""
_LONGEST_LINE = 1024
"""Bytes of a line of a logger; a sentence of NMEA has 82, and may have a time in front."""
_PIECE = 2**16
"""Bytes that are read at a time."""
_CELLS = 2**17
"""Cells that are in memory at a time, about."""


def check_bound(max_bytes: int) -> None:
    """Checks an argument.

    Raises:
        ValueError: no whole number above 0.
    """
    if not is_integer(max_bytes, 1):
        raise ValueError(f"max_bytes: expected a whole number above 0, received {max_bytes!r}")


def too_large(max_bytes: int, what: str = "of text") -> ValueError:
    """The error for a file that holds more than ``max_bytes`` of something."""
    return ValueError(f"expected at most {max_bytes} bytes {what}, received more; max_bytes (--max-bytes) raises that")


@contextmanager
def open_bounded(path: Path, max_bytes: int) -> Iterator[io.BufferedReader]:
    """Opens a file, of which only so much can be read: then there is a ``ValueError``."""
    with path.open("rb") as file:
        gzipped = file.peek(2)[:2] == b"\x1f\x8b"
        if not gzipped and os.fstat(file.fileno()).st_size > max_bytes:
            raise too_large(max_bytes)
        yield io.BufferedReader(_Bounded(gzip.GzipFile(fileobj=file) if gzipped else file, max_bytes), _PIECE)


class _Bounded(io.RawIOBase):
    """The first bytes of a file; an error follows."""

    def __init__(self, file: IO[bytes] | gzip.GzipFile, max_bytes: int) -> None:
        self.file, self.max_bytes, self.left = file, max_bytes, max_bytes

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: WriteableBuffer, /) -> int:
        view = memoryview(buffer)
        data = self.file.read(min(len(view), _PIECE))  # what unpacks a larger one holds it several times over
        self.left -= len(data)
        if self.left < 0:
            raise too_large(self.max_bytes)
        view[: len(data)] = data
        return len(data)


def short_lines(file: IO[bytes], max_bytes: int) -> Iterator[str]:
    """The lines of a file without blanks around them, cut off where they are long.

    Raises:
        ValueError: there are too many.
    """
    count = 0
    while data := file.readline(_LONGEST_LINE):
        count += 1
        if count * BYTES_OF_A_ROW > max_bytes:
            raise too_large(max_bytes, f"of text, of which a line counts for {BYTES_OF_A_ROW} or more")
        yield data.decode("ascii", "replace").strip()


class Rows:
    """The rows of a CSV text without the blank ones, read when they are asked for.

    Args:
        text: the CSV.
        max_bytes: bound on the text and on what the rows count for.

    Raises:
        ValueError: (both methods) too many rows, or one that is too long.
        csv.Error: (both methods) text of another kind.
    """

    def __init__(self, text: TextIO, max_bytes: int) -> None:
        self.text, self.max_bytes, self.of_row = text, max_bytes, 0
        self.head = text.read(LONGEST_ROW)
        """The first text, up to ``LONGEST_ROW`` of it; set it to read other text instead, before the start."""
        self.start(",")

    def start(self, sign: str, first: str = "") -> None:
        """Begins to read rows whose cells are separated by a sign, those alone whose ``first`` cell is this."""
        self.only = first
        self.reader = csv.reader(self._lines(), strict=True, delimiter=sign, skipinitialspace=sign == " ")

    def _lines(self) -> Iterator[str]:
        *lines, last = [*io.StringIO(self.head, newline="")] or [""]
        if not last.endswith(("\n", "\r")):
            last += self.text.readline(LONGEST_ROW)
        for line in chain(lines, [last], iter(partial(self.text.readline, LONGEST_ROW + 1), "")):
            self.of_row += len(line)  # quotes may hold a row together over many lines
            if self.of_row > 2 * LONGEST_ROW or (len(line) > LONGEST_ROW and not line.endswith(("\n", "\r"))):
                raise ValueError(f"expected rows of at most {LONGEST_ROW} characters, received a longer one")
            yield line

    def first(self) -> list[str]:
        """The first row; empty at the end of the text."""
        return next((row for row in self.reader if "".join(row).strip()), [])

    def parts(self, fields: int, mended: Callable[[list[str], int], list[str]]) -> Iterator[list[str]]:
        """The cells of further rows, one after the other, some rows at a time.

        Args:
            fields: number of cells in a row.
            mended: makes a row of that length from one of another and the number of rows before it.
        """
        cells, rows = list[str](), 0
        for row in self.reader:
            self.of_row = 0
            if self.only and (not row or row[0] != self.only):
                continue
            if len(row) == fields:
                cells += row  # and no rows: Python's garbage collector would take longer than all else
            elif row:
                cells += mended(row, rows + len(cells) // fields)
            if len(cells) > _CELLS or not self.reader.line_num % _CELLS:
                self._count(fields)
                yield cells
                rows, cells = rows + len(cells) // fields, []
        self._count(fields)
        if cells:
            yield cells

    def _count(self, fields: int) -> None:
        if self.reader.line_num * max(BYTES_OF_A_ROW, fields) > self.max_bytes:
            raise too_large(self.max_bytes, f"of text, of which a row counts for {BYTES_OF_A_ROW} or more")
