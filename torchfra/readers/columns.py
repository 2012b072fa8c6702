"""From cells to columns of numbers and of text."""

from __future__ import annotations

import math
import re
import reprlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from torchfra.numbers import Array as Array
from torchfra.readers.times import count_of, counted, seconds_of

Cells: TypeAlias = Callable[[str], Sequence[Any] | NDArray[Any]]
"""The cells of a column by its name."""
DECIMAL = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_MISSING = {"", "nan", "-nan", "na", "n/a", "#n/a", "<na>", "nat", "null", "none", "-", "--"}
"""Words for nothing, in small letters, as tables, data bases and spreadsheets write it."""
_PARTED = re.compile(r"[+-]?[0-9]+(?:[., '\u2019\u00a0\u202f][0-9]{3})*(?:[.,][0-9]*)?")
_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 60
short = _SHORT.repr
"""What came, for an error message, cut off where it is long or deep."""
_LARGEST = 1e30
"""Numbers of larger size hold nothing of a track, and their sums may be none."""
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
    format: Any = None
    """The ``formats.Format`` that its text begins with, if any."""
    word: str = ""
    """What its targets are, where the format says it."""
    degrees: bool = False
    """Whether its positions are decimal degrees by a standard."""


@dataclass(frozen=True)
class Kind:
    """What the numbers of a column are."""

    said: str = "a number"
    """What an error message says is expected."""
    limit: float = 1e15
    """Numbers of larger size are refused."""
    unit: float = 1.0
    """What they are multiplied by."""
    between: tuple[float, float] = (math.inf, math.inf)
    """A number strictly between these two is refused."""
    advice: str = ""
    """What the error message adds where a number is too large or in the refused interval."""
    decimal: str = "."
    """What parts a number from its decimals."""
    form: str = ""
    """Of times: see ``times.seconds_of`` and ``times.count_of``."""
    absent: tuple[float, ...] = ()
    """Numbers that stand for a missing one."""
    joined: tuple[str, ...] = ()
    """Columns whose cells together are one of this, such as a date and a time of the day."""
    words: tuple[tuple[str, float], ...] = ()
    """Of text: the words that there may be, in small letters, and the number of each."""
    others: bool = False
    """Whether there may be other words, which are taken as missing."""


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
        if not DECIMAL.fullmatch(value):
            raise ValueError
    elif isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError
    return float(value)


def number_or_nan(cell: Any) -> float:
    """A cell as a number; NaN of what is none; a decimal comma is one."""
    try:
        return number(cell.replace(",", ".")) if isinstance(cell, str) else float(cell)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def is_missing(cell: str) -> bool:
    """Whether a text stands for nothing, such as "N/A"."""
    return cell.strip(" \t\r\n").lower() in _MISSING


def values_of(cells: Iterable[Any]) -> Array:
    """The cells that hold numbers, as numbers; a decimal comma is one."""
    return np.array([value for value in map(number_or_nan, cells) if abs(value) < _LARGEST])


def texts_of(cells: Iterable[Any]) -> list[str]:
    """The cells that say something, as text."""
    return [text for cell in cells if cell is not None and cell == cell and not is_missing(text := str(cell).strip())]


def _instant(value: Any, kind: Kind) -> float:
    """Seconds of a text in the form of a kind; of a number where it is ms since 1970."""
    if value is None or value != value or (isinstance(value, str) and is_missing(value)):
        return math.nan
    if isinstance(value, bool) or not isinstance(value, str | int):
        raise ValueError
    return seconds_of(str(value), kind.form)


def numbers(cells: Sequence[Any] | NDArray[Any], kind: Kind, name: str, first: int = 0) -> Array:
    """Cells ``(rows,)`` as numbers, NaN where empty; times as seconds.

    Args:
        cells: of a column.
        kind: of its numbers.
        name: of the column.
        first: rows before these.

    Raises:
        ValueError: a cell that is no number of this kind.
    """

    def refused(i: int, advice: str = "") -> ValueError:
        cell = cells[i].item() if isinstance(cells[i], np.generic) else cells[i]
        if isinstance(cell, str) and _PARTED.fullmatch(cell.strip()) and not DECIMAL.fullmatch(cell) and not kind.form:
            advice = (
                ", whose sign may part thousands or decimals: part no thousands, or state the other (option decimal)"
            )
        return ValueError(
            f"expected {kind.said} in data row {first + i + 1}, column {name}, received {short(cell)}{advice}"
        )

    if isinstance(cells, np.ndarray) and cells.dtype.kind == "M":
        nano = cells.astype("datetime64[ns]")
        return np.where(np.isnat(nano), np.nan, nano.astype(np.int64) / 1e9)
    if isinstance(cells, np.ndarray) and cells.dtype.kind in "fiu" and kind.form and not count_of(kind.form):
        cells = [None if cell != cell else f"{cell:.17g}" for cell in cells.tolist()]  # whose digits are the text
    if isinstance(cells, np.ndarray) and cells.dtype.kind in "fiu" and not kind.words:
        values = cells.astype(np.float64)
    else:
        convert, values = _converter(kind), np.empty(len(cells))
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
    return counted(values, kind.form) if count_of(kind.form) else values * kind.unit


def _converter(kind: Kind) -> Callable[[Any], float]:
    """What makes a number of a cell; texts that come again, as times do, are read once."""
    if kind.form and not count_of(kind.form):
        known: dict[Any, float] = {}

        def instant(cell: Any) -> float:
            if cell not in known:
                known[cell] = _instant(cell, kind)
            return known[cell]

        return instant
    if kind.words:
        return partial(_of_word, numbers=dict(kind.words), others=kind.others)
    if kind.decimal == ".":
        return number
    return lambda cell: number(cell.replace(".", "_").replace(",", ".") if isinstance(cell, str) else cell)


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
            raise ValueError(f"expected text in data row {first + i + 1}, column {name}, received {short(cell)}")
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
    """The cells of several columns, one after the other; "" where one is empty."""

    def written(part: Any) -> str:
        return "" if part is None or part != part or is_missing(str(part)) else str(part).strip()

    several = (list(map(written, parts)) for parts in zip(*map(cells, columns), strict=True))
    return [" ".join(parts) if all(parts) else "" for parts in several]
