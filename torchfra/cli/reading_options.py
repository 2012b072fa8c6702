"""Options of the commands that read and clean tracks: columns, formats, and settings of cleaning."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import fields

from torchfra.cleaning.kinds import KINDS
from torchfra.readers.bounded import MAX_BYTES
from torchfra.readers.names import METRES
from torchfra.readers.options import ReadOptions
from torchfra.readers.times import FORMS

_ABOUT = {
    "time": ("COLUMN", "column of times, such as seconds since any start; or several, such as date,clock"),
    "x": ("COLUMN", "column of positions"), "y": ("COLUMN", "column of positions"),
    "z": ("COLUMN", "column of positions"),
    "lat": ("COLUMN", "column of latitudes"), "lon": ("COLUMN", "column of longitudes"),
    "alt": ("COLUMN", "column of altitudes"),
    "id": ("COLUMN", "column with the target of a row; or several, such as operator,number"),
    "sigma_column": ("COLUMN", "column of the std of each fix per axis"),
    "units": ("UNIT", "unit of x, y, z, or of altitudes: " + ", ".join(METRES)),
    "delimiter": ("CHAR", "character between cells; or tab, space"),
    "decimal": ("CHAR", "decimal separator: . or ,"),
    "missing": ("NUMBERS", "numbers that stand for none: --missing=-999,9999"),
    "time_format": ("FORM", f"how times are written: {', '.join(FORMS)}; 25fps for numbers of frames; or a form such "
                    "as %%d.%%m.%%Y %%H:%%M:%%S, or %%M:%%S for a stopwatch (12:34.5)"),
}  # fmt: skip
"""Placeholder and help of each option."""
READING = tuple(field.name for field in fields(ReadOptions))
"""Names of the options in a namespace."""


def add_reading_options(add: Callable[..., object]) -> None:
    """Adds ``--time COLUMN`` and the others, by the ``add_argument`` of a parser or of a group."""
    for name in READING:
        sign, about = _ABOUT[name]
        add(f"--{name.replace('_', '-')}", metavar=sign, help=about)


def reading_of(options: argparse.Namespace) -> dict[str, str | None]:
    """The options as keywords of ``readers.read``."""
    return {name: getattr(options, name) for name in READING}


def add_bound_option(add: Callable[..., object], default: int | None = MAX_BYTES) -> None:
    """Adds ``--max-bytes N`` by a parser's ``add_argument``; with None as ``default`` one sees whether it was given."""
    about = f"largest size of a file, unpacked, bytes (default: {MAX_BYTES})"
    add("--max-bytes", type=int, default=default, metavar="N", help=about)


def add_cleaning_options(add: Callable[..., object]) -> None:
    """Adds ``--sigma`` and the others, by the ``add_argument`` of a parser or of a group."""
    add("--bank", metavar="NAME", help=f"kind of targets: {', '.join(KINDS)} (default: as the file says; where it "
        "says none, the motion is bounded by the track's own speed)")  # fmt: skip
    add("--sigma", type=float, metavar="M", help="std of a fix per axis, m; a factor for fixes that state theirs "
        "(default: estimated)")  # fmt: skip
    add("--q", type=float, help="density of the process noise, m^2/s^3 (default: estimated)")
    add("--no-smooth", action="store_true", help="use only the fixes before and at each step: filter, do not smooth")
    add("--no-repair", action="store_true", help="keep time stamps that seem to be wrong")
    add("--dt", type=float, metavar="S", help="also estimate at every multiple of S seconds: with 3600 at whole hours")
