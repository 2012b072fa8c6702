"""Rows of text: separated by commas, semicolons, tabs, bars or spaces, with a header and comments."""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import islice
from typing import Any

from torchfra.readers.bounded import LONGEST_ROW, Rows
from torchfra.readers.columns import Cells, Head, is_missing, number
from torchfra.readers.formats import Format, format_of, format_of_text
from torchfra.readers.hints import unclear
from torchfra.readers.names import DEGREES, LENGTHS, OTHER_UNIT, TIMES, found, places_in, plain
from torchfra.readers.names import unit as unit_of
from torchfra.readers.options import AskError, ReadOptions, instead_of, listed
from torchfra.readers.sheets import WINDOWS, Sheet, repeated

_SIGNS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", " ": "spaces"}
_COMMENTS = ("#", "%", "//")
"""How lines begin that are for people."""
_IN_FRONT = " \t%#/"
"""What stands in front of a header that is a comment."""
_ABOVE, _BENEATH = 100, 3
"""Lines before a header, and of units beneath it, that loggers write."""
_LENGTH = re.compile(
    r"\b(?:(?:milli|centi|kilo)met(?:er|re)s?|inch(?:es)?|f(?:ee|oo)?t|[mcdknu]m|\u00b5m|yards?|yd|mi(?:les?)?|nmi|px|pixels?|"
    r"m?rad(?:ians?)?)\b",
    re.IGNORECASE,
)
"""A unit of lengths besides metres, in a line before the header."""
_OF_LENGTHS = re.compile(r"\bin\b|unit|distance|length|position|coordinate|height|altitude", re.IGNORECASE)
"""What says that a unit in such a line is that of positions."""
_SCALE = re.compile(r"\bscale\b.*[0-9]|\b(?:1|one) (?:unit|pixel)\b.*[0-9]", re.IGNORECASE)
_WEST = re.compile(r"\bwest\w*\b.{0,20}\bpositive|\bpositive\b.{0,20}\bwest", re.IGNORECASE)
_WORDS = re.compile(r"(?:[0-9]{1,4}: *)?[^\W\d][^0-9]{0,40}|°|\(.*\)|\[.*\]", re.IGNORECASE)
"""A unit, or a source as racing loggers number them, where a row would have a number."""


def csv_sheet(file: Any, options: ReadOptions | None, max_bytes: int) -> Sheet:
    """The rows of a file.

    Args:
        file: open for reading.
        options: of the caller, which may name columns by their numbers, from 1 on; None of a file of ranges, whose
            first line has the names.
        max_bytes: of text.

    Raises:
        ValueError: there is no header, or a column comes twice; later, a row of another length.
    """
    start = file.peek(2)
    wide = start[:2] in (b"\xff\xfe", b"\xfe\xff")  # as spreadsheets write it
    windows = not wide and len(start.decode("utf-8", "ignore").encode()) < len(start) - 3
    rows = Rows(io.TextIOWrapper(file, "utf-16" if wide else "utf-8-sig", WINDOWS, newline=""), max_bytes)
    format = format_of_text(rows.head) if options is not None else None
    if format is not None and format.refused:
        raise ValueError(f"{format.name}: {format.refused}")
    said, sign = list[str](), ","
    try:
        if format is not None and (format.header or format.lines):
            sign = _begin_of_format(rows, format)
        else:
            sign, said = _begin(rows, options)
        rows.start(sign, format.lines.rstrip(",") if format else "")
        names = [name.strip() for name in rows.first()]
    except csv.Error as error:
        raise _no_csv(error) from error
    if not names:
        raise ValueError("expected a track, received an empty file")
    if len(names) == 1 and options is not None:
        raise ValueError(f"expected a header with a time and x,y[,z] or lat,lon[,alt]; received {listed(names)}")
    if twice := repeated(names):
        raise ValueError(
            f"expected every column once, received several named {twice}: give each a name of its own in the header"
        )
    said = ([] if sign == "," else [f"separated by {_SIGNS.get(sign, repr(sign))}"]) + said
    said = ["text is no UTF-8: read as cp1252"] * windows + said
    longer = Counter[str]()
    place, width = {name: i for i, name in enumerate(names)}, len(names)
    format = format or (format_of(names) if options is not None else None)
    if pair := [name for name in names if format is not None and format.pair and plain(name) == format.pair]:
        said.append(f"latitude, longitude: both in {pair[0]}")
        place |= dict.fromkeys(("latitude", "longitude"), place.pop(pair[0]))

    def mended(row: list[str], before: int) -> list[str]:
        """A row of another length: a comment, or one whose further fields are empty or not asked for."""
        if row[0].lstrip().startswith(_COMMENTS):
            if options is not None:
                _check_said(sign.join(row), names, options)
            return []
        if format is not None and format.lines:
            return (row + [""] * width)[:width] if len(row) >= width / 2 else []
        if len(row) > width and any(row[width:]) and options is not None and options.columns:
            longer["rows with more fields than the header read by their first fields"] += 1
        elif len(row) < width or any(row[width:]):
            more = (
                "; rows with more are read by their first fields where options name the columns, such as ",
                {"time": names[0]}, f"; or the header is another line than that of {listed(names)}",
            ) if options is not None else ()  # fmt: skip
            raise AskError(f"expected {width} fields in data row {before + 1}, received {len(row)}", *more)
        return row[:width]

    def parts() -> Iterator[tuple[int, Cells]]:
        try:
            for cells in rows.parts(width, mended):
                yield len(cells) // width, partial(_cells, cells, place, width, bool(pair))
        except csv.Error as error:
            raise _no_csv(error) from error

    return Sheet([*place], parts(), tuple(said), sign != ",", format, longer=longer)


def _begin_of_format(rows: Rows, format: Format) -> str:
    """Puts the header of a format in front of its rows; returns what separates cells."""
    text, names, behind = rows.head, format.header, None
    if format.header.startswith("^"):
        behind = re.search(format.header, text, re.MULTILINE)
        if behind is None:
            raise ValueError(f"expected {format.name} with the names of its columns, received none")
        names = text[behind.end() :].splitlines()[0]
        names = names if names.startswith(format.lines) else format.lines + names
    cells = _split(names, format.sign or ",")
    if format.twice:
        cells = [one for name in cells for one in (("date", "time") if re.fullmatch(format.twice, name) else (name,))]
    begin = re.search(format.rows, text, re.MULTILINE) if format.rows else behind
    if format.rows and begin is None:
        raise ValueError(f"expected {format.name} with rows, received none")
    rest = text[begin.end() :] if begin else text
    rows.head = _line(cells, format.sign or ",") + (rest[rest.find("\n") + 1 :] if begin is behind and behind else rest)
    return format.sign or ","


def _begin(rows: Rows, options: ReadOptions | None) -> tuple[str, list[str]]:
    """Leaves out what stands before the header, and units beneath it; numbers the columns where there is no header.

    Returns:
        What separates cells, and what is said.
    """
    lines, said = [*islice(io.StringIO(rows.head, newline=""), _ABOVE + _BENEATH + 2)], list[str]()
    at = next((i for i, line in enumerate(lines) if not _is_comment(line)), len(lines))
    fixed = [options.sign] if options is not None and options.sign else []
    sign = (fixed or _likely("".join(lines[at : at + 1])))[0]
    *_, (at, sign) = (at, sign), *_headers(lines, at if options is None else _ABOVE, options)
    above, names = lines[:at], _split(lines[at].lstrip(_IN_FRONT), sign) if at < len(lines) else []
    if kept := [line for line in above if not _is_comment(line)]:
        said.append(f"lines before the header left out: {len(kept)}")
    rest = rows.head[sum(map(len, lines[: at + 1])) :]
    if at == len(lines) - 1 and len(rows.head) >= LONGEST_ROW and not lines[at].endswith("\n"):
        raise ValueError(f"expected rows of at most {LONGEST_ROW} characters, received a longer one")
    if options is not None and len(names) > 1 and _is_row(names) and not places_in(names):
        rest, names = "".join(lines[at : at + 1]) + rest, [str(i + 1) for i in range(len(names))]
        if not options.columns:
            several = [_split(line, sign) for line in lines[at : at + _ABOVE]]
            full = [row for row in several if len(row) == len(names)]
            raise unclear(Head(names, lambda name: [row[int(name) - 1] for row in full]), "a header", {})
        said.append("no header: columns by their numbers")
    elif options is not None:
        for line in above:
            _check_said(line, names, options)
        rest, names, more = _beneath(rest, lines[at + 1 :], names, sign, options, above)
        said += more
    rows.head = _line(names, sign) + rest
    return sign, said


def _headers(lines: list[str], last: int, options: ReadOptions | None) -> Iterator[tuple[int, str]]:
    """Which lines up to the last may be the header, the likeliest last, and what separates its cells.

    A comment may be one above a row as long.  The first line with places goes before the first with a time alone.
    """
    found_one = False
    for i, line in enumerate(lines[: last + 1]):
        below = next((other for other in lines[i + 1 :] if not _is_comment(other)), "")
        for sign in [options.sign] if options is not None and options.sign else _likely(line):
            cells = _split(line.lstrip(_IN_FRONT), sign)
            places = bool(places_in(cells))
            fits = not _is_comment(line) or len(_split(below, sign)) - len(cells) in (0, 1)
            if not (fits and _is_header(cells, options) and (places or not _is_row(cells))):
                continue
            alone = options is not None and not (places or options.columns or format_of(cells))
            if not (alone and found_one):
                yield i, sign
            if not alone:
                return
            found_one = True


def _check_said(line: str, names: list[str], options: ReadOptions) -> None:
    """Refuses a line for people that states another unit of lengths, a scale, or degrees that grow to the west."""
    lengths = [name for role in ("x", "y", "z", "altitude") for name in found(names, role)]
    if options.units or all(map(unit_of, lengths)):
        pass
    elif (unit := _LENGTH.search(line)) and _OF_LENGTHS.search(line):
        word = unit[0].lower()
        known = {"units": LENGTHS.get(word, "nmi" if word == "nm" else "mm")}
        other = OTHER_UNIT.fullmatch(word) and word != "nm"
        advice = instead_of(word) if other else ("state it by ", known, ", or another unit")
        raise AskError(f"a line beside the rows states lengths in {unit[0]}: ", *advice)
    elif _SCALE.search(line) and found(names, "x"):
        raise AskError(
            f"a line beside the rows states a scale, {line.strip()!r}: multiply by it, or say ", {"units": "m"}
        )
    if _WEST.search(line) and found(names, "longitude"):
        raise ValueError(f"expected degrees that grow to the east, received {line.strip()!r}: change their sign")


def _beneath(
    rest: str, lines: list[str], names: list[str], sign: str, options: ReadOptions, above: list[str]
) -> tuple[str, list[str], list[str]]:
    """Leaves out lines beneath the header with words where the rows have positions, and adds units to names.

    Returns:
        The text behind them, the names with their units, and what is said.

    Raises:
        ValueError: positions are in a unit that is not known.
    """
    asked = [name for role in ("x", "y", "latitude", "longitude") for name in options.columns.get(role, ())]
    places = [name for name in asked or places_in(names) if name in names]
    words = list[list[str]]()
    for line in lines[:_BENEATH]:
        cells = _split(line, sign)
        at = [names.index(place) for place in places]
        if (
            len(cells) != len(names)
            or not at
            or not all(_WORDS.fullmatch(cells[i]) and not is_missing(cells[i]) for i in at)
        ):
            break
        words.append(cells)
    comment = _split(above[-1].lstrip(' \t"#%/'), sign) if above and _is_comment(above[-1]) and sign != " " else []
    stated = [[f"{name} ({one.strip('[]()')})" if name and _is_unit(one, name, line is not comment) else name
               for name, one in zip(names, line, strict=True)]
              for line in (*words, comment) if len(line) == len(names)]  # fmt: skip
    best = max(stated, key=lambda line: sum(one != name for one, name in zip(line, names, strict=True)), default=names)
    said = [f"lines of units beneath the header: {len(words)}"] if words else []
    said += ["units in the comment before the header"] if best != names and not words else []
    return rest[sum(map(len, lines[: len(words)])) :], best, said


def _is_unit(cell: str, name: str, beneath: bool) -> bool:
    """Whether a cell above or beneath a name is its unit, as of x and y all words beneath them are, known or not."""
    word = cell.strip("[]()").lower().removesuffix(" msl")
    return (
        word in {*LENGTHS, *TIMES}
        or OTHER_UNIT.fullmatch(word) is not None
        or ((word in DEGREES or (beneath and word != "")) and bool(found([name], "x") or found([name], "y")))
    )


def _is_header(names: list[str], options: ReadOptions | None) -> bool:
    """Whether a line names places, or the columns that are asked for, or those of a format; of ranges, anything."""
    if len(names) < 2 or options is None:
        return len(names) > 1
    asked = {name for several in options.columns.values() for name in several if not name.isdigit()}
    full = [*filter(None, names)]
    return asked <= {*names} if asked else bool(places_in(names) or format_of(names)) or (
        bool(found(names, "time")) and not any(map(_is_number, full)) and len({*full}) == len(full) > 2)  # fmt: skip


def _is_row(cells: Sequence[str]) -> bool:
    """Whether it is a row of numbers, as of a file without a header."""
    full = [cell for cell in cells if cell]
    return len(full) > 1 and sum(map(_is_number, full)) > len(full) / 2


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
    if sign == " ":
        line = re.sub(r" +(?=[\[(][^\[\]()]*[\])])", "", line)  # between a name and its unit
        return line.split()
    try:
        return [name.strip() for name in next(csv.reader([line.strip("\r\n")], delimiter=sign), [])]
    except csv.Error:
        return []


def _line(cells: list[str], sign: str) -> str:
    text = io.StringIO(newline="")
    csv.writer(text, delimiter=sign).writerow(cells)
    return text.getvalue()


def _no_csv(error: csv.Error) -> ValueError:
    return ValueError(f"expected CSV, received other text ({error})")


def _cells(cells: list[str], place: dict[str, int], width: int, pair: bool, name: str) -> list[str]:
    """The cells of one column, out of the cells of all rows in one list; of a ``pair``, the part before its comma."""
    column = cells[place[name] :: width]
    if pair and name in ("latitude", "longitude"):
        return [cell.partition(",")[2 * (name == "longitude")] for cell in column]
    return column


def _is_number(cell: str) -> bool:
    try:
        return number(cell.replace(",", ".")) is not None
    except ValueError:
        return False
