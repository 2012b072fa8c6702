"""Files that libraries read: FIT of watches, and workbooks of spreadsheets."""

from __future__ import annotations

import csv
import io
from datetime import datetime
from typing import Any

from torchfra.readers.bounded import check_size
from torchfra.readers.sheets import Sheet, records_sheet
from torchfra.running.optional import optional

_SEMICIRCLE = 180 / 2**31
_FIT = {"position_lat": "latitude", "position_long": "longitude", "gps_accuracy": "accuracy"}
"""What a record of FIT calls what is read of it."""


def fit_sheet(file: Any) -> Sheet:
    """The records of a FIT file; laps, sessions and events are none.

    Raises:
        ValueError: it is damaged, or has no records.
        ImportError: fitdecode is not installed.
    """
    fitdecode, records = optional("fitdecode", "FIT", "formats"), list[dict[str, Any]]()
    try:
        with fitdecode.FitReader(file, check_crc=fitdecode.CrcCheck.RAISE) as reader:
            for frame in reader:
                if frame.frame_type == fitdecode.FIT_FRAME_DATA and frame.name == "record":
                    cells = {field.name: field.value for field in frame.fields}
                    record = {_FIT.get(name, name): value for name, value in cells.items() if _is_cell(value)}
                    places = {axis: record[axis] * _SEMICIRCLE for axis in ("latitude", "longitude") if axis in record}
                    records.append({**record, **places})
    except MemoryError:
        raise
    except Exception as error:  # what is damaged can lead to errors of many types
        raise ValueError(f"expected a complete FIT file, received none ({error})") from error
    if not records:
        raise ValueError("expected FIT with messages called record, received none: no track was recorded")
    columns = records_sheet(
        [{k: v.isoformat() if isinstance(v, datetime) else v for k, v in one.items()} for one in records], ()
    )
    return columns._replace(said=("FIT: messages called record",), degrees=True)


def _is_cell(value: Any) -> bool:
    return isinstance(value, int | float | str | datetime) and not isinstance(value, bool)


def is_workbook(start: bytes, suffix: str) -> bool:
    """Whether a file is a workbook of a spreadsheet."""
    return start[:4] == b"PK\x03\x04" and (suffix in (".xlsx", ".xlsm") or b"[Content_Types].xml" in start[:200])


def workbook_text(file: Any, max_bytes: int) -> str:
    """The first sheet of a workbook with two rows or more, as CSV.

    Raises:
        ValueError: it is damaged, holds too much, or nothing.
        ImportError: openpyxl is not installed.
    """
    openpyxl, text = optional("openpyxl", "A workbook of a spreadsheet", "formats"), io.StringIO(newline="")
    try:
        book = openpyxl.load_workbook(file, read_only=True, data_only=True)
    except Exception as error:
        raise ValueError(f"expected a complete workbook, received none ({error})") from error
    for sheet in book.worksheets:
        writer = csv.writer(text)
        for row in sheet.iter_rows(values_only=True):
            moments = (cell.isoformat(" ") if isinstance(cell, datetime) else cell for cell in row)
            writer.writerow("" if cell is None else str(cell).removesuffix(" 00:00:00") for cell in moments)
            check_size(text.tell(), max_bytes)
        if text.getvalue().count("\n") > 1:
            return text.getvalue()
        text = io.StringIO(newline="")
    raise ValueError("expected a workbook with a track, received an empty one")
