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
from torchfra.readers.columns import Cells, Head, is_missing, number
from torchfra.readers.guesses import alike, looks_like, side_by_side
from torchfra.readers.options import ReadOptions
from torchfra.readers.sheets import Sheet, listed, repeated
from torchfra.readers.spelling import OTHER_UNIT, RARER_UNITS, UNITS, found, instead_of, is_header, places_in

_SIGNS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", " ": "spaces"}
_COMMENTS = ("#", "%", "//")
"""How lines begin that are for people."""
UTF_8 = "utf-8-sig"
_SBS = (
    "message,transmission,session,aircraft,hex,flight,date,time,date_logged,time_logged,callsign,altitude,speed,course,"
    "lat,lon,climb,squawk,alert,emergency,spi,on_ground\n"
)
"""The header of what receivers of aircraft write without one: BaseStation, on port 30003 of dump1090."""
_GUESSED_FROM = 100
"""Rows of which it is guessed what their columns hold."""
_LINE = re.compile(r"[^\r\n]*(?:\r\n|\r|\n)")
_ABOVE, _BENEATH = 100, 3
"""Lines before a header, and of units beneath it, that loggers write."""
_LENGTH = re.compile(
    r"\b(?:(?:milli|centi|kilo)met(?:er|re)s?|inch(?:es)?|f(?:ee|oo)?t|mm|cm|dm|km|yards?|yd|miles?|nmi)\b",
    re.IGNORECASE,
)
"""A unit of lengths besides metres, in a line before the header."""
_WORDS = re.compile(r"(?:[0-9]{1,4}: *)?[^\W\d][^0-9]{0,40}|°", re.IGNORECASE)
"""A unit, or a source as racing loggers number them, where a row would have a number."""


_UNIT_APART = re.compile(r" +(?=[\[(][^\[\]()]*[\])])")
"""Between a name and its unit in brackets, in a header whose names are separated by spaces."""


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
    if re.match("MSG,[1-8],", rows.head):
        rows.head = _SBS + rows.head
    y_up = "Coordinate Space," in rows.head[: rows.head.find("\n")]
    above = _leave_out_above(rows, options) if options else 0
    sign, units = _begin(rows, options or ReadOptions())
    said = [] if sign == "," else [f"separated by {_SIGNS.get(sign, repr(sign))}"]
    said += [f"lines before the header left out: {above}"] if above else []
    said += ["OptiTrack: y is up, unless it was told otherwise: --x X --y Z --z Y make it the height"] if y_up else []
    try:
        if _numbered(rows, sign, options, headers):
            said.append("no header: columns by their numbers")
        beneath = _leave_out_beneath(rows, sign, options) if options else []
        if options:
            _check_pairs(_lines(rows.head, _BENEATH), sign, above)
        rows.start(sign)
        names = _header(rows.first(), headers)
    except csv.Error as error:
        raise _no_csv(error) from error
    in_comment = (
        units if sign != " " and len(units) == len(names) else []
    )  # a sentence may have as many words as columns
    units = max(beneath, key=lambda line: len({*_with_units(names, line)} - {*names}), default=in_comment)
    bare, names = names, _with_units(names, units) if units else names
    if not beneath and names != bare:
        said.append("units in the comment before the header")
    if {"frame_idx", "instance.score"} <= {*names}:  # of SLEAP, in pixels
        names = [f"{name} (px)" if name.endswith((".x", ".y")) else name for name in names]
    if beneath:
        said.append(f"lines of units beneath the header: {len(beneath)}")
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


def _begin(rows: Rows, options: ReadOptions) -> tuple[str, list[str]]:
    """Leaves out the comments in front of the header, and finds out what separates cells.

    A comment with the names of columns is the header where the line after it is not one.

    Returns:
        What separates cells, and the cells of the last comment, which may be units.
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
            bare = _UNIT_APART.sub("", comment) if sign == " " else comment
            names = _split(bare.lstrip(' \t"#%/'), sign)
            first_row = _split(line_of_names, sign)
            if names[:1] == ["GPST"] and len(names) == len(first_row) - 1:  # of RTKLIB, for two columns
                names = ["date", *names]
                bare = sign.join(names) + "\n"
            if is_header(names) and not is_header(first_row) and len(names) == len(first_row):
                rows.head = bare.lstrip(" \t#%/") + text
                return sign, []
    rows.head = text
    sign = next((sign for sign in signs if is_header(_split(line_of_names, sign))), signs[0])
    return sign, _split(comments[-1].lstrip(' \t"#%/'), sign) if comments else []


def _leave_out_above(rows: Rows, options: ReadOptions) -> int:
    """Leaves out the lines that a logger writes before the header, such as its version; returns their number.

    Raises:
        ValueError: they state a unit of lengths that neither the header nor an option states.
    """
    any_asked, lines = bool(options.columns()), _lines(rows.head, _ABOVE)

    def tells(i: int) -> bool:
        """Whether a line is a header that names places, or all columns that are asked for."""
        for sign in [options.sign] if options.sign else _likely(lines[i]):
            names, whole = _split(lines[i].lstrip(" \t%#/"), sign), _whole_names(lines, i, sign)
            asked = {*map(_without_unit, options.named(whole))}
            if len(names) > 1 and (asked <= {*map(_without_unit, whole)} if any_asked else _may_be_header(names)):
                return True
        return False

    first = next((i for i, line in enumerate(lines) if not _is_comment(line)), len(lines))
    header = next((i for i in range(len(lines)) if tells(i)), 0)
    if header <= first or _is_row(lines[first], options):
        return 0
    above = lines[:header]
    units = [line for line in above if "unit" in line.lower() and _LENGTH.search(line)]
    if units and not options.units:
        found = _LENGTH.search(units[0])
        raise ValueError(
            f"a line before the header states lengths in {found and found[0]}: state it by --units, such as mm"
        )
    rows.head = rows.head[sum(map(len, above)) :]
    sign = options.sign or _likely(lines[header])[0]
    if (whole := _whole_names(lines, header, sign)) != _split(lines[header].lstrip(" \t%#/"), sign):
        names = io.StringIO(newline="")
        csv.writer(names, delimiter=sign).writerow(whole)
        rows.head = names.getvalue() + rows.head[len(lines[header]) :]
    return header


def _whole_names(lines: list[str], i: int, sign: str) -> list[str]:
    """The names in a line; those that come several times behind what lines above say of their columns.

    So programs that follow several markers write them: ``,,hip,,,knee,,`` above ``frame,time,x,y,z,x,y,z``.  Of several
    such lines it is the one next to the names, and if they still come several times, the shortest that parts them.
    DeepLabCut has numbers of frames under ``coords``, and pixels under ``x`` and ``y``.
    """
    names = _split(lines[i].lstrip(" \t%#/"), sign)
    above = [
        cells for line in reversed(lines[:i]) if len(cells := _split(line, sign)) == len(names) > 1 and sign != " "
    ]
    if names[:1] == ["coords"] and above and above[0][0] == "bodyparts":
        marked = zip(above[0][1:], names[1:], strict=True)
        return [names[0], *(f"{part} {axis}{' (px)' if axis in 'xy' else ''}" for part, axis in marked)]
    if not above or not repeated(names):
        return names
    names = _behind(above[0], names)
    parted = [whole for cells in above[1:] if not repeated(whole := _behind(cells, names))]
    return min(parted, key=lambda whole: len("".join(whole)), default=names) if repeated(names) else names


def _behind(groups: list[str], names: list[str]) -> list[str]:
    """Names, those that come several times behind the group that begins at or before them, and for none the group's."""
    several, group, whole = Counter(names), "", list[str]()
    for name, above in zip(names, groups, strict=True):
        group = above or group
        whole.append((f"{group} {name}".strip() if several[name] > 1 else name) if name else above)
    return whole


def _may_be_header(names: list[str]) -> bool:
    """Whether names say where something was, or when, beside two that differ in x and y alone."""
    return is_header(names) or bool(found(names, "time") and alike(names, "x", "y"))


def _lines(text: str, count: int) -> list[str]:
    """The first lines of a text, with their ends."""
    return list(islice(io.StringIO(text, newline=""), count))


def _is_row(line: str, options: ReadOptions) -> bool:
    """Whether it is a row of numbers, as of a file without a header."""
    cells = max((_split(line, sign) for sign in ([options.sign] if options.sign else _likely(line))), key=len)
    return sum(map(_is_number, filter(None, cells))) > len(cells) / 2


def _leave_out_beneath(rows: Rows, sign: str, options: ReadOptions) -> list[list[str]]:
    """Leaves out lines beneath the header that have words where the rows have positions; returns their cells.

    Raises:
        ValueError: positions are in a unit that is not known.
    """
    lines = _lines(rows.head, 1 + _BENEATH)
    if max(map(len, lines), default=0) > csv.field_size_limit():
        return []  # no lines of units; it fails later, with its reason
    names, *several = [
        [cell.strip() for cell in next(csv.reader([line], delimiter=sign), [])] for line in lines or [""]
    ]
    asked = options.columns()
    places = [asked[role] for role in ("x", "y", "latitude", "longitude") if role in asked]
    places = places or places_in(names) or [*(alike(names, "x", "y") or ())]
    places = [place if place in names else _without_unit(place) for place in places]
    at = [names.index(place) for place in places if place in names]
    words = []
    for cells in several:
        if len(cells) != len(names) or not at or not all(_is_word(cells[i].strip("[]()")) for i in at):
            break
        other = next((i for i in at if OTHER_UNIT.fullmatch(cells[i].strip("[]()"))), None)
        if other is not None and not options.units:
            raise ValueError(
                f"column {names[other]}: expected metres or degrees, received {cells[other]} beneath the header: "
                f"convert them, or {instead_of(cells[other].strip('[]()'))}"
            )
        words.append(cells)
    start = sum(map(len, lines[1 : 1 + len(words)]))
    if words:
        rows.head = lines[0] + rows.head[len(lines[0]) + start :]
    return words


def _check_pairs(lines: list[str], sign: str, above: int) -> None:
    """Refuses headers in which every second column has no name, behind that of a target, as Metrica writes them."""
    for row, line in enumerate(lines):
        names = _split(line, sign)
        first = names.index("") - 1 if "" in names[1:] else -1
        blank = [name == "" for name in names[first:]]
        if first <= 0 or len(blank) <= 3 or blank != [i % 2 == 1 for i in range(len(blank))] or is_header(names):
            continue
        if times := found(names, "time"):
            pairs = f"zip(t.columns[{first}::2], t.columns[{first + 1}::2])"
            more = f", sep={sign!r}" * (sign != ",") + f", header={row + above}" * (row + above > 0)
            time = min(times, key=names.index)
            raise ValueError(
                f"expected a name for every column: there are x and y of {side_by_side(time, pairs, more)}"
            )


def _without_unit(name: str) -> str:
    """A name without the unit that ``_with_units`` adds."""
    return re.sub(r" \([^()]*\)$", "", name)


def _is_word(cell: str) -> bool:
    return _WORDS.fullmatch(cell) is not None and not is_missing(cell)


def _with_units(names: list[str], units: list[str]) -> list[str]:
    """Names with the units beneath or above them, where these are some."""
    known = {*UNITS, *RARER_UNITS}
    bare = [unit.strip("[]()").lower().removesuffix(" msl") for unit in units]  # altitudes above the sea
    return [f"{name} ({unit})" if name and unit in known else name for name, unit in zip(names, bare, strict=True)]


def _numbered(rows: Rows, sign: str, options: ReadOptions | None, headers: str) -> bool:
    """Adds a header of column numbers to a text without header, if the caller names columns by numbers."""
    reader = csv.reader(io.StringIO(rows.head, newline=""), delimiter=sign, skipinitialspace=sign == " ")
    cells = next(reader, [])
    asked = options.named(cells) if options else set()
    if len(cells) < 2 or sum(map(_is_number, filter(None, cells))) < 2 or is_header(cells) or asked & {*cells}:
        return False
    names = [str(i + 1) for i in range(len(cells))]
    if not asked or not asked <= {*names}:
        several = [_split(line, sign) for line in islice(io.StringIO(rows.head), _GUESSED_FROM)]
        full = [row for row in several if len(row) == len(names)]
        head = Head(names, lambda name: [row[int(name) - 1] for row in full])
        like = looks_like(head) if options else ""
        raise ValueError(
            f"{headers}; received {listed(cells)}"
            + (like or "; without a header their numbers from 1 on are their names, such as --time 1 --lat 2 --lon 3")
        )
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
    place, known = {name: i for i, name in enumerate(names)}, is_header(names)

    def mended(row: list[str], before: int) -> list[str]:
        if row[0].lstrip().startswith(_COMMENTS):
            return []
        if len(row) > len(names) and not any(row[len(names) :]):
            return row[: len(names)]
        if len(row) > len(names) and {"fixTime", "address"} <= {
            *names
        }:  # Traccar writes addresses with their commas, without quotes
            at, more = names.index("address"), len(row) - len(names)
            return [*row[:at], ",".join(row[at : at + more + 1]), *row[at + more + 1 :]]
        if repairs is None:
            doubt = "" if known else f"; or the header is another line than that of {listed(names)}"
            if names[0] == "Grid":  # as MapSource and BaseCamp write text, where a row has as many cells as it needs
                doubt = ": this is a text of MapSource or BaseCamp, which save tracks as GPX, too: use that"
            if names[:2] == ["Name", "Sport"]:
                doubt = ": this is a session of Polar, which has no positions as CSV: export it as GPX or TCX"
            raise ValueError(f"expected {len(names)} fields in data row {before + 1}, received {len(row)}{doubt}")
        repairs["rows with too many or too few fields emptied"] += 1
        return [""] * len(names)

    try:
        for cells in rows.parts(len(names), mended):
            _empty_headers(cells, names)
            yield len(cells) // len(names), partial(_cells, cells, place, len(names))
    except csv.Error as error:
        raise _no_csv(error) from error


def _empty_headers(cells: list[str], names: list[str]) -> None:
    """Empties rows that are the header again, as of files that were joined to one."""
    width = len(names)
    for row, cell in enumerate(cells[::width]):
        if cell.strip() == names[0] and [one.strip() for one in cells[row * width : (row + 1) * width]] == names:
            cells[row * width : (row + 1) * width] = [""] * width


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
        raise ValueError(
            f"expected every column once, received several named {twice}: give each a name of its own in the header"
        )
    return names


def _cells(cells: list[str], place: dict[str, int], width: int, name: str) -> list[str]:
    """The cells of one column, out of the cells of all rows in one list."""
    return cells[place[name] :: width]


def _is_number(cell: str) -> bool:
    try:
        number(cell)
    except ValueError:
        return False
    return True
