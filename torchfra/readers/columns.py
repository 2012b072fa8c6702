"""From cells to columns of numbers and of text."""

from __future__ import annotations

import math
import re
import reprlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from torchfra.readers.degrees import degrees_of
from torchfra.readers.times import seconds_of, usual_iso_seconds

Array: TypeAlias = NDArray[np.float64]
Cells: TypeAlias = Callable[[str], Sequence[Any] | NDArray[Any]]
"""The cells of a column by its name."""

DECIMAL = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
BEHIND = re.compile(r"(?P<number>[+-]?[0-9.,]+) ?(?P<unit>[A-Za-z]{1,3})")
"""A number and its unit."""
_MISSING = {"", "nan", "-nan", "na", "n/a", "#n/a", "<na>", "nat", "null", "none", "-", "--"}
"""Words for nothing, in small letters, as tables, data bases and spreadsheets write it."""
_NO_DATE = re.compile(r"0{2}(?:00)?([-/.])00\1(?:00){1,2}(?:[ T]00:00(?::00)?(?:\.0+)?)?")
"""As loggers and data bases write a date that there is not, perhaps with a time of the day."""
_SIGNS_OF_DECIMALS = re.compile(r"[0-9.eE+\- ,]*")
"""Text of these characters alone is a decimal number to ``float``, or an error."""
_SIGNS_WITH_COMMAS = re.compile(r"[0-9,eE+\- ;]*")
_GROUPED = re.compile(r"[+-]?[0-9]{1,3}(?:,[0-9]{3})+\.[0-9]+|[+-]?[0-9]{1,3}(?:['\u2019][0-9]{3})+(?:\.[0-9]*)?")
"""A number whose thousands are parted, as spreadsheets write it: by commas, where a point shows what they are not."""
_GROUPED_BEFORE_COMMA = re.compile(r"[+-]?[0-9]{1,3}(?:[.'\u2019 \u00a0\u202f][0-9]{3})+,[0-9]+")
_THOUSANDS = re.compile(r"[+-]?[0-9]{1,3}(?:[., \u00a0\u202f][0-9]{3})+")
_DAY_OF_EXCEL = re.compile(r"[345][0-9]{4}(?:[.,][0-9]+)?")
"""From 1982 to 2064."""
_PARTING = re.compile(r"[,.'\u2019 \u00a0\u202f]")
_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 60
short = _SHORT.repr
"""What came, for an error message, cut off where it is long or deep."""


HEAD = 1000
"""Rows that are looked at before all are read."""


class Head(NamedTuple):
    """How a table begins, which shows what its columns hold."""

    names: list[str]
    """Of all columns."""
    cells: Cells
    """The first of each column."""
    said: tuple[str, ...] = ()
    """Lines for a person about the file."""
    commas: bool = False
    """Whether its numbers may have decimal commas."""
    json: bool = False
    """Whether it is JSON."""
    word: str = ""
    """What its targets are, where the format says it."""
    further: Cells | None = None
    """More of each column, where there are more rows."""


@dataclass(frozen=True)
class Kind:
    """What the numbers of a column are."""

    said: str = "a number"
    """What an error message says is expected."""
    limit: float = 1e15
    """Numbers of larger size are refused."""
    unit: float = 1.0
    """What they are multiplied by."""
    per_unit: float = 1.0
    """What they are divided by."""
    zero: float = 0.0
    """What they are where nothing has passed yet."""
    between: tuple[float, float] = (math.inf, math.inf)
    """A number strictly between these two is refused."""
    advice: str = ""
    """What the error message adds where a number is too large or in the refused interval."""
    decimal: str = "."
    """What parts a number from its decimals."""
    form: str = ""
    """Of times in text: see ``times.seconds_of``."""
    absent: tuple[float, ...] = ()
    """Numbers that stand for a missing one."""
    joined: tuple[str, ...] = ()
    """Columns whose cells together are one of this: a date and a time of the day, or degrees and their side."""
    sides: str = ""
    """Of degrees: the letters for above and below 0 (``degrees.degrees_of``)."""
    behind: str = ""
    """The unit behind each number, as in "154 m"."""
    words: tuple[tuple[str, float], ...] = ()
    """Of text: the words that there may be, in small letters, and the number of each."""
    others: bool = False
    """Whether there may be other words, which are taken as missing."""


SECONDS = Kind(limit=1e10, advice=", which is too large for seconds: milliseconds must be divided by 1000")
"""Up to the year 2286; milliseconds since 1970 are above from April 1970 on."""
INSTANT = Kind(
    "ms since 1970 or ISO text", limit=1e13, per_unit=1e3, between=(3e8, 1e10), form="iso",
    advice="; seconds must be multiplied by 1000, microseconds divided by it",
)  # fmt: skip
"""Up to the year 2286; between are seconds since 1970 from 1980 on."""


def number(value: Any) -> float:
    """A cell as a number; NaN if it is empty or a word for nothing, whose letters may be small or not.

    Raises:
        ValueError: it is no decimal number in ASCII digits, such as "-1.5e3": ``float`` takes more than that, such as
            "1_000", digits of other scripts and "inf", which nobody means in a file.
        OverflowError: it is an integer that is too large.
    """
    if value is None:
        return math.nan
    if isinstance(value, str):
        value = value.strip(" \t\r\n")
        if is_missing(value):
            return math.nan
        if _GROUPED.fullmatch(value):
            value = re.sub("[,'\u2019]", "", value)
        if not DECIMAL.fullmatch(value):
            raise ValueError
    elif isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError
    return float(value)


def in_seconds(time: Array) -> Array:
    """Times since 1970 in seconds, of which milliseconds are more than there will be."""
    return np.where(time > 1e11, time / 1e3, time)


def is_missing(cell: str) -> bool:
    """Whether a text stands for nothing, such as "N/A"."""
    bare = cell.strip(" \t\r\n").lower()
    return bare in _MISSING or _NO_DATE.fullmatch(bare) is not None


def _instant(value: Any, kind: Kind) -> float:
    """Ms since 1970, as they are or from text, in the unit of the kind."""
    if kind.form == "iso":
        with suppress(ValueError):
            return number(value)
    elif value is None or value != value or (isinstance(value, str) and is_missing(value)):
        return math.nan
    if isinstance(value, bool) or not isinstance(value, str | int):
        raise ValueError
    return seconds_of(str(value), kind.form) * kind.per_unit


def numbers(cells: Sequence[Any] | NDArray[Any], kind: Kind, name: str, first: int = 0) -> Array:
    """Cells ``(rows,)`` as numbers, NaN where empty.

    Args:
        cells: of a column.
        kind: of its numbers.
        name: of the column.
        first: rows before these.

    Raises:
        ValueError: a cell that is no number of this kind.
    """

    def refused(i: int, advice: str = "") -> ValueError:
        where = f"in data row {first + i + 1}, column {name}"
        cell = cells[i].item() if isinstance(cells[i], np.generic) else cells[i]
        if isinstance(cell, str) and _THOUSANDS.fullmatch(cell.strip()):
            advice = ", whose sign may part thousands or decimals: write it without, or say --decimal"
        if "%" in kind.form and isinstance(cell, str) and _DAY_OF_EXCEL.fullmatch(cell.strip()):
            advice = ", which looks like a day of Excel: write all dates in one form, such as 2024-05-06 10:31:00"
        return ValueError(f"expected {kind.said} {where}, received {short(cell)}{advice}")

    if isinstance(cells, np.ndarray) and cells.dtype.kind in "fiu" and kind.form not in ("", "iso"):
        cells = [None if cell != cell else f"{cell:.17g}" for cell in cells.tolist()]  # whose digits are the text
    values = _array(cells, kind) if isinstance(cells, np.ndarray) else _plain(cells, kind)
    if values is None or kind.words:
        convert = _converter(kind)
        values = np.empty(len(cells))
        for i, cell in enumerate(cells):
            try:
                values[i] = convert(cell)
            except (ValueError, OverflowError):
                raise refused(i) from None
    if kind.absent:
        values[np.isin(values, kind.absent)] = math.nan
    size = np.abs(values)
    wrong = (size > kind.limit) | ((size > kind.between[0]) & (size < kind.between[1]))
    if wrong.any():
        raise refused(int(wrong.argmax()), kind.advice)
    return (values - kind.zero) * kind.unit / kind.per_unit if kind.zero else values * kind.unit / kind.per_unit


def _converter(kind: Kind) -> Callable[[Any], float]:
    """What makes a number of a cell; texts that come again, as times do, are read once."""
    if kind.form:
        known: dict[Any, float] = {}

        def instant(cell: Any) -> float:
            if not isinstance(cell, str):
                return _instant(cell, kind)
            if cell not in known:
                known[cell] = _instant(cell, kind)
            return known[cell]

        return instant
    if kind.words:
        return partial(_of_word, numbers=dict(kind.words), others=kind.others)
    if kind.behind:
        bare = _converter(replace(kind, behind=""))
        return lambda cell: bare(_without_unit(cell, kind.behind) if isinstance(cell, str) else cell)
    if kind.decimal == "." and not kind.sides:
        return number

    def plain(cell: Any) -> float:
        if isinstance(cell, str) and kind.decimal == ",":
            whole, _, part = cell.strip(" \t\r\n").rpartition(",")
            if _GROUPED_BEFORE_COMMA.fullmatch(f"{whole},{part}"):
                cell = f"{_PARTING.sub('', whole)},{part}"
            cell = cell.replace(".", "_").replace(",", ".")
        with suppress(ValueError):
            return number(cell)
        if not kind.sides or not isinstance(cell, str):
            raise ValueError
        return degrees_of(cell, kind.sides) / kind.unit

    return plain


def _without_unit(cell: str, unit: str) -> str:
    """A cell without the unit behind its number.

    Raises:
        ValueError: there is another one.
    """
    match = BEHIND.fullmatch(cell.strip())
    if match and match["unit"].lower() != unit:
        raise ValueError
    return match["number"] if match else cell


def _of_word(cell: Any, numbers: Mapping[str, float], others: bool) -> float:
    """The number of a word; NaN if the cell is empty."""
    word = word_of(cell)
    if word and word not in numbers and not others:
        raise ValueError
    return numbers.get(word, math.nan)


def word_of(cell: Any) -> str:
    """A cell in small letters, and whole numbers without decimals; "" if it is empty."""
    word = f"{cell:g}" if isinstance(cell, float) else str(cell).strip().lower()
    return "" if cell is None or word == "nan" else word


def _array(cells: NDArray[Any], kind: Kind) -> Array | None:
    """Numbers and moments of an array; None where it holds something else."""
    if cells.dtype.kind == "M":
        nano = cells.astype("datetime64[ns]")
        return np.where(np.isnat(nano), np.nan, nano.astype(np.int64) / 1e9 * kind.per_unit)
    return cells.astype(np.float64) if cells.dtype.kind in "fiu" else None


def _plain(cells: Sequence[Any], kind: Kind) -> Array | None:
    """Cells that are all empty or decimal numbers, or usual ISO text, fast; None for others."""
    if kind.form not in ("", "iso"):
        return None  # a form may be of digits alone
    if kind.form == "iso" and (seconds := usual_iso_seconds(cells)) is not None:
        return seconds * kind.per_unit
    try:
        if kind.decimal == "," and _SIGNS_WITH_COMMAS.fullmatch(";".join(cells)):
            return np.array([float(cell.replace(",", ".") or "nan") for cell in cells])
        if kind.decimal == "." and _SIGNS_OF_DECIMALS.fullmatch(",".join(cells)):
            return np.array([float(cell or "nan") for cell in cells])
    except (TypeError, ValueError):
        pass
    return None


def text(cells: Sequence[Any] | NDArray[Any], name: str, known: dict[Any, str], first: int = 0) -> list[str]:
    """Cells as text; "" where empty.

    Args:
        cells: of a column.
        name: of the column.
        known: texts so far by their cells, so that equal texts are in memory once.
        first: rows before these.

    Raises:
        ValueError: a cell that is neither text nor a number.
    """
    if isinstance(cells, np.ndarray):
        cells = [None if cell != cell else cell for cell in cells.tolist()]
    for i, cell in enumerate(cells):
        if isinstance(cell, bool | list | dict):
            where = f"in data row {first + i + 1}, column {name}"
            raise ValueError(f"expected text {where}, received {short(cell)}")
        if cell not in known:
            whole = isinstance(cell, float) and cell.is_integer()  # a table with gaps has numbers of ships as such
            known[cell] = "" if cell is None or cell != cell else str(int(cell) if whole else cell).strip()
    return [known[cell] for cell in cells]


def grouped(labels: Sequence[str]) -> dict[str, NDArray[np.intp]]:
    """The rows of each label, in the order of their first rows."""
    place: dict[str, int] = {}
    places = np.fromiter((place.setdefault(label, len(place)) for label in labels), np.intp, len(labels))
    order = np.argsort(places, kind="stable")
    parts = np.split(order, np.cumsum(np.bincount(places))[:-1]) if len(labels) else []
    return dict(zip(place, parts, strict=True))


def joined(cells: Cells, columns: tuple[str, ...]) -> list[str]:
    """The cells of several columns, one after the other; "" where all are empty, or one is no date."""

    def text(part: Any) -> str:
        return "" if part is None or part != part or str(part).strip().lower() in _MISSING else str(part).strip()

    lines = (" ".join(map(text, parts)).strip() for parts in zip(*map(cells, columns), strict=True))
    return ["" if is_missing(line) else line for line in lines]
