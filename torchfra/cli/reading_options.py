"""Options of the commands that read tracks: which columns hold what, and how they are written."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import fields

from torchfra.readers.bounded import MAX_BYTES
from torchfra.readers.times import FORMS
from torchfra.readers.told import METRES, Told

_ABOUT = {
    "time": ("COLUMN", "column of times; its numbers may be seconds since any start"),
    "x": ("COLUMN", "column of positions"), "y": ("COLUMN", "likewise"), "z": ("COLUMN", "likewise"),
    "lat": ("COLUMN", "column of latitudes"), "lon": ("COLUMN", "column of longitudes"),
    "alt": ("COLUMN", "column of altitudes"),
    "id": ("COLUMN", "column that says which target a row is of"),
    "sigma_column": ("COLUMN", "column of the std of each fix per axis"),
    "units": ("UNIT", "unit of x, y, z, or of altitudes: " + ", ".join(METRES)),
    "delimiter": ("SIGN", "sign between cells; or tab, space"),
    "decimal": ("SIGN", "sign before decimals: . or ,"),
    "time_format": ("FORM", f"times as {', '.join(FORMS)}, or such as 25fps or %%d.%%m.%%Y %%H:%%M:%%S"),
}  # fmt: skip
"""What each option is followed by, and what it is about."""
READING = tuple(field.name for field in fields(Told))
"""What the options are called in a namespace."""


def add_reading_options(add: Callable[..., object]) -> None:
    """Adds ``--time COLUMN`` and the others, by the ``add_argument`` of a parser or of a group."""
    for name in READING:
        sign, about = _ABOUT[name]
        add(f"--{name.replace('_', '-')}", metavar=sign, help=f"of files: {about}")


def reading_of(options: argparse.Namespace) -> dict[str, str | None]:
    """What the options say, as keywords of ``readers.read``."""
    return {name: getattr(options, name) for name in READING}


def add_bound_option(add: Callable[..., object], default: int | None = MAX_BYTES) -> None:
    """Adds ``--max-bytes N`` by a parser's ``add_argument``; without a ``default`` one sees whether it was given."""
    about = f"text that a file may hold, unpacked: a row counts for 64 or more (default: {MAX_BYTES})"
    add("--max-bytes", type=int, default=default, metavar="N", help=about)
