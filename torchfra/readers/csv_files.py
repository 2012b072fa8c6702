"""Rows of text: separated by commas, semicolons, tabs, bars or spaces, with a header and comments."""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import islice

from torchfra.readers.columns import Cells, Head, is_missing, number
from torchfra.readers.formats import Format, format_of, format_of_text
from torchfra.readers.hints import unclear
from torchfra.readers.names import DEGREES, LENGTHS, OTHER_UNIT, TIMES, found, places_in
from torchfra.readers.names import unit as unit_of
from torchfra.readers.options import AskError, ReadOptions, instead_of, listed, without_unit
from torchfra.readers.sheets import Sheet, repeated

_SIGNS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", " ": "spaces"}
_COMMENTS = ("#", "%", "//")
"""How lines begin that are for people."""
_ABOVE, _BENEATH = 100, 3
"""Lines before a header, and of units beneath it, that loggers write."""
_CELLS = 2**17
"""Cells that are in memory at a time, about."""
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


def csv_sheet(text: str, options: ReadOptions | None) -> Sheet:
    """The rows of a text.

    Args:
        text: the file.
        options: of the caller, which may name columns by their numbers, from 1 on; None of a file of ranges, whose
            first line has the names.

    Raises:
        ValueError: there is no header, or a column comes twice; later, a row of another length.
    """
    format, said = format_of_text(text) if options is not None else None, list[str]()
    if format is not None and format.refused:
        raise ValueError(f"{format.name}: {format.refused}")
    if format is not None and (format.header or format.lines):
        sign, names, rest = _begin_of_format(text, format)
    else:
        sign, names, rest, said = _begin(text, options)
    if not any(names):
        raise ValueError("expected a track, received an empty file")
    if len(names) == 1 and options is not None:
        raise ValueError(f"expected a header with a time and x,y[,z] or lat,lon[,alt]; received {listed(names)}")
    if twice := repeated(names):
        raise ValueError(
            f"expected every column once, received several named {twice}: give each a name of its own in the header"
        )
    said = ([] if sign == "," else [f"separated by {_SIGNS.get(sign, repr(sign))}"]) + said
    format = format or (format_of(names) if options is not None else None)
    longer, place, width = Counter[str](), {name: i for i, name in enumerate(names)}, len(names)

    def mended(row: list[str], before: int) -> list[str]:
        """A row of another length: a comment, or one whose further fields are empty or not asked for."""
        if format is not None and format.lines:
            return (row + [""] * width)[:width] if len(row) >= width / 2 else []
        if row[0].lstrip().startswith(_COMMENTS):
            if options is not None:
                _check_said(sign.join(row), names, options)
            return []
        if before and len(row) > width and any(row[width:]) and options is not None and options.columns:
            longer["rows with more fields than the header read by their first fields"] += 1
        elif len(row) < width or any(row[width:]):
            more = (
                "; rows with more than the first are read by their first fields where options name the columns, such "
                "as ", {"time": names[0]}, f"; or the header is another line than {listed(names)}, or lacks a name",
            ) if options is not None else ()  # fmt: skip
            raise AskError(f"expected {width} fields in data row {before + 1}, received {len(row)}", *more)
        return row[:width]

    def parts() -> Iterator[tuple[int, Cells]]:
        cells, rows, only = list[str](), 0, format.lines.rstrip(",") if format else ""
        lines = io.TextIOWrapper(io.BytesIO(rest.encode()), "utf-8", newline="")  # a quarter of what StringIO takes
        reader = csv.reader(lines, strict=True, delimiter=sign, skipinitialspace=sign == " ")
        try:
            for row in reader:
                if row and (not only or row[0] == only):
                    # no rows: Python's garbage collector would take longer than all else
                    cells += row if len(row) == width else mended(row, rows + len(cells) // width)
                if len(cells) > _CELLS:
                    yield len(cells) // width, partial(_cells, cells, place, width)
                    rows, cells = rows + len(cells) // width, []
        except csv.Error as error:
            raise ValueError(f"expected CSV, received other text ({error})") from error
        yield len(cells) // width, partial(_cells, cells, place, width)

    return Sheet([*place], parts(), tuple(said), sign != ",", format, longer=longer)


def _begin_of_format(text: str, format: Format) -> tuple[str, list[str], str]:
    """What separates cells, the names of columns, and the rows of a format."""
    names, behind, sign = format.header, None, format.sign or ","
    if format.header.startswith("^"):
        behind = re.search(format.header, text, re.MULTILINE)
        if behind is None:
            raise ValueError(f"expected {format.name} with the names of its columns, received none")
        names = text[behind.end() :].splitlines()[0]
        names = names if names.startswith(format.lines) else format.lines + names
    cells = _split(names, sign)
    if format.twice:
        cells = [one for name in cells for one in (("date", "time") if re.fullmatch(format.twice, name) else (name,))]
    begin = re.search(format.rows, text, re.MULTILINE) if format.rows else behind
    if format.rows and begin is None:
        raise ValueError(f"expected {format.name} with rows, received none")
    rest = text[begin.end() :] if begin else text
    return sign, cells, rest[rest.find("\n") + 1 :] if begin is behind and behind else rest


def _begin(text: str, options: ReadOptions | None) -> tuple[str, list[str], str, list[str]]:
    """Leaves out what stands before the header, and units beneath it; numbers the columns where there is no header.

    Returns:
        What separates cells, the names of columns, the rows, and what is said.
    """
    lines, said = [*islice(io.StringIO(text, newline=""), _ABOVE + _BENEATH + 2)], list[str]()
    at = next((i for i, line in enumerate(lines) if not _is_comment(line)), len(lines))
    fixed = [options.sign] if options is not None and options.sign else []
    sign = (fixed or _likely("".join(lines[at : at + 1])))[0]
    *_, (at, sign) = (at, sign), *_headers(lines, at if options is None else _ABOVE, options)
    above, names = lines[:at], _split(lines[at].lstrip(" \t%#/"), sign) if at < len(lines) else []
    if kept := [line for line in above if not _is_comment(line)]:
        said.append(f"lines before the header left out: {len(kept)}")
    begin = sum(map(len, lines[: at + 1]))
    if options is not None and len(names) > 1 and _is_row(names) and not places_in(names):
        begin, names = begin - len(lines[at]), [str(i + 1) for i in range(len(names))]
        if not options.columns:
            several = [_split(line, sign) for line in lines[at : at + _ABOVE]]
            full = [row for row in several if len(row) == len(names)]
            raise unclear(Head(names, lambda name: [row[int(name) - 1] for row in full]), "a header", {})
        said.append("no header: columns by their numbers")
    elif options is not None:
        for line in above:
            _check_said(line, names, options)
        units, names, more = _beneath(lines[at + 1 :], names, sign, options, above)
        begin, said = begin + units, said + more
    return sign, names, text[begin:], said


def _headers(lines: list[str], last: int, options: ReadOptions | None) -> Iterator[tuple[int, str]]:
    """Which lines up to the last may be the header, the likeliest last, and what separates its cells.

    A comment may be one above a row as long.  The first line with places goes before the first with a time alone.
    """
    found_one = False
    for i, line in enumerate(lines[: last + 1]):
        below = next((other for other in lines[i + 1 :] if not _is_comment(other)), "")
        for sign in [options.sign] if options is not None and options.sign else _likely(line):
            cells = _split(line.lstrip(" \t%#/"), sign)
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
    lines: list[str], names: list[str], sign: str, options: ReadOptions, above: list[str]
) -> tuple[int, list[str], list[str]]:
    """Leaves out lines beneath the header with words where the rows have positions, and adds units to names.

    Returns:
        The length of these lines, the names with their units, and what is said.
    """
    asked = [name for role in ("x", "y", "latitude", "longitude") for name in options.columns.get(role, ())]
    numbered = [*names, *(str(i + 1) for i in range(len(names)))]
    places = [numbered.index(name) % len(names) for name in asked or places_in(names) if name in numbered]
    words = list[list[str]]()
    for line in lines[:_BENEATH]:
        cells = _split(line, sign)
        if len(cells) != len(names) or not places:
            break
        if not all(_WORDS.fullmatch(cells[i]) and not is_missing(cells[i]) for i in places):
            break
        words.append(cells)
    comment = _split(above[-1].lstrip(' \t"#%/'), sign) if above and _is_comment(above[-1]) and sign != " " else []
    stated = [[f"{name} ({one.strip('[]()')})" if name and _is_unit(one, name, line is not comment) else name
               for name, one in zip(names, line, strict=True)]
              for line in (*words, comment) if len(line) == len(names)]  # fmt: skip
    best = max(stated, key=lambda line: sum(one != name for one, name in zip(line, names, strict=True)), default=names)
    said = [f"lines of units beneath the header: {len(words)}"] if words else []
    said += ["units in the comment before the header"] if best != names and not words else []
    return sum(map(len, lines[: len(words)])), best, said


def _is_unit(cell: str, name: str, beneath: bool) -> bool:
    """Whether a cell above or beneath a name is its unit, as of x and y all words beneath them are, known or not."""
    word = cell.strip("[]()").lower().removesuffix(" msl")
    if cell == name:  # a header that comes twice
        return False
    if word in {*LENGTHS, *TIMES} or OTHER_UNIT.fullmatch(word):
        return True
    return (word in DEGREES or (beneath and word != "")) and bool(found([name], "x") or found([name], "y"))


def _is_header(names: list[str], options: ReadOptions | None) -> bool:
    """Whether a line names places, or the columns that are asked for, or those of a format; of ranges, anything."""
    if len(names) < 2 or options is None:
        return len(names) > 1
    asked = {name for several in options.columns.values() for name in several if not name.isdigit()}
    full, bare = [*filter(None, names)], {without_unit(name) for name in names}
    places = bool(places_in(names) or format_of(names))
    if asked:
        every = all(one in names or without_unit(one) in bare for one in asked)
        return every and bool(places or options.columns.keys() & {"x", "latitude"})
    return places or (bool(found(names, "time")) and not any(map(_is_number, full)) and len({*full}) == len(full) > 2)


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
        line = re.sub(r"(?<=[^\s\])]) +(?=[\[(][^\[\]()]*[\])])", "", line)  # between a name and its unit
        return line.split()
    try:
        return [name.strip() for name in next(csv.reader([line.strip("\r\n")], delimiter=sign), [])]
    except csv.Error:
        return []


def _cells(cells: list[str], place: dict[str, int], width: int, name: str) -> list[str]:
    """The cells of one column, out of the cells of all rows in one list."""
    return cells[place[name] :: width]


def _is_number(cell: str) -> bool:
    try:
        return number(cell.replace(",", ".")) is not None
    except ValueError:
        return False
