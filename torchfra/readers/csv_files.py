"""Rows of text: separated by commas, semicolons, tabs or spaces, with a header and comments."""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Iterator
from functools import partial
from itertools import islice
from typing import Any

from torchfra.readers.bounded import Rows
from torchfra.readers.columns import Cells, Head, number
from torchfra.readers.guesses import looks_like
from torchfra.readers.options import ReadOptions
from torchfra.readers.sheets import Sheet, listed, repeated
from torchfra.readers.spelling import is_header

_SIGNS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", " ": "spaces"}
_COMMENTS = ("#", "%", "//")
"""How lines begin that are for people."""
UTF_8 = "utf-8-sig"
_GUESSED_FROM = 100
"""Rows of which it is guessed what their columns hold."""
_LINE = re.compile(r"[^\r\n]*(?:\r\n|\r|\n)")


def csv_sheet(
    file: Any, options: ReadOptions | None, headers: str, repairs: Counter[str] | None, max_bytes: int, encoding: str
) -> Sheet:
    """The rows of a file.

    Args:
        file: open for reading.
        options: of the caller, which may name columns by their numbers, from 1 on, where there is no header; None for
            no options.
        headers: beginning of the error message where there is no header.
        repairs: see ``tables.read_table``.
        max_bytes: of text.
        encoding: of its text.

    Raises:
        ValueError: there is no header, or a column comes twice; later, a row of another length.
    """
    rows = Rows(io.TextIOWrapper(file, _wide(file.peek(64)[:64]) or encoding, newline=""), max_bytes)
    sign = _begin(rows, options or ReadOptions())
    said = [] if encoding == UTF_8 else [f"text is no UTF-8: read as {encoding}"]
    said += [] if sign == "," else [f"separated by {_SIGNS.get(sign, repr(sign))}"]
    try:
        if _numbered(rows, sign, options, headers):
            said.append("no header: columns by their numbers")
        rows.start(sign)
        names = _header(rows.first(), headers)
    except csv.Error as error:
        raise _no_csv(error) from error
    return Sheet(names, _parts(rows, names, repairs), tuple(said), commas=sign != ",")


def _wide(head: bytes) -> str:
    """The encoding of text of two bytes a letter, as spreadsheets write it, with its mark or without; "" of others."""
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    for encoding, odd in (("utf-16-le", 1), ("utf-16-be", 0)):
        zeros, letters = head[odd::2], head[1 - odd :: 2]
        if letters and not any(zeros) and all(letters):
            return encoding
    return ""


def _begin(rows: Rows, options: ReadOptions) -> str:
    """Leaves out the comments in front of the header, and finds out what separates cells.

    A comment with the names of columns is the header where the line after it is not one.
    """
    text, comments, start = rows.head, list[str](), 0
    while (line := _LINE.match(text, start)) and _is_comment(line[0]):
        comments.append(line[0])
        start = line.end()
    stated = re.compile(r'"?sep=(.)"?\r?\n').match(text, start)
    text = text[stated.end() if stated else start :]
    first = _LINE.match(text)
    line_of_names = first[0] if first else text
    signs = [options.sign] if options.sign else [stated[1]] if stated else _likely(line_of_names)
    for comment in reversed(comments):
        for sign in signs:
            names = _split(comment.lstrip(' \t"#%/'), sign)
            first_row = _split(line_of_names, sign)
            if is_header(names) and not is_header(first_row) and len(names) == len(first_row):
                rows.head = comment.lstrip(" \t#%/") + text
                return sign
    rows.head = text
    return next((sign for sign in signs if is_header(_split(line_of_names, sign))), signs[0])


def _numbered(rows: Rows, sign: str, options: ReadOptions | None, headers: str) -> bool:
    """Adds a header of column numbers to a text without header, if the caller names columns by numbers."""
    reader = csv.reader(io.StringIO(rows.head, newline=""), delimiter=sign, skipinitialspace=sign == " ")
    cells, asked = next(reader, []), {*options.columns().values()} if options else set()
    if len(cells) < 2 or sum(map(_is_number, cells)) < 2 or is_header(cells) or asked & {*cells}:
        return False
    names = [str(i + 1) for i in range(len(cells))]
    if not asked or not asked <= {*names}:
        several = [_split(line, sign) for line in islice(io.StringIO(rows.head), _GUESSED_FROM)]
        full = [row for row in several if len(row) == len(names)]
        head = Head(names, lambda name: [row[int(name) - 1] for row in full])
        raise ValueError(f"{headers}; received {listed(cells)}{looks_like(head) if options else ''}")
    rows.head = sign.join(names) + "\n" + rows.head
    return True


def _is_comment(line: str) -> bool:
    return not line.strip() or line.lstrip(' \t"').startswith(_COMMENTS)


def _likely(line: str) -> list[str]:
    """What may separate the cells of a line, the likeliest first."""
    bare = re.sub(r'"[^"]*"', "", line)
    counts = {sign: bare.count(sign) for sign in ",;\t|"}
    if not any(counts.values()):
        return [" ", ","] if len(bare.split()) > 2 else [","]
    return sorted((sign for sign in counts if counts[sign]), key=lambda sign: -counts[sign])


def _split(line: str, sign: str) -> list[str]:
    return [name.strip(' "\r\n\t') for name in (line.split() if sign == " " else line.split(sign))]


def _parts(rows: Rows, names: list[str], repairs: Counter[str] | None) -> Iterator[tuple[int, Cells]]:
    place = {name: i for i, name in enumerate(names)}

    def mended(row: list[str], before: int) -> list[str]:
        if row[0].lstrip().startswith(_COMMENTS):
            return []
        if len(row) > len(names) and not any(row[len(names) :]):
            return row[: len(names)]
        if repairs is None:
            raise ValueError(f"expected {len(names)} fields in data row {before + 1}, received {len(row)}")
        repairs["rows with too many or too few fields emptied"] += 1
        return [""] * len(names)

    try:
        for cells in rows.parts(len(names), mended):
            yield len(cells) // len(names), partial(_cells, cells, place)
    except csv.Error as error:
        raise _no_csv(error) from error


def _no_csv(error: csv.Error) -> ValueError:
    return ValueError(f"expected CSV, received other text ({error})")


def _header(row: list[str], headers: str) -> list[str]:
    """The names of columns."""
    if not row:
        raise ValueError("expected a track, received an empty file")
    names = [name.strip() for name in row]
    if len(names) == 1:
        raise ValueError(f"{headers}; received {listed(names)}")
    if twice := repeated(names):
        raise ValueError(f"expected every column once, received several named {twice}")
    return names


def _cells(cells: list[str], place: dict[str, int], name: str) -> list[str]:
    """The cells of one column, out of the cells of all rows in one list."""
    return cells[place[name] :: len(place)]


def _is_number(cell: str) -> bool:
    try:
        number(cell)
    except ValueError:
        return False
    return True
