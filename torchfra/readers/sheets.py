"""What every format is read to: named columns, some rows at a time."""

from __future__ import annotations

import codecs
from collections import Counter
from collections.abc import Iterable
from typing import Any, NamedTuple

from torchfra.readers.columns import Cells

WINDOWS = "torchfra.windows"
"""Name of what reads bytes that are no UTF-8 as the letters that Windows has for western Europe."""


def _letters(error: UnicodeError) -> tuple[str, int]:
    assert isinstance(error, UnicodeDecodeError)
    return error.object[error.start : error.end].decode("cp1252", "replace"), error.end


codecs.register_error(WINDOWS, _letters)


class Sheet(NamedTuple):
    """The cells of a file; see ``columns.Head`` for what they have in common."""

    names: list[str]
    parts: Iterable[tuple[int, Cells]]
    """The number of rows and the cells of a column by its name, part by part; all columns are as long."""
    said: tuple[str, ...] = ()
    commas: bool = False
    format: Any = None
    word: str = ""
    """What its targets are, where the format says it."""
    degrees: bool = False
    """Whether its positions are decimal degrees by a standard."""
    longer: Counter[str] | None = None
    """What was done to rows, which is counted while they are read."""


def repeated(names: Iterable[str]) -> str:
    """The names that come twice, for an error message; "" if none does."""
    return ", ".join(name for name, count in Counter(names).items() if count > 1 and name)[:200]


def points_sheet(columns: dict[str, list[Any]], said: tuple[str, ...]) -> Sheet:
    """A sheet of columns that are all there, without those that are empty."""
    full = {name: cells for name, cells in columns.items() if any(cell not in (None, "") for cell in cells)}
    rows = len(next(iter(columns.values()), []))
    return Sheet(list(full), [(rows, full.__getitem__)], said)


def records_sheet(records: list[dict[str, Any]], said: tuple[str, ...]) -> Sheet:
    """A sheet with a row for each record."""
    names = dict.fromkeys(name for record in records for name in record)
    return Sheet(
        [*names], [(len(records), lambda name: [record.get(name) for record in records])] if names else [], said
    )
